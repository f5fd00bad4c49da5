"""Averaging down by any ratio, piece by piece, with exact shares for pixels cut by a border."""

from __future__ import annotations

import numpy as np

from geodelreg.types import BoolArray, Float32Array, FloatArray, IntArray


class BoxAverage:
    """Average of the valid pixels inside each cell of a coarser grid.

    Pieces of the finer raster are added in any order; each pixel counts in a cell with the share
    of its area that lies inside, so that cells of a non-integer size are exact.

    Parameters
    ----------
    bands : int
    shape : tuple of int
        ``(height, width)`` of the coarser grid.
    origin : tuple of float
        ``(column, row)`` of the coarser grid's outer corner, in finer pixels.
    size : tuple of float
        ``(width, height)`` of the coarser grid, in finer pixels.  Cells are at least one finer
        pixel wide and high.
    """

    def __init__(
        self,
        bands: int,
        shape: tuple[int, int],
        origin: tuple[float, float],
        size: tuple[float, float],
    ) -> None:
        height, width = shape
        self._origin = origin
        self._ratio = (size[0] / width, size[1] / height)
        self._counts = (width, height)
        self._sum = np.zeros((bands, height, width))
        self._area = np.zeros((bands, height, width))

    def add(self, data: Float32Array, valid: BoolArray | None, column: int, row: int) -> None:
        """Add the piece whose upper-left pixel is (`column`, `row`) of the finer raster.

        Parameters
        ----------
        data : (B, h, w) float32
            0 where `valid` is False.
        valid : (B, h, w) bool or None
            None stands for all valid.
        column, row : int
        """
        rows = _Cells(row, data.shape[1], self._origin[1], self._ratio[1], self._counts[1])
        columns = _Cells(column, data.shape[2], self._origin[0], self._ratio[0], self._counts[0])
        target = (slice(None), rows.cells, columns.cells)
        if valid is None:
            data_sum = columns.fold(rows.fold(data, 1), 2)
            area = np.multiply.outer(rows.areas(), columns.areas())[None]
        else:
            data_sum = columns.fold(rows.fold(data, 1), 2)
            area = columns.fold(rows.fold(valid.astype(np.float32), 1), 2)
        self._sum[target] += data_sum
        self._area[target] += area

    def result(self) -> tuple[Float32Array, BoolArray]:
        """Averages (B, H, W) float32 and (B, H, W) bool, True where half the cell was valid."""
        valid = self._area >= 0.5 * self._ratio[0] * self._ratio[1] * (1 - 1e-6)
        data = np.zeros(self._sum.shape, dtype=np.float32)
        np.divide(self._sum, self._area, out=data, where=valid, casting="unsafe")
        return data, valid


class _Cells:
    """Cells along one axis that a run of finer pixels falls into."""

    def __init__(self, start: int, length: int, origin: float, ratio: float, count: int) -> None:
        edge = (np.arange(start, start + length) - origin) / ratio
        first = np.floor(edge + 1e-9).astype(np.intp)
        # share of each pixel in its first cell; the rest is in the next one
        share = np.minimum((first + 1 - edge) * ratio, 1.0)
        share[share > 1 - 1e-6] = 1.0
        self._low = int(first[0])
        self._high = int(first[-1]) + 1
        self._starts: IntArray = np.flatnonzero(np.diff(first, prepend=first[0] - 1))
        self._first = first - self._low
        self._split: IntArray = np.flatnonzero(share < 1.0)
        self._rest = 1.0 - share[self._split]
        self._inside = slice(max(-self._low, 0), min(count, self._high + 1) - self._low)
        self.cells = slice(max(self._low, 0), min(count, self._high + 1))

    def areas(self) -> FloatArray:
        """(n,) float64 pixels that fall into each of `cells`."""
        ones = np.ones((1, len(self._first), 1), dtype=np.float32)
        return self.fold(ones, 1)[0, :, 0].astype(np.float64)

    def fold(self, data: Float32Array, axis: int) -> Float32Array:
        """Sum `data` (3-D) along `axis` into `cells`."""
        moved = list(data.shape)
        moved[axis] = self._high - self._low + 1
        out = np.zeros(moved, dtype=np.float32)
        out_along, data_along = out.swapaxes(0, axis), data.swapaxes(0, axis)
        cells = self._first[self._starts]
        if axis == data.ndim - 1:
            out[..., cells] = np.add.reduceat(data, self._starts, axis=axis)
        else:
            stops = np.append(self._starts[1:], data.shape[axis])
            for cell, begin, end in zip(cells, self._starts, stops, strict=True):
                data_along[begin:end].sum(axis=0, out=out_along[cell])
        if len(self._split):
            rest = self._rest.astype(np.float32).reshape(-1, 1, 1) * data_along[self._split]
            at = self._first[self._split]
            out_along[at] -= rest
            out_along[at + 1] += rest
        return out_along[self._inside].swapaxes(0, axis)
