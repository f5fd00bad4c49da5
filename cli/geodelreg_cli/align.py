"""``geodelreg align``: parse, align, write what was asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from geodelreg.options import AlignOptions, WriteOptions, one_header
from geodelreg_cli.options import (
    build,
    command,
    is_default,
    knob_options,
    ms_and_pan,
    run_options,
    start_run,
    under,
)
from geodelreg_cli.results import Request, carries_all, output_options, request_of, run

if TYPE_CHECKING:
    from geodelreg.alignment import Alignment
    from geodelreg.pair import Progress

EPILOG = """\
Examples:

  Correct the header of MS; pixels stay bit-identical:
    geodelreg align ms.tif pan.tif -o aligned.tif

  Edit the header of the file itself (undo it with "geodelreg revert"):
    geodelreg align ms.tif pan.tif --in-place

  One file per band, one correction for all of them; OUT is a folder:
    geodelreg align B2.tif B3.tif B4.tif B8.tif -o aligned/

  Leave out the clouds that the Landsat quality band knows of:
    geodelreg align ms.tif pan.tif -o aligned.tif --mask LC08_..._QA_PIXEL.TIF

  Also write the control points for QGIS and GDAL, a report and a figure:
    geodelreg align ms.tif pan.tif -o aligned.tif --gcps ms.points \\
        --gcps ms.geojson --report aligned.html --figure aligned.png

  Look before you write, and pick one number out of the result:
    geodelreg align ms.tif pan.tif --dry-run --json | jq .accuracy

  Bands that lie apart, each by itself: one file per band, or one resampled raster:
    geodelreg align ms.tif pan.tif --per-band -o bands/
    geodelreg align ms.tif pan.tif --per-band -o aligned.tif --warp

  Resample onto the grid of PAN instead of correcting the header:
    geodelreg align ms.tif pan.tif -o aligned.tif --warp --grid pan

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 refused (nothing written, the reason on stderr).
"""


OPTIONS = [
    *output_options(),
    *under("How to align", *knob_options(AlignOptions, without=["threads", "allow"])),
    *under("How OUT is written", *knob_options(WriteOptions, without=["overwrite"])),
    *run_options(),
]


@command(EPILOG, OPTIONS)
@click.argument("rasters", metavar="MS... PAN", nargs=-1, required=True)
def align(rasters: tuple[str, ...], **given: Any) -> None:
    """Correct the georeferencing of MS so that it fits PAN.

    MS is a multispectral raster, or several files with one band each; PAN, the last argument, is
    the raster to fit to. Both need a coordinate reference system and a geotransform; the two
    systems may differ. OUT is MS with a corrected header: same pixels, same tags. An alignment
    that the images do not support is refused, and nothing is written.
    """
    start_run(given)
    request = _request(rasters, given)

    def find(progress: Progress) -> Alignment:
        import geodelreg

        return geodelreg.align(request.sources, rasters[-1], request.options, progress=progress)

    run(request, find)


def _request(rasters: tuple[str, ...], given: dict[str, Any]) -> Request:
    sources, reference = ms_and_pan(rasters)
    options = build(AlignOptions, given)
    request = request_of(sources, reference, given, options)
    if options.per_band and request.in_place:
        raise one_header()
    if carries_all(request.write_options) and is_default("on_local"):
        return replace(request, options=replace(options, on_local="field"))
    return request
