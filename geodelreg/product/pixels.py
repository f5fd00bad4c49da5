"""What describes an output's pixels, and the copying of pixels that are resampled when read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.geotiff import compare, metadata
from geodelreg.values.raster import BoolArray, Grid

_BLOCK_PX = 256
_NOT_CARRIED = metadata.GDAL_DOMAINS | {"GEOLOCATION"}

Parts = Sequence[Sequence[Any]]
"""Smooth parts of a raster, each resampled as asked, and its flags by nearest neighbour."""


@dataclass(frozen=True, slots=True)
class Validity:
    """How pixels without a value are marked: by a value, by the alpha band, or by a mask."""

    nodata: float | None = None
    alpha_band: int | None = None

    @property
    def is_mask(self) -> bool:
        """Neither a value nor the alpha band."""
        return self.nodata is None and self.alpha_band is None

    def missing(self, data: NDArray[Any]) -> BoolArray:
        """(B or 1, H, W) where (B, H, W) pixels have no value; of a mask it is the last band."""
        if self.nodata is None:
            band = data[-1 if self.alpha_band is None else self.alpha_band - 1]
            return np.asarray(band == 0)[None]
        return np.isnan(data) if math.isnan(self.nodata) else np.asarray(data == self.nodata)

    @classmethod
    def of(cls, dataset: Any) -> Validity:
        """How an open raster marks them."""
        from rasterio.enums import ColorInterp, MaskFlags

        if dataset.count > 1 and dataset.colorinterp[-1] is ColorInterp.alpha:
            return cls(alpha_band=dataset.count)
        if MaskFlags.per_dataset in dataset.mask_flag_enums[0]:
            return cls()
        if dataset.nodata is not None:
            return cls(nodata=dataset.nodata)
        is_float = all(np.issubdtype(np.dtype(name), np.floating) for name in dataset.dtypes)
        return cls(nodata=math.nan) if is_float else cls()


def grid_of(dataset: Any) -> Grid:
    """Where an open raster lies."""
    return Grid(dataset.transform, dataset.shape, dataset.crs.to_wkt())


def geotiff_on(grid: Grid) -> dict[str, Any]:
    """How a GeoTIFF is made that lies on a grid."""
    height, width = grid.shape
    return {
        "driver": "GTiff",
        "height": height,
        "width": width,
        "crs": grid.crs_wkt,
        "transform": grid.transform,
        "bigtiff": "IF_SAFER",
    }


def profile_of(view: Any, grid: Grid, validity: Validity) -> dict[str, Any]:
    """How a GeoTIFF of a raster's pixels is made on a grid."""
    from rasterio.enums import ColorInterp

    kinds = {np.dtype(compare.numpy_type(name)).kind for name in view.dtypes}
    predictor = {"f": "3", "i": "2", "u": "2"}.get(kinds.pop()) if len(kinds) == 1 else None
    photometric = {
        (ColorInterp.red, ColorInterp.green, ColorInterp.blue): "RGB",
        (ColorInterp.palette,): None,
    }.get(view.colorinterp[:3], "MINISBLACK")
    return geotiff_on(grid) | {
        "count": view.count,
        "dtype": view.dtypes[0],
        "nodata": validity.nodata,
        "tiled": "YES",
        "blockxsize": str(_BLOCK_PX),
        "blockysize": str(_BLOCK_PX),
        "compress": "DEFLATE",
        "predictor": predictor or "1",
        "interleave": view.interleaving.value if view.interleaving else "pixel",
        **({"photometric": photometric} if photometric else {}),
    }


def annotate(view: Any, dataset: Any, numbers: Sequence[int] | None = None) -> None:
    """Give the output what describes the bands, apart from statistics of the old pixels.

    Parameters
    ----------
    view, dataset : rasterio datasets
    numbers : sequence of int, optional
        Of the bands that the output has; all.
    """
    numbers = view.indexes if numbers is None else numbers

    def of(values: Sequence[Any]) -> list[Any]:
        return [values[number - 1] for number in numbers]

    if view.dtypes[0] in ("uint8", "uint16"):
        _copy_colormaps(view, dataset, numbers)
    dataset.colorinterp = of(view.colorinterp)
    dataset.descriptions = of(metadata.descriptions(view))
    dataset.scales, dataset.offsets = of(view.scales), of(view.offsets)
    units = metadata.attribute(view, "units") or [""] * view.count
    dataset.units = [unit or "" for unit in of(units)]
    for place, band in enumerate((0, *numbers)):
        domains = metadata.domains(view, band) - _NOT_CARRIED
        for domain in sorted(name for name in domains if not name.startswith("xml:")):
            items = metadata.tags(view, band, domain)
            kept = {k: v for k, v in items.items() if not k.startswith("STATISTICS_")}
            dataset.update_tags(place, ns=domain or None, **kept)


def _copy_colormaps(view: Any, dataset: Any, numbers: Sequence[int]) -> None:
    for place, band in enumerate(numbers, 1):
        colormap = metadata.colormap(view, band)
        if colormap is not None:
            dataset.write_colormap(place, colormap)


def copy_pixels(
    layers: Sequence[tuple[Sequence[int], Parts]],
    flags: Sequence[int],
    dataset: Any,
    validity: Validity,
) -> None:
    """Copy window by window, bands that lie together at a time.

    A mask that all bands share shows where each of them has a pixel.
    """
    for window in compare.windows_of(dataset):
        data = None
        for numbers, parts in layers:
            here = _merged(parts, flags, validity, window)
            if data is None:
                data = here
                continue
            for number in numbers:
                data[number - 1] = here[number - 1]
            if validity.is_mask:
                data[-1] = np.minimum(data[-1], here[-1])
        assert data is not None
        dataset.write(data[: dataset.count], window=window)
        if validity.is_mask:
            dataset.write_mask(data[-1] != 0, window=window)


def _merged(parts: Parts, flags: Sequence[int], validity: Validity, window: Any) -> NDArray[Any]:
    """(B, H, W) pixels; of parts that overlap the first that has a pixel gives it."""
    data: NDArray[Any] | None = None
    for warped, *nearest in parts:
        here = warped.read(window=window)
        for flat in nearest:
            here[[number - 1 for number in flags]] = flat.read(list(flags), window=window)
        data = here if data is None else np.where(validity.missing(data), here, data)
    assert data is not None
    return data
