"""The command line of geodelreg: one file per command."""
