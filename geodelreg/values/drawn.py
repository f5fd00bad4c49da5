"""Values that are drawn on a raster: of labels, collars, stripes, logos and dead pixels."""

from __future__ import annotations

import numpy as np

from geodelreg.values.raster import Float32Array, FloatArray

SAMPLES = 60_000  # of each image: a drawn value is then seen a hundred times
_LEAST_SHARE = 0.002
"""Of the pixels that one value must have: twelve small labels have ten times as many."""
_SPIKE = 8.0
"""Times as frequent as the values beside it: of ground, neighbours are about as frequent, also in
eight bit, where a sensor is stretched, or where little is shown."""
_BESIDE = 8  # values on either side that occur


def drawn_values(seen: Float32Array) -> FloatArray:
    """Values that occur far more often than those beside them.

    Parameters
    ----------
    seen : (N,) float32
        Some valid pixels of one band.
    """
    value, count = np.unique(seen, return_counts=True)
    if not len(value):
        return np.empty(0)
    total = np.concatenate([[0], np.cumsum(count)])
    index = np.arange(len(value))
    low, high = np.maximum(index - _BESIDE, 0), np.minimum(index + _BESIDE + 1, len(value))
    beside = (total[high] - total[low] - count) / np.maximum(high - low - 1, 1)
    return np.asarray(
        value[(count >= _LEAST_SHARE * len(seen)) & (count > _SPIKE * beside)], dtype=np.float64
    )
