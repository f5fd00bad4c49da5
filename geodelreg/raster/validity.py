"""Which pixels of a raster are good: no-data values, masks, alpha and NaN."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.values.raster import BoolArray

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

# GDAL compares floating-point no-data values with this relative tolerance
_FLOAT_TOLERANCE = 4 * float(np.finfo(np.float32).eps)


def alpha_bands(dataset: DatasetReader) -> tuple[int, ...]:
    """1-based numbers of the bands that are transparency, not image."""
    from rasterio.enums import ColorInterp

    return tuple(
        number
        for number, meaning in enumerate(dataset.colorinterp, start=1)
        if meaning == ColorInterp.alpha
    )


def bands_with_mask(dataset: DatasetReader) -> frozenset[int]:
    """1-based numbers of the bands that have a mask of their own (internal or ``.msk``)."""
    from rasterio.enums import MaskFlags

    return frozenset(
        number
        for number, flags in enumerate(dataset.mask_flag_enums, start=1)
        if MaskFlags.alpha not in flags and (MaskFlags.per_dataset in flags or not flags)
    )


def differs_from_nodata(data: NDArray[Any], nodata: float | None) -> BoolArray | None:
    """Where values are not the no-data value.

    Parameters
    ----------
    data : (...) of the raster's own type
    nodata : float or None

    Returns
    -------
    (...) bool, or None when no finite value can be no-data
    """
    if nodata is None or not math.isfinite(nodata):
        return None
    if data.dtype.kind in "iu":
        whole = np.iinfo(data.dtype)
        if nodata != int(nodata) or not whole.min <= nodata <= whole.max:
            return None
        differs = data != data.dtype.type(int(nodata))
    else:
        limits = np.finfo(data.dtype)
        margin = _FLOAT_TOLERANCE * abs(nodata) if data.dtype.itemsize <= 4 else 0.0
        low = max(nodata - margin, float(limits.min))
        high = min(nodata + margin, float(limits.max))
        differs = (data < low) | (data > high)
    return np.asarray(differs, dtype=np.bool_)
