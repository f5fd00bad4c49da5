"""Chunks of lazy arrays, kept for a while: windows overlap, and a chunk is computed whole."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

KEPT_BYTES = 32_000_000
"""Half of what the cache of GDAL has (`geodelreg.raster.environment`), which decodes beneath."""

Fetch = Callable[[int, slice, slice], Any]
"""Pixels (h, w) of one band, counted from 0, of some rows and columns."""


class Chunks:
    """Windows of a chunked array, put together from chunks that were computed lately.

    Parameters
    ----------
    fetch : callable
        Computes a window.
    chunks : (sequence of int, sequence of int)
        Sizes of the chunks along rows and along columns.
    itemsize : int
        Bytes of a pixel.
    """

    def __init__(
        self, fetch: Fetch, chunks: tuple[Sequence[int], Sequence[int]], itemsize: int
    ) -> None:
        self._fetch = fetch
        self._edges = [[0, *accumulate(sizes)] for sizes in chunks]
        self._kept: OrderedDict[tuple[int, int, int], NDArray[Any]] = OrderedDict()
        largest = max(chunks[0], default=0) * max(chunks[1], default=0) * itemsize
        self._room = KEPT_BYTES // max(largest, 1)

    def __call__(self, band: int, rows: slice, columns: slice) -> Any:
        """Pixels (h, w) of a window of a band, counted from 0."""
        if self._room < 1:  # chunks so large are left to what cuts them
            return self._fetch(band, rows, columns)
        window: NDArray[Any] | None = None
        for row, (top, bottom) in _touched(self._edges[0], rows):
            for column, (left, right) in _touched(self._edges[1], columns):
                chunk = self._chunk(band, row, column)
                if window is None:
                    shape = (rows.stop - rows.start, columns.stop - columns.start)
                    window = np.empty(shape, dtype=chunk.dtype)
                y, x = self._edges[0][row], self._edges[1][column]
                window[top - rows.start : bottom - rows.start, left - columns.start :][
                    :, : right - left
                ] = chunk[top - y : bottom - y, left - x : right - x]
        return window

    def _chunk(self, band: int, row: int, column: int) -> NDArray[Any]:
        key = (band, row, column)
        if key not in self._kept:
            rows, columns = self._edges[0][row : row + 2], self._edges[1][column : column + 2]
            while len(self._kept) >= self._room:
                self._kept.popitem(last=False)
            self._kept[key] = np.asarray(self._fetch(band, slice(*rows), slice(*columns)))
        self._kept.move_to_end(key)
        return self._kept[key]


def _touched(edges: Sequence[int], span: slice) -> Iterator[tuple[int, tuple[int, int]]]:
    """Numbers of the chunks that a span touches, and from where to where."""
    first = int(np.searchsorted(edges, span.start, side="right")) - 1
    for number in range(first, len(edges) - 1):
        if edges[number] >= span.stop:
            return
        yield number, (max(edges[number], span.start), min(edges[number + 1], span.stop))
