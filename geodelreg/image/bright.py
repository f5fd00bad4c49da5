"""Bright objects that may be clouds: they move between the images, the ground does not."""

from __future__ import annotations

import cv2
import numpy as np

from geodelreg.types import Band, BoolArray

_BINS = 256
_GROWTH_PX = 5
_SEPARATION = 3.5
_LEAST_SPREAD = 1e-4


def bright_threshold(band: Band) -> float | None:
    """Value that splits an image into a dark and a clearly separate bright class (Otsu 1979).

    Parameters
    ----------
    band : Band

    Returns
    -------
    float or None
        None when there is no such split.
    """
    values = band.data[band.valid]
    if len(values) < 256:
        return None
    low, high = np.percentile(values, [0.5, 99.5])
    if not high - low > _LEAST_SPREAD * max(abs(low), abs(high)):
        return None
    counts, edges = np.histogram(values, bins=_BINS, range=(float(low), float(high)))
    share = np.cumsum(counts) / max(int(counts.sum()), 1)
    centre = (edges[:-1] + edges[1:]) / 2
    mean = np.cumsum(counts * centre) / max(int(counts.sum()), 1)
    between = (mean[-1] * share - mean) ** 2 / np.maximum(share * (1 - share), 1e-9)
    best = int(np.argmax(between[:-1]))
    bright = 1.0 - share[best]
    threshold = float(edges[best + 1])
    dark = values[values <= threshold]
    apart = float(values[values > threshold].mean() - dark.mean()) if 0 < bright < 1 else 0.0
    if not 0.01 < bright < 0.9 or apart < _SEPARATION * float(dark.std()):
        return None
    return threshold


def bright_mask(band: Band) -> BoolArray | None:
    """(H, W) True on bright objects and near them; None when there are none."""
    threshold = bright_threshold(band)
    if threshold is None:
        return None
    bright = (band.data > threshold) & band.valid
    side = 2 * _GROWTH_PX + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.dilate(bright.astype(np.uint8), kernel) > 0)
