"""``python -m geodelreg_cli``."""

from geodelreg_cli.main import main

main()
