"""``geodelreg gcps``: control points from one file format to another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from geodelreg.errors import shown
from geodelreg.options import AlignOptions
from geodelreg_cli.console import configure_logging
from geodelreg_cli.options import (
    GCP_FORMAT,
    RUN,
    SectionCommand,
    add_options,
    keep_to,
    knob_option,
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


@add_options([knob_option(AlignOptions, "allow", RUN)])
@click.command(cls=SectionCommand, epilog=EPILOG)
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.argument("target", metavar="OUT", type=click.Path(path_type=Path))
@click.option(
    "--raster",
    required=True,
    metavar="MS",
    help="Raster that the points belong to, with its original georeferencing.",
)
@click.option(
    "--reference", metavar="PAN", help="Raster that the map coordinates come from (for ENVI)."
)
@click.option("--from", "from_format", type=GCP_FORMAT, help="Format of IN, if not by extension.")
@click.option("--to", "to_format", type=GCP_FORMAT, help="Format of OUT, if not by extension.")
@click.option("--overwrite", is_flag=True, help="Replace OUT when it exists.")
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.")
@click.option("-v", "--verbose", count=True, help="Print the steps; -vv everything.")
@click.option("--debug", is_flag=True, help="Print a traceback with an error.")
def gcps(
    source: Path,
    target: Path,
    raster: str,
    reference: str | None,
    from_format: str | None,
    to_format: str | None,
    overwrite: bool,
    quiet: bool,
    verbose: int,
    debug: bool,
    allow: str,
) -> None:
    """Convert the ground control points of file IN to file OUT; - is stdout and needs --to.

    Pixel conventions are converted exactly (QGIS and ENVI count differently from GDAL), and map
    coordinates in another system than that of MS are transformed into it.
    """
    configure_logging(verbose, quiet, debug)
    keep_to(allow)
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
    points, crs_wkt = read_gcps(source, from_format, context)
    points = in_crs_of(context.source, points, crs_wkt)
    rasters = [raster] if reference is None else [raster, reference]
    with allowing(allow), together(inputs=lambda: [source, *input_paths(rasters, allow)]):
        write_gcps(target, points, to_format, context=context, overwrite=overwrite)
    if not quiet:
        click.echo(f"{shown(str(target))}: {len(points)} points", err=True)
