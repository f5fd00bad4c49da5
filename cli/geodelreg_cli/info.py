"""``geodelreg info``: what is known of a raster before any pixel is looked at."""

from __future__ import annotations

import json
from typing import Any

import click

from geodelreg_cli.options import command, flag, run_options, start_run, under

EPILOG = """\
Examples:

  Will these two go together?
    geodelreg info ms.tif pan.tif

  One number:
    geodelreg info ms.tif --json | jq .gsd_m
"""


OPTIONS = [
    *under("Output", flag("--json", help="Print JSON, a line a file.")),
    *run_options(threads=False),
]


@command(EPILOG, OPTIONS)
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
