"""``geodelreg figure``: one figure, out of a JSON report and its rasters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from geodelreg.errors import UsageError
from geodelreg.options import FIGURES
from geodelreg_cli.options import FILE, SectionOption, command, ms_and_pan, option, start_run
from geodelreg_cli.report import again_options, check_output

EPILOG = """\
Examples:

  What the correction leaves, as arrows for a paper:
    geodelreg align ms.tif pan.tif -o aligned.tif --report result.json
    geodelreg figure result.json ms.tif pan.tif --kind arrows -o arrows.svg
"""


def kind_option(name: str) -> SectionOption:
    """Option that says what a figure shows."""
    return option(
        name,
        type=click.Choice(FIGURES),
        default="matches",
        show_default=True,
        help="before-after: MS and PAN in turns, and one laid over the other; arrows: what the "
        "correction leaves at the tie points; mesh: their Delaunay mesh, and rejected points by "
        "reason; error: maps of the residual and of the standard error; matches: tie points joined "
        "between both images, after the paper's Figure 5.",
    )


OPTIONS = again_options(
    kind_option("--kind"),
    metavar="FILE.png",
    help="PNG, SVG or PDF, by the extension; - is stdout, as PNG.",
)


@command(EPILOG, OPTIONS)
@click.argument("result", metavar="RESULT.json", type=FILE)
@click.argument("rasters", metavar="MS... PAN", nargs=-1, required=True)
def figure(result: Path, rasters: tuple[str, ...], **given: Any) -> None:
    """Draw one figure, out of a result and the rasters that it tells of.

    RESULT.json is what "geodelreg align --report RESULT.json" has written, refused or not. MS and
    PAN are the rasters of then; others are refused. Needs matplotlib (the report extra).
    """
    start_run(given)
    sources, reference = ms_and_pan(rasters)
    from geodelreg.product.figures import check_drawable
    from geodelreg.report.again import read_again
    from geodelreg.report.figures import draw_figure

    output = given["output"]
    try:
        check_drawable(output)
    except UsageError as error:
        raise click.UsageError(str(error)) from error
    check_output(result, rasters, given)
    alignment = read_again(result, sources, reference, given["allow"])
    draw_figure(alignment, given["kind"], output, given["overwrite"])
