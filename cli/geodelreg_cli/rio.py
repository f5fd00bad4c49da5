"""``rio geodelreg-align``: the align command as a plugin of rasterio's command line."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import click

from geodelreg.errors import GeodelregError
from geodelreg.flags import as_typed
from geodelreg_cli.align import EPILOG
from geodelreg_cli.align import align as align_command
from geodelreg_cli.options import SectionCommand


class _RioCommand(SectionCommand):
    """The command inside rio's GDAL environment, its errors as rio expects them."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run in ``ctx.obj["env"]``, which rio makes from its own options."""
        environment = (ctx.obj or {}).get("env")
        with ExitStack() as stack:
            if environment is not None:
                stack.enter_context(environment)
            try:
                return super().invoke(ctx)
            except GeodelregError as error:
                click.echo(f"Error: {as_typed(str(error))}", err=True)
                ctx.exit(error.exit_code)


align = _RioCommand(
    name="geodelreg-align",
    callback=align_command.callback,
    params=align_command.params,
    help=align_command.help,
    epilog=EPILOG.replace("geodelreg align", "rio geodelreg-align"),
)
