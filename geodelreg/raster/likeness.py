"""Which band of a raster of many stands for a panchromatic one."""

from __future__ import annotations

import numpy as np

from geodelreg.raster.reader import RasterReader
from geodelreg.values.raster import FloatArray, Window

_SIDE_PX = 256  # of what is looked at: its correlations are known to a hundredth
_MOST_BANDS = 12  # evenly spread
_LEAST_PIXELS = 64


def likest_band(reader: RasterReader) -> tuple[int, str]:
    """The band that resembles the others most, as a panchromatic image does, and what to say of it.

    Parameters
    ----------
    reader : RasterReader

    Returns
    -------
    number : int
        From 1.
    note : str
        Empty where there is one band.
    """
    names = reader.band_names
    count = len(names)
    if count == 1:
        return 1, ""
    height, width = reader.grid.shape
    part = min(1.0, _SIDE_PX / max(height, width))
    shape = max(round(height * part), 1), max(round(width * part), 1)
    numbers = np.linspace(1, count, min(count, _MOST_BANDS)).round().astype(int).tolist()
    bands = reader.read(numbers, Window(0, 0, width, height), shape)
    seen = np.logical_and.reduce([band.valid for band in bands])
    number = numbers[_likest(np.stack([band.data[seen] for band in bands]).astype(np.float64))]
    return number, (
        f"PAN has {count} bands: band {number} ({names[number - 1]}), which resembles the others "
        "most, was matched on"
    )


def _likest(values: FloatArray) -> int:
    """Row of (B, N) values with the largest mean correlation with the others, of either sign."""
    if values.shape[1] < _LEAST_PIXELS:
        return 0
    rows = values - values.mean(axis=1, keepdims=True)
    size = np.sqrt((rows**2).sum(axis=1))
    rows /= np.where(size > 0, size, 1.0)[:, None]
    return int(np.abs(rows @ rows.T).sum(axis=1).argmax())
