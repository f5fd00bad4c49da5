"""geodelreg and other tools, each in an environment of its own, on the same scenes."""
