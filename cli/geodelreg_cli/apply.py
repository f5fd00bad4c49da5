"""``geodelreg apply``: a correction that was found before, for other files of the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from geodelreg.errors import shown
from geodelreg.options import AlignOptions, WriteOptions
from geodelreg_cli.console import warn
from geodelreg_cli.options import (
    FILE,
    RUN,
    build,
    command,
    flag,
    knob_option,
    knob_options,
    message_options,
    option,
    start_run,
    under,
)

EPILOG = """\
Examples:

  The same correction for the mask and the 20 m bands of a scene; OUT is a folder:
    geodelreg align ms.tif pan.tif -o aligned.tif --report correction.json
    geodelreg apply correction.json mask.tif B05.tif B06.tif -o aligned/

  A field, which no header holds, resampled onto the grid of PAN:
    geodelreg apply correction.json mask.tif -o mask_on_pan.tif --warp --grid pan -r nearest

  Tie points or field boundaries that were drawn on MS:
    geodelreg apply correction.json fields.geojson -o fields_aligned.geojson

Exit codes: 0 done, 1 failed, 2 wrong usage.
"""


OPTIONS = [
    option(
        "-o",
        "--output",
        type=FILE,
        metavar="OUT",
        help="Output; of several files the folder for them.",
    ),
    flag("--in-place", help="Correct the headers of the files themselves."),
    flag("--force", help="Also where a file lies elsewhere than MS did, or was corrected before."),
    *message_options(),
    *under("How OUT is written", *knob_options(WriteOptions, without=["georef"])),
    *under(RUN, knob_option(AlignOptions, "allow")),
]


@command(EPILOG, OPTIONS)
@click.argument("correction", metavar="CORRECTION.json", type=FILE)
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=FILE)
def apply(correction: Path, files: tuple[Path, ...], **given: Any) -> None:
    """Apply the correction in a report of align to other files with the same error.

    Rasters of any pixel size and CRS get a corrected header and keep their pixels, or are resampled
    (--warp). GeoJSON, GeoPackage and CSV files (columns lon,lat, or x,y in the CRS of MS) get
    corrected coordinates. Of several files all are written or none. After align --per-band, each
    band of a raster is put where it lies: OUT is a folder, a .vrt, or resampled (--warp).
    """
    start_run(given)
    output, in_place = given["output"], given["in_place"]
    if (output is None) != in_place:
        raise click.UsageError("Say where the result goes: one of -o OUT, --in-place.")
    options = build(WriteOptions, given | {"georef": "geotransform"})
    if in_place and options != WriteOptions():
        raise click.UsageError("--in-place corrects the header and nothing else.")
    import geodelreg
    from geodelreg.geotiff.atomic import together
    from geodelreg.product.stored import read_correction
    from geodelreg_cli.outputs import raster_targets

    apart = not options.warp and bool(read_correction(correction).bands)
    targets = [] if output is None else raster_targets(list(map(str, files)), output, apart)
    if output is not None and any(target.parent == output for target in targets):
        output.mkdir(parents=True, exist_ok=True)
    with together(files if in_place else targets, lambda: [correction, *files]):
        for number, file in enumerate(files):
            target = output if apart or output is None else targets[number]
            notes = geodelreg.apply(
                correction, file, target, options, force=given["force"], allow=given["allow"]
            )
            warn(notes)
            if not given["quiet"]:
                click.echo(f"{shown(str(target or file))}: corrected", err=True)
