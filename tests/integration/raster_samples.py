"""TIFFs of every encoding for the tests of outputs, and an independent look at their bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import tifffile
from affine import Affine
from rasterio.enums import ColorInterp
from rasterio.shutil import copy as gdal_copy

from geodelreg.values.points import Gcp
from geodelreg.values.result import Correction

UTM18 = "EPSG:32618"
TRANSFORM = Affine(2.0, 0.0, 500_000.0, 0.0, -2.0, 4_000_000.0)
TAGS = {"GEODELREG_VERSION": "0.1.0", "GEODELREG_SOURCE": 'ms <"é"> & co.tif'}
GCPS = [
    Gcp("1", 10.5, 20.25, 500_021.0, 3_999_959.5),
    Gcp("2", 130.0, 44.0, 500_260.0, 3_999_912.0, info='at the "<mill>" & bridge'),
    Gcp("3", 50.0, 150.0, 500_100.0, 3_999_700.0),
]
SHIFT = Affine.translation(1.25, -3.5)
ROTATION = Affine.translation(7.0, 11.0) @ Affine.rotation(2.0)
TILES = {"tiled": True, "blockxsize": 64, "blockysize": 64}

ENCODINGS: dict[str, dict[str, Any]] = {
    "striped": {"compress": None},
    "striped-lzw": {"compress": "lzw"},
    "tiled": {"compress": None, **TILES},
    "tiled-deflate": {"compress": "deflate", "predictor": 2, **TILES},
    "zstd": {"compress": "zstd", **TILES},
    "planar": {"compress": "deflate", "interleave": "band", **TILES},
    "bigtiff": {"compress": "deflate", "bigtiff": "yes", **TILES},
    "big-endian": {"compress": "lzw", "endianness": "big"},
    "big-endian-bigtiff": {"compress": "lzw", "endianness": "big", "bigtiff": "yes"},
    "jpeg": {"compress": "jpeg", "photometric": "ycbcr", "dtype": "uint8", "count": 3, **TILES},
    "webp": {"compress": "webp", "dtype": "uint8", "count": 3, **TILES},
    "sparse": {"compress": "deflate", "sparse_ok": True, **TILES},
    "12-bit": {"compress": "deflate", "nbits": 12, **TILES},
}


def make_tiff(
    path: Path,
    encoding: str = "tiled-deflate",
    *,
    transform: Affine | None = TRANSFORM,
    shape: tuple[int, int] = (190, 210),
    mask: str | None = None,
    overviews: str | None = None,
    **profile: Any,
) -> Path:
    """Write a TIFF with all the metadata that must survive.

    `mask` and `overviews` are None, "internal" or "external".
    """
    settings = {"driver": "GTiff", "dtype": "uint16", "count": 4, "crs": UTM18}
    settings |= {"height": shape[0], "width": shape[1], **ENCODINGS[encoding], **profile}
    if transform is not None:
        settings["transform"] = transform
    count, dtype = settings["count"], settings["dtype"]
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=mask == "internal"),
        rasterio.open(path, "w", **settings) as dataset,
    ):
        if encoding != "sparse":
            dataset.write(texture((count, *shape), dtype))
        if mask is not None:
            valid = np.full(shape, 255, dtype=np.uint8)
            valid[: shape[0] // 4, :50] = 0
            dataset.write_mask(valid)
        annotate(dataset)
        if overviews == "internal":
            dataset.build_overviews([2, 4])
    if overviews == "external":
        with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(path, "r+") as dataset:
            dataset.build_overviews([2, 4])
    return path


def make_cog(path: Path, encoding: str = "tiled-deflate", **options: Any) -> Path:
    """Write a cloud optimised GeoTIFF with overviews and a mask."""
    plain = make_tiff(path.with_suffix(".plain.tif"), encoding, shape=(300, 400), mask="internal")
    creation = {"BLOCKSIZE": "128", "COMPRESS": "DEFLATE", **options}
    gdal_copy(plain, path, driver="COG", **creation)
    plain.unlink()
    return path


def texture(shape: tuple[int, ...], dtype: str) -> np.ndarray[Any, Any]:
    """Smooth values with noise, the same in every run."""
    bands, height, width = shape
    rows, columns = np.mgrid[:height, :width]
    noise = np.random.default_rng(3).integers(0, 30, shape)
    values = (
        90 + 60 * np.sin(columns / 9) * np.cos(rows / 7) + noise + np.arange(bands)[:, None, None]
    )
    return values.astype(dtype)


def annotate(dataset: Any) -> None:
    """Give an open dataset every kind of metadata."""
    named = [ColorInterp.blue, ColorInterp.green, ColorInterp.red, ColorInterp.undefined]
    if dataset.count == 4:
        dataset.colorinterp = named
    dataset.update_tags(MISSION="Test & <Sat> é", TIFFTAG_DATETIME="2020:01:02 03:04:05")
    dataset.update_tags(ns="PRODUCT", LEVEL="L1")
    for band in dataset.indexes:
        dataset.set_band_description(band, f"B{band}")
        dataset.update_tags(band, WAVELENGTH=str(400 + band))
        dataset.update_tags(band, ns="CALIBRATION", GAIN=str(band))
    dataset.scales = [0.1 * band for band in dataset.indexes]
    dataset.offsets = [float(band) for band in dataset.indexes]
    dataset.units = ["W/m2"] * dataset.count


def correction_of(path: Path, change: Affine = SHIFT) -> Correction:
    """Correction of a raster's header, `change` acting on pixels of its grid."""
    with rasterio.open(path) as dataset:
        moved = dataset.transform @ change
        return Correction("affine", dataset.crs.to_wkt(), dataset.transform, moved)


def encoded_blocks(path: Path) -> list[list[bytes]]:
    """Encoded blocks of every image in a TIFF, as tifffile finds them."""
    with tifffile.TiffFile(path) as tiff:
        return [
            [
                _read(tiff.filehandle, offset, count)
                for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)
            ]
            for page in tiff.pages
        ]


def _read(file: Any, offset: int, count: int) -> bytes:
    file.seek(offset)
    data: bytes = file.read(count)
    assert len(data) == count
    return data


def description(path: Path) -> dict[str, Any]:
    """All that GDAL says about a raster apart from where it lies and where it came from."""
    with rasterio.open(path) as dataset:
        bands = dataset.indexes
        own = {"DERIVED_SUBDATASETS", "GEODELREG"}
        return {
            "profile": {
                k: v for k, v in dataset.profile.items() if k not in ("transform", "nodata")
            },
            "nodata": repr(dataset.nodatavals),
            "dtypes": dataset.dtypes,
            "blocks": dataset.block_shapes,
            "photometric": dataset.photometric,
            "masks": dataset.mask_flag_enums,
            "overviews": [dataset.overviews(b) for b in bands],
            "colorinterp": dataset.colorinterp,
            "descriptions": dataset.descriptions,
            "scales": (dataset.scales, dataset.offsets, dataset.units),
            "colormaps": [colormap(dataset, b) for b in bands],
            "tags": {
                (band, domain): without_provenance(dataset.tags(band, ns=domain or None))
                for band in (0, *bands)
                for domain in ["", *(d for d in dataset.tag_namespaces(band) if d not in own)]
            },
        }


def without_provenance(tags: dict[str, str]) -> dict[str, str]:
    return {key: value for key, value in tags.items() if not key.startswith("GEODELREG_")}


def colormap(dataset: Any, band: int) -> Any:
    try:
        return dataset.colormap(band)
    except ValueError:
        return None


def pixels(path: Path, level: int | None = None) -> tuple[Any, Any]:
    """Decoded values and masks, of an overview level if given."""
    options = {} if level is None else {"OVERVIEW_LEVEL": level}
    with rasterio.open(path, **options) as dataset:
        return dataset.read(), dataset.read_masks()


def assert_same_pixels(first: Path, second: Path, level: int | None = None) -> None:
    for a, b in zip(pixels(first, level), pixels(second, level), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def transform_of(path: Path) -> Affine:
    with rasterio.open(path) as dataset:
        return dataset.transform
