"""Grey values to 8 bit, for the keypoint detector."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geodelreg.errors import NoDataError
from geodelreg.values.raster import Band, BoolArray

MAX_SAMPLES = 250_000  # of which the 0.5th percentile is known to 0.014 %
FULL_SCALE = 255.0  # of 8 bit
_PERCENT = (0.5, 99.5)  # outliers in half a percent; by hand: ½ to 2 × alike
_LEAST_SAMPLES = 1000  # by hand: ½ to 2 × alike
_MASK_SIZE = 5  # of OpenCV's distance transform: the nearest that is precise to 2 %


def to_uint8(band: Band) -> NDArray[np.uint8]:
    """Stretch a band to 8 bit between the percentiles 0.5 and 99.5 of its valid pixels.

    Those are of at most about 250 000 pixels on a regular lattice.  Invalid pixels take the value
    of the nearest valid one, so that their border makes no edge.

    Parameters
    ----------
    band : Band

    Returns
    -------
    (H, W) uint8

    Raises
    ------
    NoDataError
        If no pixel is valid or all valid pixels are equal.
    """
    low, high = _stretch_limits(band)
    scale = FULL_SCALE / (high - low)
    stretched = np.clip((band.data - np.float32(low)) * np.float32(scale), 0.0, FULL_SCALE)
    grey = np.rint(stretched).astype(np.uint8)
    return grey if band.valid.all() else _fill_from_nearest(grey, band.valid)


def _stretch_limits(band: Band) -> tuple[float, float]:
    step = max(1, int(np.sqrt(band.data.size / MAX_SAMPLES)))
    sample = band.data[::step, ::step][band.valid[::step, ::step]]
    if sample.size < min(_LEAST_SAMPLES, band.data.size):
        sample = band.data[band.valid]
    if sample.size == 0:
        raise NoDataError(
            f"{_name(band)} has no valid pixel", "Check its no-data value and its mask."
        )
    low, high = (float(v) for v in np.percentile(sample, _PERCENT))
    if not high > low:
        values = band.data[band.valid]
        low, high = float(values.min()), float(values.max())
    if not high > low:
        raise NoDataError(
            f"{_name(band)} is constant ({low:g})",
            "Nothing can be matched on it: use another band.",
        )
    return low, high


def _fill_from_nearest(grey: NDArray[np.uint8], valid: BoolArray) -> NDArray[np.uint8]:
    """Replace invalid pixels by (about) the nearest valid one."""
    _, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, _MASK_SIZE, labelType=cv2.DIST_LABEL_PIXEL
    )
    value_of_label = np.zeros(int(labels.max()) + 1, dtype=np.uint8)
    value_of_label[labels[valid]] = grey[valid]
    return np.asarray(value_of_label[labels], dtype=np.uint8)


def _name(band: Band) -> str:
    return band.name or "The band"
