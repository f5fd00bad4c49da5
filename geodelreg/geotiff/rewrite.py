"""Rasters written anew through GDAL: other formats, other creation options.

Nothing is believed: the decoded pixels are compared with the source before the output appears.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from geodelreg.door.formats import FORMATS, needed_for
from geodelreg.door.names import LOCAL, is_encodable, refuse
from geodelreg.door.opening import allowed, open_raster
from geodelreg.errors import LossyOutputError, OutputUnwritableError, UsageError
from geodelreg.geotiff import compare, metadata, sidecars
from geodelreg.geotiff.environment import gdal_failures
from geodelreg.geotiff.header import Provenance, merged_domains
from geodelreg.geotiff.tiffwrite import edit_private, is_tiled
from geodelreg.geotiff.view import corrected_view
from geodelreg.masking import flag_bands
from geodelreg.options import WriteOptions
from geodelreg.sharpen_options import PansharpenOptions
from geodelreg.tiff import is_tiff

logger = logging.getLogger(__name__)

_TIFF_DRIVERS = ("GTiff", "COG")
_LOSSLESS = ("DEFLATE", "LZW", "ZSTD", "LZMA", "PACKBITS")
_LOSSLESS_DEFAULTS = {
    "JP2OpenJPEG": {"QUALITY": "100", "REVERSIBLE": "YES"},
    "WEBP": {"LOSSLESS": "YES"},
}
_NOT_CARRIED = {"RPC"}


def output_driver(target: Path, driver: str | None) -> str:
    """GDAL driver of an output: as asked for, or by its extension, GTiff without one.

    Raises
    ------
    UsageError
        It is unknown.
    OutputUnwritableError
        GDAL cannot be given the name.
    LossyOutputError
        It makes many rasters of one.
    AccessNotAllowedError
        Files of that format can name others.
    """
    import rasterio
    from rasterio.drivers import raster_driver_extensions

    if not is_encodable(str(target)):
        raise OutputUnwritableError(
            f"{target} cannot be written by GDAL: its name is not UTF-8", "Choose another name."
        )
    if driver is None:
        extension = target.suffix.lstrip(".").lower()
        by_extension: dict[str, str] = {"": "GTiff", **raster_driver_extensions()}
        if extension not in by_extension:
            raise UsageError(
                f"{target}: no format is known for the extension .{extension}",
                "Name the format, e.g. `driver='GTiff'`.",
            )
        return _openable(target, by_extension[extension])
    with rasterio.Env() as env:
        there: set[str] = set(env.drivers())
    # of those that need more than is allowed, the command has left GDAL none
    wanted = {name.upper(): name for name in {*FORMATS, *there}}.get(driver.upper())
    if wanted is not None:
        _openable(target, wanted)
    if wanted not in there:
        raise UsageError(f"GDAL has no format {driver!r} here", "See gdalinfo --formats.")
    return wanted


def _openable(target: Path, driver: str) -> str:
    """The driver, if what it writes is one raster that may be opened again to be compared."""
    if driver == "netCDF":
        raise LossyOutputError(
            f"{target}: netCDF makes each band a raster of its own", "Choose another format."
        )
    needed = needed_for(driver)
    if needed not in (LOCAL, allowed()):
        raise refuse(f"{target}: files of the format {driver} can open others", needed)
    return driver


def rewrite(
    source: Path, out: Path, target: Path, content: Provenance, options: WriteOptions
) -> list[str]:
    """Write `source` to `out` in another format or with other creation options.

    Parameters
    ----------
    source, out : Path
    target : Path
        Final name, for messages.
    content : Provenance
    options : WriteOptions

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    LossyOutputError
        Decoded pixels or masks would differ.
    OutputUnwritableError, RasterUnreadableError, UsageError
    """
    driver = output_driver(target, options.driver)
    notes: list[str] = []
    if driver in _TIFF_DRIVERS:
        creation = _tiff_creation(source, driver, options, notes)
        _create_copy(source, str(source), out, target, driver, creation)
        edit_private(out, content, metadata.lost_metadata(source, out, _NOT_CARRIED))
        _clean_pam(out, content)
    else:
        with corrected_view(source, content) as (name, xml):
            if driver == "VRT":
                out.write_text(xml, encoding="utf-8")
            else:
                creation = _LOSSLESS_DEFAULTS.get(driver, {}) | user_creation(options)
                _create_copy(source, name, out, target, driver, creation)
        _complete_metadata(source, out, content)
    compare.check_pixels(source, out, target, overviews=driver in _TIFF_DRIVERS)
    return notes


def _create_copy(
    source: Path, name: str, out: Path, target: Path, driver: str, creation: Mapping[str, str]
) -> None:
    import rasterio.shutil

    logger.debug("%s: %s %s", target, driver, dict(creation))
    with gdal_write(source, target, driver), open_raster(name) as dataset:
        rasterio.shutil.copy(dataset, out, driver=driver, strict=False, **creation)


@contextmanager
def gdal_write(source: Path, target: Path, driver: str) -> Iterator[None]:
    """Tell whose fault it is when GDAL fails to write a raster from another.

    Raises
    ------
    RasterUnreadableError
        The source cannot be decoded.
    OutputUnwritableError
        It can, so the output cannot be written.
    """
    try:
        yield
    except gdal_failures() as error:
        compare.check_decodable(source)
        raise OutputUnwritableError(
            f"{target} cannot be written as {driver}: {error}",
            "Check the disk and the creation options, or choose another format.",
        ) from error


def user_creation(options: WriteOptions | PansharpenOptions) -> dict[str, str]:
    """Creation options of the user, by upper-case key."""
    pairs = (option.split("=", 1) for option in options.creation_options)
    return {key.strip().upper(): value.strip() for key, value in pairs}


def _tiff_creation(
    source: Path, driver: str, options: WriteOptions, notes: list[str]
) -> dict[str, str]:
    """Creation options: the user's, and for the rest the source's own encoding if it is a TIFF."""
    user = user_creation(options)
    creation = {"BIGTIFF": "IF_SAFER"}
    with open_raster(source) as dataset:
        names = metadata.descriptions(dataset)
        structure = metadata.tags(dataset, 0, "IMAGE_STRUCTURE")
        has_overviews = bool(dataset.overviews(1))
        inherited = dataset.driver in _TIFF_DRIVERS and is_tiff(source)
        blocks = dataset.block_shapes[0]
    if inherited:
        tiled = is_tiled(source)
        creation |= _inherited_compression(structure, driver, user, notes)
        if driver == "GTiff":
            creation["INTERLEAVE"] = structure.get("INTERLEAVE", "PIXEL")
            creation["TILED"] = "YES" if tiled else "NO"
            creation["BLOCKYSIZE"] = str(blocks[0])
            if tiled:
                creation["BLOCKXSIZE"] = str(blocks[1])
        elif tiled and blocks[0] == blocks[1]:
            creation["BLOCKSIZE"] = str(blocks[0])
    if driver == "COG" and "RESAMPLING" not in user and flag_bands(source.name, names):
        creation["OVERVIEW_RESAMPLING"] = "NEAREST"  # of those that GDAL adds
    if has_overviews and driver == "GTiff":
        creation["COPY_SRC_OVERVIEWS"] = "YES"
    if user.get("TILED", creation.get("TILED", "")).upper() != creation.get("TILED"):
        creation.pop("BLOCKXSIZE", None)
        creation.pop("BLOCKYSIZE", None)
    return creation | user


def _inherited_compression(
    structure: Mapping[str, str], driver: str, user: Mapping[str, str], notes: list[str]
) -> dict[str, str]:
    if "COMPRESS" in user:
        return {}
    compression = structure.get("COMPRESSION", "NONE")
    if compression == "NONE":
        return {"COMPRESS": "NONE"}
    if compression not in _LOSSLESS:
        notes.append(
            f"{compression} would be lossy when written anew; the output is compressed with DEFLATE"
        )
        return {"COMPRESS": "DEFLATE"}
    creation = {"COMPRESS": compression}
    predictor = structure.get("PREDICTOR", "1")
    if predictor != "1":
        # a damaged file may name any: COG then chooses none
        names = {"2": "STANDARD", "3": "FLOATING_POINT"}
        creation["PREDICTOR"] = predictor if driver == "GTiff" else names.get(predictor, "NO")
    return creation


def _clean_pam(out: Path, content: Provenance) -> None:
    """Take georeferencing out of a PAM file that GDAL has written beside the output."""
    pam = sidecars.pam_path(out)
    if pam.is_file():
        rest = sidecars.without_placement(pam.read_bytes(), content.strip_rpc)
        pam.unlink()
        if rest is not None:
            pam.write_bytes(rest)


def _complete_metadata(source: Path, out: Path, content: Provenance) -> None:
    """Put what the format has no place for into a PAM file."""
    with open_raster(out) as dataset:
        unsaid = {
            domain: items
            for domain, items in content.domains.items()
            if not items.items() <= metadata.tags(dataset, 0, domain).items()
        }
    missing = merged_domains(metadata.lost_metadata(source, out, _NOT_CARRIED)[0], unsaid)
    if missing:
        path = sidecars.pam_path(out)
        pam = path.read_bytes() if path.is_file() else None
        path.write_bytes(sidecars.with_metadata(pam, missing))
