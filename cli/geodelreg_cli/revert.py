"""``geodelreg revert``: the header as it was before ``align --in-place``."""

from __future__ import annotations

from pathlib import Path

import click

from geodelreg.errors import shown
from geodelreg_cli.console import configure_logging
from geodelreg_cli.options import SectionCommand


@click.command(cls=SectionCommand)
@click.argument(
    "files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.")
@click.option("-v", "--verbose", count=True, help="Print the steps; -vv everything.")
@click.option("--debug", is_flag=True, help="Print a traceback with an error.")
def revert(files: tuple[Path, ...], quiet: bool, verbose: int, debug: bool) -> None:
    """Undo "align --in-place": put the original header back.

    The record of it is kept with each file; the pixels were never touched. Of several files all are
    put back or, when one cannot be, none.
    """
    configure_logging(verbose, quiet, debug)
    import geodelreg

    geodelreg.revert(*files)
    if not quiet:
        for file in files:
            click.echo(f"{shown(str(file))}: original georeferencing is back", err=True)
