"""``geodelreg report``: a page to look at, out of a JSON report and its rasters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from geodelreg.options import WriteOptions
from geodelreg_cli.options import (
    FILE,
    SectionOption,
    command,
    knob_option,
    ms_and_pan,
    option,
    run_options,
    start_run,
    under,
)

EPILOG = """\
Examples:

  Align, and make the page later or elsewhere:
    geodelreg align ms.tif pan.tif -o aligned.tif --report result.json
    geodelreg report result.json ms.tif pan.tif -o result.html

  Both at once:
    geodelreg align ms.tif pan.tif -o aligned.tif --report result.html
"""


def again_options(*own: SectionOption, **output: str) -> list[SectionOption]:
    """Options of the commands that take a result and its rasters once more."""
    target = option("-o", "--output", type=FILE, required=True, **output)
    overwrite = knob_option(WriteOptions, "overwrite")
    return [*under("Output", *own, target, overwrite), *run_options(threads=False)]


def check_output(result: Path, rasters: tuple[str, ...], given: dict[str, Any]) -> None:
    """Refuse an output that cannot be written, before anything is read."""
    from geodelreg.writing import input_paths
    from geodelreg_cli.outputs import check_targets

    inputs = [str(result), *map(str, input_paths(rasters, given["allow"]))]
    check_targets(inputs, [given["output"]], given["overwrite"])


OPTIONS = again_options(
    metavar="FILE.html", help="The page: one file, which needs no network; - is stdout."
)


@command(EPILOG, OPTIONS)
@click.argument("result", metavar="RESULT.json", type=FILE)
@click.argument("rasters", metavar="MS... PAN", nargs=-1, required=True)
def report(result: Path, rasters: tuple[str, ...], **given: Any) -> None:
    """Make a page to look at, out of a result and the rasters that it tells of.

    RESULT.json is what "geodelreg align --report RESULT.json" has written, refused or not. MS and
    PAN are the rasters of then; others are refused.
    """
    start_run(given)
    sources, reference = ms_and_pan(rasters)
    from geodelreg.geotiff.atomic import write_text_atomically
    from geodelreg.report.again import read_again
    from geodelreg.report.html import check_jinja
    from geodelreg.report.page import page

    check_jinja(given["output"].name)
    check_output(result, rasters, given)
    alignment = read_again(result, sources, reference, given["allow"])
    write_text_atomically(given["output"], page(alignment), given["overwrite"])
