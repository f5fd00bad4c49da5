"""MS whose bands lie apart: one file per band, or a VRT that puts each where it lies."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

from affine import Affine

from geodelreg.door.opening import open_raster
from geodelreg.errors import UsageError
from geodelreg.geotiff import compare, metadata
from geodelreg.geotiff.atomic import write_text_atomically
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.options import WriteOptions
from geodelreg.product.pixels import Validity, annotate, grid_of, profile_of
from geodelreg.values.result import Correction

_PLACE_PX = 1e-9  # a pixel that is further from a whole one than this is resampled


def band_targets(path: Path, folder: Path) -> dict[int, Path]:
    """Output of each band of a file, by its number there; that of a single band keeps the name."""
    with open_raster(path) as dataset:
        names = metadata.descriptions(dataset)
    if len(names) == 1:
        return {1: folder / path.name}
    words = [re.sub(r"\W+", "_", name or "").strip("_") for name in names]
    if not all(words) or len(set(words)) < len(words):
        words = [f"band{number}" for number in range(1, len(names) + 1)]
    return {n: folder / f"{path.stem}_{word}.tif" for n, word in enumerate(words, 1)}


def write_band(
    path: Path,
    number: int,
    target: Path,
    correction: Correction,
    tags: Mapping[str, str],
    options: WriteOptions,
) -> list[str]:
    """Write one band of a file with a header of its own and the same pixels; return warnings.

    Parameters
    ----------
    path, target : Path
    number : int
        Of the band, from 1.
    correction : Correction
        Of the band.
    tags : mapping of str to str
        Provenance.
    options : WriteOptions
    """
    with _alone(path, number) as source:
        return write_corrected(source, target, correction, (), tags, options)


@contextmanager
def _alone(path: Path, number: int) -> Iterator[Path]:
    """A GeoTIFF of one band; of a file that has no other the file itself."""
    import rasterio
    from rasterio.enums import MaskFlags

    with open_raster(path) as dataset:
        if dataset.count == 1:
            yield path
            return
        with TemporaryDirectory() as folder:
            alone, validity = Path(folder) / f"{path.stem}.tif", Validity.of(dataset)
            profile = profile_of(dataset, grid_of(dataset), validity)
            profile |= {"count": 1, "dtype": dataset.dtypes[number - 1]}
            profile |= {"photometric": "MINISBLACK"}
            with rasterio.open(alone, "w", **profile) as out:
                for window in compare.windows_of(out):
                    out.write(dataset.read(number, window=window), 1, window=window)
                    if validity.is_mask and dataset.mask_flag_enums[0] != [MaskFlags.all_valid]:
                        out.write_mask(dataset.dataset_mask(window=window), window=window)
                annotate(dataset, out, [number])
            yield alone


def write_vrt(
    path: Path, target: Path, common: Affine, bands: Mapping[int, Affine], options: WriteOptions
) -> None:
    """Write a VRT of a file whose bands are resampled, when read, to where they lie.

    Parameters
    ----------
    path, target : Path
    common : Affine
        Geotransform of the VRT.
    bands : mapping of int to Affine
        Geotransforms of bands, from 1; the others have the common one.
    options : WriteOptions
        Its resampling is the bands'.

    Raises
    ------
    UsageError
        A band is more than shifted.
    """
    import rasterio.shutil
    from rasterio.io import MemoryFile

    with open_raster(path) as dataset, MemoryFile(ext=".vrt") as plain:
        rasterio.shutil.copy(dataset, plain.name, driver="VRT")
        root = ElementTree.fromstring(plain.read())
    transform = root.find("GeoTransform")
    assert transform is not None
    transform.text = ", ".join(map(repr, common.to_gdal()))
    for element in root.iter("SourceFilename"):
        element.set("relativeToVRT", "1")
        element.text = os.path.relpath(os.path.realpath(path), os.path.realpath(target.parent))
    for band in root.findall("VRTRasterBand"):
        placed = bands.get(int(band.get("band", "0")))
        if placed is None:
            continue
        step = ~common @ placed
        if not (step @ Affine.translation(-step.c, -step.f)).almost_equals(Affine.identity()):
            raise UsageError(
                "a VRT holds bands that are shifted, and no other ones",
                "Use `band_model='shift'`, a folder, or `warp=True`.",
            )
        for source in band.findall("SimpleSource"):
            _shift(source, step, options.resampling)
    write_text_atomically(target, ElementTree.tostring(root, "unicode"), options.overwrite)


def _shift(source: ElementTree.Element, step: Affine, resampling: str) -> None:
    """Move a source within its band, resampled unless by whole pixels."""
    there = source.find("DstRect")
    assert there is not None
    moves = {"xOff": step.c, "yOff": step.f}
    for name, move in moves.items():
        there.set(name, repr(float(there.get(name, "0")) + move))
    if any(abs(move - round(move)) > _PLACE_PX for move in moves.values()):
        source.set("resampling", resampling)
