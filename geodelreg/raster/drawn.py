"""What is drawn on a raster, as labels and stripes are, is left out when that is asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geodelreg.raster.raster_file import RasterFile
from geodelreg.values.drawn import drawn_values
from geodelreg.values.raster import Float32Array, FloatArray, Window

_LOOKS, _LOOK_PX = 8, 32
"""Windows along either axis, and their side: 65 536 pixels, as many as `geodelreg.values.drawn`
wants to see."""


def leave_out_drawn(files: Sequence[RasterFile], name: str) -> str:
    """Take what is drawn on all image bands for no data.

    Parameters
    ----------
    files : sequence of RasterFile
        Of one image.
    name : str
        Its name.

    Returns
    -------
    str
        What is left out from now on; empty when nothing is.
    """
    found = [_drawn_on(file) for file in files]
    if not all(found):
        return ""
    for file, drawn in zip(files, found, strict=True):
        file.drawn = drawn
    every = np.unique(np.concatenate([values for of in found for values in of.values()]))
    listed = " and ".join(f"{value:g}" for value in every)
    return f"what is drawn on {name} with the value {listed} is left out"


def _drawn_on(file: RasterFile) -> dict[int, FloatArray]:
    """Values that are drawn on each image band, by its number; empty unless on all of them."""
    if file.block_note:
        return {}
    height, width = file.grid.shape
    down, across = min(_LOOK_PX, height), min(_LOOK_PX, width)
    rows, columns = (
        np.unique(np.linspace(0, length - side, _LOOKS).astype(int)).tolist()
        for length, side in ((height, down), (width, across))
    )
    seen: dict[int, list[Float32Array]] = {number: [] for number in file.image_bands}
    for row in rows:
        for column in columns:
            data, valid = file.read(file.image_bands, Window(column, row, across, down))
            for number, values, good in zip(file.image_bands, data, valid, strict=True):
                seen[number].append(values[good])
    found = {number: drawn_values(np.concatenate(values)) for number, values in seen.items()}
    return found if all(map(len, found.values())) else {}
