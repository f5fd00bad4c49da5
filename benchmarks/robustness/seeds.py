"""Small sound rasters of many layouts, of which the fuzz cases make broken ones."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from affine import Affine
from numpy.typing import NDArray
from rasterio.control import GroundControlPoint
from rasterio.errors import NotGeoreferencedWarning

PAN_SIDE, RATIO = 80, 4
UTM = "EPSG:32618"
TRUE = Affine(4.0, 0.0, 500_000.0, 0.0, -4.0, 4_000_000.0)
TILES = {"tiled": True, "blockxsize": 16, "blockysize": 16}


@dataclass(frozen=True, slots=True)
class Seed:
    """A sound raster: its files by name, the first of which is the raster itself."""

    name: str
    files: Mapping[str, bytes]

    @property
    def main(self) -> str:
        """Name of the raster."""
        return next(iter(self.files))


LAYOUTS: dict[str, dict[str, Any]] = {
    "striped": {},
    "striped-lzw": {"compress": "lzw", "predictor": 2},
    "one-strip": {"compress": "deflate", "blockysize": PAN_SIDE},
    "packbits": {"compress": "packbits", "dtype": "uint8"},
    "tiled": TILES,
    "tiled-deflate": {"compress": "deflate", "predictor": 2, **TILES},
    "zstd": {"compress": "zstd", **TILES},
    "lzma": {"compress": "lzma"},
    "lerc": {"compress": "lerc", "dtype": "float32", **TILES},
    "planar": {"compress": "deflate", "interleave": "band", **TILES},
    "bigtiff": {"compress": "deflate", "bigtiff": "yes", **TILES},
    "big-endian": {"compress": "lzw", "endianness": "big"},
    "big-endian-bigtiff": {"endianness": "big", "bigtiff": "yes"},
    "jpeg": {"compress": "jpeg", "photometric": "ycbcr", "dtype": "uint8", "count": 3, **TILES},
    "webp": {"compress": "webp", "dtype": "uint8", "count": 3, **TILES},
    "12-bit": {"compress": "deflate", "nbits": 12},
    "sparse": {"compress": "deflate", "sparse_ok": True, **TILES},
    "float": {"compress": "deflate", "predictor": 3, "dtype": "float32", "nodata": np.nan},
    "double": {"dtype": "float64", "nodata": -1e300},
    "signed": {"dtype": "int16", "nodata": -9999},
    "degrees": {"crs": "EPSG:4326", "transform": Affine(4e-5, 0, -75.0, 0, -4e-5, 36.0)},
    "rotated": {"transform": TRUE @ Affine.rotation(20.0)},
    "gcps-only": {"transform": None},
    "internal-mask": {"compress": "deflate", **TILES},
    "external-mask": {"compress": "deflate"},
    "internal-overviews": {"compress": "deflate", **TILES},
    "external-overviews": {"compress": "deflate"},
    "world-file": {"transform": None},
    "pam": {"transform": None, "crs": None},
    "png": {"driver": "PNG", "dtype": "uint8", "count": 3, "worldfile": "yes"},
}


def make_seeds(is_pan: bool, pan_side: int = PAN_SIDE) -> list[Seed]:
    """Sound rasters of all layouts.

    Parameters
    ----------
    is_pan : bool
        One band on the reference grid; else four bands, four times coarser and 3 px off.
    pan_side : int
        Pixels of the reference.
    """
    seeds = []
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        for layout, profile in LAYOUTS.items():
            folder = Path(name, layout)
            folder.mkdir()
            seeds.append(_collected(layout, _write(folder, layout, profile, is_pan, pan_side)))
        folder = Path(name, "derived")
        folder.mkdir()
        plain = _write(folder, "tiled-deflate", LAYOUTS["tiled-deflate"], is_pan, pan_side)
        cog, vrt = folder / "cog.tif", folder / "view.vrt"
        rasterio.shutil.copy(plain, cog, driver="COG", blocksize=128)
        rasterio.shutil.copy(plain, vrt, driver="VRT")
        seeds.append(Seed("cog", {"ms.tif": cog.read_bytes()}))
        files = {"ms.vrt": vrt.read_bytes(), plain.name: plain.read_bytes()}
        seeds.append(Seed("vrt", files))
    return seeds


def _collected(layout: str, path: Path) -> Seed:
    others = sorted(p for p in path.parent.iterdir() if p != path)
    return Seed(layout, {p.name: p.read_bytes() for p in (path, *others)})


def _write(
    folder: Path, layout: str, profile: Mapping[str, Any], is_pan: bool, pan_side: int
) -> Path:
    options: dict[str, Any] = {
        "driver": "GTiff",
        "dtype": "uint16",
        "count": 4,
        "crs": UTM,
        "transform": TRUE,
    }
    options |= profile
    if is_pan:
        options["count"] = 3 if layout in ("jpeg", "webp") else 1
    data = _pixels(options["count"], is_pan, pan_side).astype(options["dtype"])
    options["height"], options["width"] = data.shape[1:]
    if options.get("blockysize") == PAN_SIDE:
        options["blockysize"] = data.shape[1]
    if options["transform"] is not None and not is_pan:
        options["transform"] @= Affine.translation(3, -2) @ Affine.scale(RATIO)
    if layout == "gcps-only":
        options["gcps"] = _gcps(data.shape[1])
    path = folder / ("ms.png" if options["driver"] == "PNG" else "ms.tif")
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=layout == "internal-mask"),
        rasterio.open(path, "w", **options) as dataset,
    ):
        dataset.write(data)
        if layout.endswith("mask"):
            valid = np.full(data.shape[1:], 255, dtype=np.uint8)
            valid[:4, :6] = 0
            dataset.write_mask(valid)
        if layout == "internal-overviews":
            dataset.build_overviews([2, 4])
    _add_side_files(path, layout)
    return path


def _add_side_files(path: Path, layout: str) -> None:
    if layout == "external-overviews":
        with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(path, "r+") as dataset:
            dataset.build_overviews([2, 4])
    if layout == "world-file":
        path.with_suffix(".tfw").write_text("16\n0\n0\n-16\n500020\n3999992\n")
    if layout == "pam":
        wkt = rasterio.crs.CRS.from_string(UTM).to_wkt()
        path.with_name("ms.tif.aux.xml").write_text(
            f"<PAMDataset><SRS>{wkt.replace('&', '&amp;')}</SRS>"
            "<GeoTransform>500012, 16, 0, 4000008, 0, -16</GeoTransform>"
            '<Metadata><MDI key="A">b</MDI></Metadata></PAMDataset>'
        )


def _gcps(side: int) -> list[GroundControlPoint]:
    corners = [(0, 0), (0, side), (side, 0), (side, side)]
    return [GroundControlPoint(r, c, 5e5 + 16 * c, 4e6 - 16 * r, 0) for r, c in corners]


def _pixels(count: int, is_pan: bool, pan_side: int) -> NDArray[np.float64]:
    """Smooth noise that both images show, 20 to 235."""
    noise = np.random.default_rng(7).normal(size=(pan_side + 40, pan_side + 40))
    ground = cv2.GaussianBlur(noise, (0, 0), 1.5) + 2 * cv2.GaussianBlur(noise, (0, 0), 5)
    ground = np.clip(127 + 45 * ground / ground.std(), 20, 235)
    if is_pan:
        return np.repeat(ground[None, 20:-20, 20:-20], count, axis=0)
    # the header of MS says (3, -2) PAN pixels, its content lies at (0, 0)
    blocks = ground[20:-20, 20:-20].reshape(pan_side // RATIO, RATIO, pan_side // RATIO, RATIO)
    bands = np.linspace(0.8, 1.0, count)[:, None, None]
    return np.asarray(blocks.mean(axis=(1, 3))[None] * bands)
