"""The corrected raster: pixels bit by bit those of the source, a new header.

A GeoTIFF is copied with its encoded blocks as they are and gets a new directory; everything else
is written anew through GDAL and compared with the source before it appears.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from geodelreg.door.names import is_local
from geodelreg.door.opening import open_raster
from geodelreg.errors import RasterUnreadableError, UsageError
from geodelreg.geotiff import compare, metadata, sidecars
from geodelreg.geotiff.atomic import staged
from geodelreg.geotiff.copying import open_source
from geodelreg.geotiff.environment import gdal_failures, gdal_session
from geodelreg.geotiff.header import Provenance
from geodelreg.geotiff.rewrite import output_driver, rewrite
from geodelreg.geotiff.srs import keep, spatial_reference
from geodelreg.geotiff.targets import check_not_input
from geodelreg.geotiff.tiffwrite import copy_with_header, is_cog
from geodelreg.options import WriteOptions
from geodelreg.tiff import is_tiff
from geodelreg.values.points import Gcp
from geodelreg.values.result import Correction

_REWRITTEN_PX = 1e-4
"""Some formats keep georeferencing as text."""


def write_corrected(
    source: Path,
    target: Path,
    correction: Correction,
    gcps: Sequence[Gcp],
    tags: Mapping[str, str],
    options: WriteOptions,
) -> list[str]:
    """Write the source raster with its corrected geotransform and the same pixels.

    Parameters
    ----------
    source, target : Path
        `target` appears whole or not at all; its stale side files go away with it.
    correction : Correction
        ``corrected`` is the geotransform of the output.
    gcps : sequence of Gcp
        Kept as JSON in the metadata domain ``GEODELREG``; with ``options.georef == "gcps"`` they
        place the output instead of the geotransform.
    tags : mapping of str to str
        Provenance, ``GEODELREG_*``.
    options : WriteOptions

    Returns
    -------
    list of str
        Warnings: what could not be kept.

    Raises
    ------
    OutputExistsError, OutputIsInputError, OutputUnwritableError, FileLockedError
    LossyOutputError
        The format or its options would change pixels.
    RasterNotFoundError, RasterUnreadableError
        The source is missing or broken.
    UsageError
        GCPs are asked for and there are none, or the format of `target` is unknown.
    """
    if options.georef == "gcps" and not gcps:
        raise UsageError("There are no ground control points to write", "Use the geotransform.")
    content = Provenance(correction, gcps, tags, options.georef, options.strip_rpc)
    check_not_input(target, [source])
    with gdal_session(source):
        check_source(source)
        reference = spatial_reference(source)
        stale = sidecars.stale_beside(Path(os.path.realpath(target)), source)
        with staged(target, overwrite=options.overwrite, stale=stale) as out:
            if _is_copied(source, target, options):
                copy_with_header(source, out, content)
                notes = sidecars.carry(source, out, options.strip_rpc)
                tolerance_px, copied = compare.EXACT_PX, True
            else:
                notes = rewrite(source, out, target, content, options)
                tolerance_px, copied = _REWRITTEN_PX, False
            notes += keep(reference, out, target)
            compare.check_placement(out, target, content, tolerance_px)
            notes += _losses(source, out, content, copied)
    return notes


def check_source(source: Path) -> None:
    """Refuse a source that GDAL does not open.

    Raises
    ------
    RasterNotFoundError, RasterUnreadableError
    """
    if is_local(str(source)):
        open_source(source).close()
    try:
        open_raster(source).close()
    except gdal_failures() as error:
        raise RasterUnreadableError(
            f"{source} is not a raster that GDAL reads: {error}", "Check the file."
        ) from error


def _is_copied(source: Path, target: Path, options: WriteOptions) -> bool:
    """Whether the encoded blocks can go over as they are."""
    if options.creation_options or not is_tiff(source):
        return False
    driver = output_driver(target, options.driver)
    return driver == "GTiff" or (driver == "COG" and is_cog(source))


def _losses(source: Path, out: Path, content: Provenance, copied: bool) -> list[str]:
    lost = compare.metadata_differences(source, out, copied, content.strip_rpc)
    notes = [f"{source.name}: not kept in the output: {what}" for what in lost]
    if metadata.has_rpc(out):
        notes.append(
            f"{source.name}: the output keeps RPCs, which do not know the correction; "
            "`strip_rpc=True` drops them"
        )
    return notes
