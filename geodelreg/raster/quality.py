"""Quality bands: what their values, and those of other masks, mean.

Landsat Collection 2 ``QA_PIXEL`` (USGS LSDS-1619, table 6-2) has a bit for each finding and two
bits for the confidence in some of them; the pattern 10 is used for clouds only.  Sentinel-2 ``SCL``
(Level-2A algorithm overview, ESA) is a class from 0 to 11.

Only what is not the ground is hidden: fill, clouds and their shadows.  Snow and water are ground
that lies still between the two images; where they show nothing nothing is matched anyway.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.masking import BINARY, LANDSAT_QA, SENTINEL2_SCL, VALUES, Ranges
from geodelreg.values.raster import BoolArray

# fill, dilated cloud, cirrus, cloud, cloud shadow
_LANDSAT_HIDDEN = 0b11111
_FILL, _CIRRUS, _CLOUD, _SHADOW, _SNOW = (1 << bit for bit in (0, 2, 3, 4, 5))
_MSS_BITS = _FILL | _CLOUD | 3 << 8
# no data, saturated or defective, cloud shadow, cloud (medium and high probability), thin cirrus
_SCL_HIDDEN = (0, 1, 3, 8, 9, 10)
_SCL_LAST = 11


def hidden_values(
    raw: NDArray[Any], kind: str, hide: Ranges = (), nodata: float | None = None
) -> BoolArray:
    """Where a mask's values hide a pixel.

    Parameters
    ----------
    raw : (H, W) of the mask's own type
    kind : str
        ``binary``, ``values``, ``landsat-qa`` or ``sentinel2-scl``.
    hide : ranges of values
        For ``values``.
    nodata : float, optional
        Of the mask; hides nothing in a ``binary`` one.

    Returns
    -------
    (H, W) bool
    """
    if kind == VALUES:
        chosen = np.zeros(raw.shape, dtype=np.bool_)
        for first, last in hide:
            chosen |= (raw >= first) & (raw <= last)
        return chosen
    if kind == BINARY:
        with np.errstate(invalid="ignore"):
            return np.asarray((raw != 0) & (raw == raw) & ~_is_nodata(raw, nodata))
    whole = _integers(raw)
    if kind == LANDSAT_QA:
        hidden = (whole & _LANDSAT_HIDDEN).astype(np.bool_)
        hidden |= whole == 0  # in no product; crops and warps put it where they have nothing
    else:
        hidden = np.logical_or.reduce([whole == value for value in _SCL_HIDDEN])
    if nodata is not None:
        hidden |= _is_nodata(raw, nodata)
    return np.asarray(hidden)


def impossible_values(raw: NDArray[Any], kind: str, nodata: float | None = None) -> BoolArray:
    """Where the values of a quality band are none that its producer writes.

    Parameters
    ----------
    raw : (H, W) of the band's own type
    kind : str
        ``landsat-qa`` or ``sentinel2-scl``.
    nodata : float, optional

    Returns
    -------
    (H, W) bool
    """
    whole = _integers(raw).astype(np.int64)
    if kind == SENTINEL2_SCL:
        absurd = (whole < 0) | (whole > _SCL_LAST)
    else:
        cloud, shadow, snow, cirrus = (whole >> shift & 3 for shift in (8, 10, 12, 14))
        absurd = (shadow == 2) | (snow == 2) | (cirrus == 2)
        absurd |= (whole & _CLOUD != 0) & (cloud < 2)
        for flag, confidence in ((_SHADOW, shadow), (_SNOW, snow), (_CIRRUS, cirrus)):
            absurd |= (whole & flag != 0) & (confidence != 3)
        # without confidences in shadow and snow it is of the MSS, which knows of clouds only
        absurd |= ((shadow == 0) | (snow == 0)) & (whole & ~_MSS_BITS != 0)
        # how sure it is of a cloud, or of none, is stated wherever the sensor has seen anything
        absurd |= (cloud == 0) & (whole != 0)
        absurd &= whole & _FILL == 0
        absurd |= (whole < 0) | (whole > 0xFFFF)
    absurd |= _is_fractional(raw)
    return np.asarray(absurd & ~_is_nodata(raw, nodata))


def _integers(raw: NDArray[Any]) -> NDArray[Any]:
    """Values as integers, which exports may have stored as floats; NaN becomes 0."""
    if raw.dtype.kind != "f":
        return raw
    return np.asarray(np.nan_to_num(raw, nan=0.0, posinf=-1.0, neginf=-1.0), dtype=np.int64)


def _is_fractional(raw: NDArray[Any]) -> BoolArray:
    if raw.dtype.kind != "f":
        return np.zeros(raw.shape, dtype=np.bool_)
    return np.asarray(np.isfinite(raw) & (raw != np.rint(raw)))


def _is_nodata(raw: NDArray[Any], nodata: float | None) -> BoolArray:
    if nodata is None:
        return np.zeros(raw.shape, dtype=np.bool_)
    return np.asarray(raw == nodata)
