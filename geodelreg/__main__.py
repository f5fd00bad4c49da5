"""``python -m geodelreg``: the command line."""

from geodelreg_cli.main import main

main()
