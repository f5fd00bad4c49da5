"""Averaging down by any ratio, piece by piece, with exact shares for pixels cut by a border."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geodelreg.values.raster import BoolArray, Float32Array, FloatArray, IntArray


class Share(NamedTuple):
    """What a piece adds to the cells of a coarser grid.

    Attributes
    ----------
    cells : tuple of slice
        Rows and columns.
    total : (B, h, w) float32
        Sums over the piece's pixels.
    area : (B, h, w) or (1, h, w) float
        Numbers of valid pixels; one plane serves all bands.  Both are (1, 1, 1) where they are 0.
    """

    cells: tuple[slice, slice]
    total: Float32Array
    area: Float32Array | FloatArray


class BoxAverage:
    """Average of the valid pixels inside each cell of a coarser grid.

    Pieces of the finer raster are added in any order.  A pixel that a cell border cuts is shared
    by area, and its two parts take the slope between its neighbours into account (second-order
    conservative remapping, Dukowicz & Kodis 1987, doi:10.1137/0908037), so that linear ramps come
    out exact at any ratio.

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
        self._area = np.zeros((1, height, width))

    def add(self, data: Float32Array, valid: BoolArray | None, column: int, row: int) -> None:
        """Add a piece; parameters as of `share`."""
        self.take(self.share(data, valid, column, row))

    def share(self, data: Float32Array, valid: BoolArray | None, column: int, row: int) -> Share:
        """What the piece whose upper-left pixel is (`column`, `row`) adds; threads may ask.

        Parameters
        ----------
        data : (B, h, w) float32
            0 where `valid` is False.
        valid : (B, h, w) bool or None
            None stands for all valid.
        column, row : int
            In pixels of the finer raster.
        """
        rows = _Cells(row, data.shape[1], self._origin[1], self._ratio[1], self._counts[1])
        columns = _Cells(column, data.shape[2], self._origin[0], self._ratio[0], self._counts[0])
        cells, nothing = (rows.cells, columns.cells), np.zeros((1, 1, 1), dtype=np.float32)
        if valid is not None and not valid.any():
            return Share(cells, nothing, nothing)
        if valid is None:
            total = columns.fold(rows.fold(data, None, 1), None, 2) if data.any() else nothing
            area = np.multiply.outer(rows.areas(), columns.areas())[None]
            return Share(cells, total, area)
        share = valid.astype(np.float32)
        row_area = rows.fold(share, None, 1, constant=True)
        total = columns.fold(rows.fold(data, share, 1), row_area, 2)
        return Share(cells, total, columns.fold(row_area, None, 2, constant=True))

    def take(self, share: Share) -> None:
        """Add what a piece amounts to."""
        if len(share.area) > len(self._area):
            self._area = np.repeat(self._area, len(self._sum), axis=0)
        self._area[:, *share.cells] += share.area
        self._sum[:, *share.cells] += share.total

    def result(self) -> tuple[Float32Array, BoolArray]:
        """Averages (B, H, W) float32 and (B, H, W) bool, True where half the cell was valid."""
        valid = self._area >= 0.5 * self._ratio[0] * self._ratio[1] * (1 - 1e-6)
        data = np.zeros(self._sum.shape, dtype=np.float32)
        np.divide(self._sum, self._area, out=data, where=valid, casting="unsafe")
        return data, np.broadcast_to(valid, data.shape).copy()


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
        self._share = share[self._split]
        self._inside = slice(max(-self._low, 0), min(count, self._high + 1) - self._low)
        self.cells = slice(max(self._low, 0), min(count, self._high + 1))

    def areas(self) -> FloatArray:
        """(n,) float64 pixels that fall into each of `cells`."""
        ones = np.ones((1, len(self._first), 1), dtype=np.float32)
        return self.fold(ones, None, 1, constant=True)[0, :, 0].astype(np.float64)

    def fold(
        self, total: Float32Array, area: Float32Array | None, axis: int, constant: bool = False
    ) -> Float32Array:
        """Sum along an axis into `cells`.

        Parameters
        ----------
        total : 3-D float32
            Sums over pixels.
        area : 3-D float32 or None
            Numbers of pixels behind them; None when they are all equal.
        axis : int
            1 (rows) or 2 (columns).
        constant : bool
            The two parts of a cut pixel have the same value, whatever its neighbours.
        """
        shape = list(total.shape)
        shape[axis] = self._high - self._low + 1
        out = np.zeros(shape, dtype=np.float32)
        out_along, along = out.swapaxes(0, axis), total.swapaxes(0, axis)
        cells = self._first[self._starts]
        if axis == total.ndim - 1:
            out[..., cells] = np.add.reduceat(total, self._starts, axis=axis)
        else:  # ten times faster than reduceat
            self._sum_rows(along, out_along, cells)
        if len(self._split):
            slope = None if constant else _slopes(along, area, self._split, axis)
            rest = self._beyond_border(along[self._split], slope)
            at = self._first[self._split]
            out_along[at] -= rest
            out_along[at + 1] += rest
        return out_along[self._inside].swapaxes(0, axis)

    def _sum_rows(self, along: Float32Array, out: Float32Array, cells: IntArray) -> None:
        """Sums of runs of rows: run by run, or, of many short ones, row by row of all runs."""
        lengths = np.diff(self._starts, append=len(along))
        longest = int(lengths.max())
        if 3 * longest >= len(cells):
            for cell, begin, length in zip(cells, self._starts, lengths, strict=True):
                along[begin : begin + length].sum(axis=0, out=out[cell])
            return
        sums = along[self._starts]
        for row in range(1, longest):
            more = lengths > row
            if more.all():
                sums += along[self._starts + row]
            else:
                sums[more] += along[self._starts[more] + row]
        out[cells] = sums

    def _beyond_border(self, cut: Float32Array, slope: Float32Array | None) -> Float32Array:
        """The part of cut pixels that falls into the next cell."""
        share = self._share.astype(np.float32).reshape(-1, 1, 1)
        rest: Float32Array = (1 - share) * cut
        if slope is not None:
            rest += 0.5 * share * (1 - share) * slope
        return rest


def _slopes(
    along: Float32Array, area: Float32Array | None, at: IntArray, axis: int
) -> Float32Array:
    """Change of `along` per pixel at some pixels; 0 where a neighbour is not valid."""
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, len(along) - 1)
    distance = np.maximum(after - before, 1).astype(np.float32).reshape(-1, 1, 1)
    if area is None:
        return np.asarray((along[after] - along[before]) / distance)
    weight = area.swapaxes(0, axis)
    known = (weight[before] > 0) & (weight[at] > 0) & (weight[after] > 0)
    safe = [np.where(known, weight[index], 1) for index in (before, after)]
    change = along[after] / safe[1] - along[before] / safe[0]
    return np.asarray(np.where(known, change * weight[at], 0) / distance, dtype=np.float32)
