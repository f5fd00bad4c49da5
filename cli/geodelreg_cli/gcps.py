"""``geodelreg gcps``: control points from one file format to another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geodelreg.errors import shown
from geodelreg.options import AlignOptions
from geodelreg_cli.options import (
    FILE,
    GCP_FORMAT,
    RUN,
    command,
    flag,
    knob_option,
    message_options,
    option,
    start_run,
    under,
)

if TYPE_CHECKING:
    from geodelreg.values.raster import Grid

EPILOG = """\
Examples:

  From a QGIS georeferencer file to the options of gdal_translate:
    geodelreg gcps ms.points ms.txt --raster ms.tif

  To ENVI, image to image, which also needs the reference:
    geodelreg gcps ms.geojson ms.pts --raster ms.tif --reference pan.tif

Formats: qgis (.points), gdal (.gcp, .txt: gdal_translate --optfile), csv (.csv: gdal raster edit),
geojson (.geojson, .json), gpkg (.gpkg), flatgeobuf (.fgb), vrt (.vrt), envi (.pts, image to image),
envi-map (image to map).
"""


OPTIONS = [
    option(
        "--raster",
        required=True,
        metavar="MS",
        help="Raster that the points belong to, with its original georeferencing.",
    ),
    option(
        "--reference", metavar="PAN", help="Raster that the map coordinates come from (for ENVI)."
    ),
    option("--from", "from_format", type=GCP_FORMAT, help="Format of IN, if not by extension."),
    option("--to", "to_format", type=GCP_FORMAT, help="Format of OUT, if not by extension."),
    flag("--overwrite", help="Replace OUT when it exists."),
    *message_options(),
    *under(RUN, knob_option(AlignOptions, "allow")),
]


@command(EPILOG, OPTIONS)
@click.argument("source", metavar="IN", type=FILE)
@click.argument("target", metavar="OUT", type=FILE)
def gcps(
    source: Path, target: Path, raster: str, reference: str | None, allow: str, **given: Any
) -> None:
    """Convert the ground control points of file IN to file OUT; - is stdout and needs --to.

    Pixel conventions are converted exactly (QGIS and ENVI count differently from GDAL), and map
    coordinates in another system than that of MS are transformed into it.
    """
    start_run({**given, "allow": allow})
    from geodelreg.door.opening import allowing
    from geodelreg.geotiff.atomic import together
    from geodelreg.product.gcps import GcpContext, in_crs_of, read_gcps, write_gcps
    from geodelreg.raster.reader import open_raster
    from geodelreg.writing import input_paths

    def grid(path: str) -> Grid:
        with open_raster(path, allow=allow) as reader:
            return reader.grid

    context = GcpContext(
        source=grid(raster),
        reference=None if reference is None else grid(reference),
        source_paths=(raster,),
        reference_path=reference or "",
    )
    points, crs_wkt = read_gcps(source, given["from_format"], context)
    points = in_crs_of(context.source, points, crs_wkt)
    rasters = [raster] if reference is None else [raster, reference]
    with allowing(allow), together(inputs=lambda: [source, *input_paths(rasters, allow)]):
        write_gcps(
            target, points, given["to_format"], context=context, overwrite=given["overwrite"]
        )
    if not given["quiet"]:
        click.echo(f"{shown(str(target))}: {len(points)} points", err=True)
