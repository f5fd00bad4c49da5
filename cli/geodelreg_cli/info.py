"""``geodelreg info``: what is known of a raster before any pixel is looked at."""

from __future__ import annotations

import json
from typing import Any

import click

from geodelreg_cli.options import (
    SectionCommand,
    SectionOption,
    add_options,
    run_options,
    start_run,
)

EPILOG = """\
Examples:

  Will these two go together?
    geodelreg info ms.tif pan.tif

  One number:
    geodelreg info ms.tif --json | jq .gsd_m
"""


@add_options(
    [
        SectionOption(
            ["--json"], is_flag=True, section="Output", help="Print JSON, a line a file."
        ),
        *(option for option in run_options() if option.name != "threads"),
    ]
)
@click.command(cls=SectionCommand, epilog=EPILOG)
@click.argument("rasters", metavar="FILE...", nargs=-1, required=True)
def info(rasters: tuple[str, ...], **given: Any) -> None:
    """Tell what geodelreg knows of rasters: grid, pixel size, CRS, footprint, bands, provenance.

    A raster that cannot be aligned ends with the error that "geodelreg align" would end with.
    """
    start_run(given)
    from geodelreg.product.report import escaped
    from geodelreg.report.info import info as info_of
    from geodelreg.report.info import info_text

    for number, path in enumerate(rasters):
        found = info_of(path, given["allow"])
        if given["json"]:
            click.echo(escaped(json.dumps(found, ensure_ascii=False, allow_nan=False)))
        else:
            click.echo(("\n" if number else "") + info_text(found))
