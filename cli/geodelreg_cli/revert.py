"""``geodelreg revert``: the header as it was before ``align --in-place``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from geodelreg.errors import shown
from geodelreg_cli.console import configure_logging
from geodelreg_cli.options import FILE, command, message_options


@command("", message_options())
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=FILE)
def revert(files: tuple[Path, ...], quiet: bool, **messages: Any) -> None:
    """Undo "align --in-place": put the original header back.

    The record of it is kept with each file; the pixels were never touched. Of several files all are
    put back or, when one cannot be, none.
    """
    configure_logging(quiet=quiet, **messages)
    import geodelreg

    geodelreg.revert(*files)
    if not quiet:
        for file in files:
            click.echo(f"{shown(str(file))}: original georeferencing is back", err=True)
