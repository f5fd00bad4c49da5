"""``geodelreg refit``: the correction through control points that a person has edited."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geodelreg.options import AlignOptions, WriteOptions
from geodelreg_cli.options import (
    FILE,
    GCP_FORMAT,
    build,
    command,
    flag,
    knob_option,
    knob_options,
    option,
    run_options,
    start_run,
    under,
)
from geodelreg_cli.results import output_options, request_of, run

if TYPE_CHECKING:
    from geodelreg.alignment import Alignment
    from geodelreg.pair import Progress

KNOBS = (
    "model", "north_up", "tolerance_px", "max_shift_px", "max_rotation_deg", "max_scale",
    "band", "pan_band", "masks", "pan_masks", "ms_nodata", "pan_nodata",
)  # fmt: skip
"""The second line matters to --snap alone."""

EPILOG = """\
Examples:

  Write all tie points, edit them in QGIS, and correct MS by what is left:
    geodelreg align ms.tif pan.tif --dry-run --points all --gcps points.geojson
    geodelreg refit points.geojson ms.tif pan.tif -o aligned.tif

  Measure the points that were drawn or moved, where PAN shows what MS does:
    geodelreg refit points.geojson ms.tif pan.tif -o aligned.tif --snap

  Points of the QGIS georeferencer, without PAN, and a field through them:
    geodelreg refit ms.points ms.tif --model field -o warped.tif --warp

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 refused (nothing written, the reason on stderr).
"""


FROM = option(
    "--from", "from_format", type=GCP_FORMAT, help="Format of POINTS, if not by extension."
)
OPTIONS = [
    *output_options(),
    *under(
        "How to fit",
        flag(
            "--snap",
            help="Measure points that were drawn, added or moved by hand, by matching what is "
            "around them in MS and PAN. Needs PAN.",
        ),
        FROM,
        *(knob_option(AlignOptions, name) for name in KNOBS),
    ),
    *under("How OUT is written", *knob_options(WriteOptions, without=["overwrite"])),
    *run_options(),
]


@command(EPILOG, OPTIONS)
@click.argument("file", metavar="POINTS", type=FILE)
@click.argument("source", metavar="MS")
@click.argument("reference", metavar="[PAN]", required=False)
def refit(file: Path, source: str, reference: str | None, **given: Any) -> None:
    """Correct MS by control points of a file, which a person may have edited.

    POINTS is a file of --gcps: points may be disabled, moved, added. MS has to be the raster that
    they were made for, with its original header. Who edits points answers for them: nothing is
    searched, and accuracy is that of points against each other. Without PAN, lengths are in pixels
    of MS. OUT is written as by align.
    """
    start_run(given)
    from geodelreg.report.output import is_page

    request = request_of((source,), reference, given, build(AlignOptions, given), file)
    if given["snap"] and reference is None:
        raise click.UsageError("--snap measures points on PAN: name PAN, the last argument.")
    if reference is None and (request.figure or any(map(is_page, request.report))):
        raise click.UsageError("--figure and pages show MS on PAN: name PAN, the last argument.")

    def find(progress: Progress) -> Alignment:
        import geodelreg

        return geodelreg.refit(
            file,
            source,
            reference,
            request.options,
            format=given["from_format"],
            snap=given["snap"],
            progress=progress,
        )

    run(request, find)
