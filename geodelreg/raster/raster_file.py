"""One open raster file: its image bands, its overviews, and pixels with their validity."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from geodelreg.door.names import is_local
from geodelreg.errors import RasterUnreadableError
from geodelreg.geo.grid import decimated_grid
from geodelreg.masking import quality_bands
from geodelreg.raster.decimate import BoxAverage, Share
from geodelreg.raster.environment import PIECES_BYTES, gdal_calls, passing_through
from geodelreg.raster.fill import undeclared_fill
from geodelreg.raster.inputs import Opened
from geodelreg.raster.overviews import Placement, find_placement
from geodelreg.raster.validity import alpha_bands, bands_with_mask, differs_from_nodata
from geodelreg.values.raster import BoolArray, Float32Array, FloatArray, Grid, Window

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

_PIECE_PIXELS = 1 << 20
"""Pixels (of all bands together) that a thread of a decimated read holds at a time, or a block."""

_WHOLE_BLOCK_PIXELS = 4 * _PIECE_PIXELS
"""Up to so many, a block is read whole: one that is cut is decoded for each of its parts."""

_MOST_THREADS = 4
_PIECES_PER_THREAD = 4
"""Fewer are read sooner than more handles of the file are opened."""

_LARGE_BLOCK_BYTES = 64_000_000

_LARGEST = 1e15
"""Larger values are fill that the header does not declare; their squares overflow."""


class RasterFile:
    """A raster file that passed all checks.

    Parameters
    ----------
    opened : Opened
    stack : ExitStack
        Closes its overviews when they were needed.

    Attributes
    ----------
    path : str
        Or the name of what is no file.
    grid : Grid
    image_bands : tuple of int
        1-based numbers of the bands that are neither alpha nor quality bands.
    quality_bands : dict of int to str
        Numbers and kinds of the bands that say how good the others are.
    nodata : float or None
        What is no data whatever the file declares; None leaves that to the file.
    drawn : dict of int to (N,) float64
        Values of a band, by its number, that are drawn on it and that are no data either.
    hides : callable or None
        Takes a `Grid` that is part of this raster's and gives (H, W) bool, True for the pixels
        that are to be invalid whatever the file says.

    Raises
    ------
    RasterNotFoundError, RasterUnreadableError, MissingGeoreferenceError
    UnsupportedGeoreferenceError, MissingCrsError
    """

    def __init__(self, opened: Opened, stack: ExitStack) -> None:
        self.path, self.opened, self.dataset = opened.name, opened, opened.dataset
        self.grid = opened.grid()
        self._stack = stack
        every = range(1, self.dataset.count + 1)
        self._alpha = alpha_bands(self.dataset)
        if len(self._alpha) == len(every):
            self._alpha = ()
        self.quality_bands = quality_bands(self.path, self.dataset.descriptions)
        self.nodata: float | None = None
        self.drawn: dict[int, FloatArray] = {}
        self.hides: Callable[[Grid], BoolArray] | None = None
        known = {*self._alpha, *self.quality_bands}
        self.image_bands = tuple(number for number in every if number not in known)
        self._placements: dict[int, Placement] = {}
        self._more_handles: list[DatasetReader] = []

    @cached_property
    def _masked_bands(self) -> frozenset[int]:
        return bands_with_mask(self.dataset)

    @cached_property
    def _overviews(self) -> tuple[DatasetReader, ...]:
        if not self.opened.is_file:
            return ()
        with gdal_calls():
            count = min(len(self.dataset.overviews(n)) for n in range(1, self.dataset.count + 1))
        return tuple(self.opened.again(self._stack, index) for index in range(count))

    @property
    def overview_factors(self) -> tuple[float, ...]:
        """True ratios of sizes, finest level first."""
        height, width = self.grid.shape
        return tuple(min(width / one.width, height / one.height) for one in self._overviews)

    def undeclared_fill(self) -> float | None:
        """Value of a corner that is filled, of a file that declares neither no data nor masks."""
        declares = any(value is not None for value in self.dataset.nodatavals)
        if declares or self._alpha or self._masked_bands or self.block_note:
            return None
        height, width = self.grid.shape

        def read(window: Window) -> NDArray[Any]:
            with self._decoding(window):
                return _read(self.dataset, self.image_bands, window)

        return undeclared_fill(read, (height, width), self.dataset.dtypes[0])

    @property
    def block_note(self) -> str:
        """Says so when one block is too large for the file to be read in pieces; else empty."""
        height, width = self.dataset.block_shapes[0]
        planes = self.dataset.count if self.dataset.profile.get("interleave") == "pixel" else 1
        size = height * width * planes * np.dtype(self.dataset.dtypes[0]).itemsize
        if size <= _LARGE_BLOCK_BYTES:
            return ""
        return (
            f"{Path(self.path).name} is stored in blocks of {width} × {height} pixels "
            f"({size / 1e6:.0f} MB), each of which can only be read whole; "
            "a tiled copy (gdal_translate -co TILED=YES) needs less memory"
        )

    def read(self, numbers: Sequence[int], window: Window) -> tuple[Float32Array, BoolArray]:
        """Pixels of a window.

        Parameters
        ----------
        numbers : sequence of int
            GDAL's band numbers, from 1.
        window : Window

        Returns
        -------
        (B, h, w) float32
            0 where invalid.
        (B, h, w) bool

        Raises
        ------
        RasterUnreadableError
        """
        data, valid = self._shown(numbers, window, self.dataset, Placement((1.0, 1.0)))
        return data, np.ones(data.shape, dtype=np.bool_) if valid is None else valid

    def read_decimated(
        self, numbers: Sequence[int], window: Window, shape: tuple[int, int], overview: int | None
    ) -> tuple[Float32Array, BoolArray]:
        """Pixels of a window, averaged down to `shape` from an overview or from the full raster.

        Only a piece for each thread is in memory at a time; whatever their number, the same sums
        are added in the same order.  A small raster stays in GDAL's cache, for its windows are
        read next.  Parameters and returned values as in `read`.
        """
        if overview is None:
            dataset, placement = self.dataset, Placement((1.0, 1.0))
        else:
            dataset, placement = self._overviews[overview], self._placement(overview)
        origin, size = placement.area(window)
        average = BoxAverage(len(numbers), shape, origin, size)
        pieces = _pieces(dataset, origin, size, len(numbers))
        samples = dataset.width * dataset.height * len(numbers)
        small = samples * np.dtype(dataset.dtypes[numbers[0] - 1]).itemsize <= PIECES_BYTES
        alone = small or overview is not None
        levels = [dataset] if alone else self._handles(len(pieces))

        def share(piece: Window) -> Share:
            level = free.get()
            try:
                pixels = self._shown(numbers, piece, level, placement)
            finally:
                free.put(level)
            return average.share(*pixels, piece.column, piece.row)

        free: SimpleQueue[DatasetReader] = SimpleQueue()
        for level in levels:
            free.put(level)
        passing = nullcontext() if small else passing_through(PIECES_BYTES)
        with passing, ThreadPoolExecutor(len(levels)) as pool:
            for start in range(0, len(pieces), 2 * len(levels)):
                for one in pool.map(share, pieces[start : start + 2 * len(levels)]):
                    average.take(one)
        return average.result()

    def _shown(
        self, numbers: Sequence[int], window: Window, level: DatasetReader, placement: Placement
    ) -> tuple[Float32Array, BoolArray | None]:
        """`_pixels` without those that a mask hides."""
        data, valid = self._pixels(numbers, window, level)
        if self.hides is None:
            return data, valid
        (across, down), (x, y) = placement
        place = Affine.scale(1 / across, 1 / down) @ Affine.translation(x, y)
        grid = Grid(self.grid.transform @ place, (level.height, level.width), self.grid.crs_wkt)
        hidden = self.hides(decimated_grid(grid, window))
        if not hidden.any():
            return data, valid
        data[:, hidden] = 0
        if valid is None:
            valid = np.ones(data.shape, dtype=np.bool_)
        valid[:, hidden] = False
        return data, valid

    def _handles(self, pieces: int) -> list[DatasetReader]:
        """Handles of the full raster, one for each thread that is worth starting."""
        wanted = min(os.cpu_count() or 1, _MOST_THREADS, pieces // _PIECES_PER_THREAD)
        again = self.opened.is_file and is_local(self.path)
        while again and len(self._more_handles) + 1 < wanted:
            self._more_handles.append(self.opened.again(self._stack))
        return [self.dataset, *self._more_handles[: max(wanted - 1, 0)]]

    def _placement(self, overview: int) -> Placement:
        """Where an overview's pixels lie, found on first use."""
        if overview not in self._placements:
            dataset, number = self._overviews[overview], self.image_bands[0]

            def read_patch(of_overview: bool, window: Window) -> tuple[Float32Array, BoolArray]:
                level = dataset if of_overview else self.dataset
                data, valid = self._pixels([number], window, level)
                return data, np.ones(data.shape, dtype=np.bool_) if valid is None else valid

            shape = (dataset.height, dataset.width)
            self._placements[overview] = find_placement(read_patch, shape, self.grid.shape)
        return self._placements[overview]

    @contextmanager
    def _decoding(self, window: Window) -> Iterator[None]:
        """Reading of a window, with its errors in words."""
        from rasterio.errors import RasterioError

        try:
            with gdal_calls():
                yield
        except (RasterioError, OSError, MemoryError, ValueError, SystemError) as error:
            reason = " ".join(str(error.__cause__ or error).split())
            raise RasterUnreadableError(
                f"{self.path}: the pixels of columns {window.column} to "
                f"{window.column + window.width}, rows {window.row} to "
                f"{window.row + window.height} cannot be decoded ({reason})",
                "The file is truncated or damaged: copy or download it again.",
            ) from error

    def _pixels(
        self, numbers: Sequence[int], window: Window, level: DatasetReader
    ) -> tuple[Float32Array, BoolArray | None]:
        """Pixels of one level, 0 where invalid, and their validity; None stands for all valid."""
        with self._decoding(window):
            raw = _read(level, numbers, window)
            masks = self._masks(numbers, window, level)
        nodata = [level.nodatavals[number - 1] for number in numbers]
        if self.nodata is not None:
            nodata = [self.nodata] * len(numbers)
        differing = [differs_from_nodata(raw[plane], value) for plane, value in enumerate(nodata)]
        if all(one is not None and not one.any() for one in differing):
            # most of a sparse raster: as fast as GDAL finds that nothing is there
            return np.zeros(raw.shape, dtype=np.float32), np.zeros(raw.shape, dtype=np.bool_)
        with np.errstate(over="ignore", invalid="ignore"):
            data = raw.astype(np.float32)
        masks += [
            (plane, ~np.isin(data[plane], self.drawn[number]))
            for plane, number in enumerate(numbers)
            if number in self.drawn
        ]
        valid = _validity(raw, data, differing, masks)
        if valid is not None:
            data[~valid] = 0
        return data, valid

    def _masks(
        self, numbers: Sequence[int], window: Window, level: DatasetReader
    ) -> list[tuple[slice | int, BoolArray]]:
        """Masks of the file, each with the planes that it applies to."""
        masks: list[tuple[slice | int, BoolArray]] = [
            (slice(None), level.read(number, window=window.edges) != 0) for number in self._alpha
        ]
        for plane, number in enumerate(numbers):
            if number in self._masked_bands:
                masks.append((plane, self._own_mask(number, window, level) != 0))
        return masks

    def _own_mask(self, number: int, window: Window, level: DatasetReader) -> NDArray[np.uint8]:
        if level.shape == self.dataset.shape:
            return np.asarray(level.read_masks(number, window=window.edges))
        # an overview without a mask of its own claims to be valid everywhere: ask the full raster
        down, across = self.dataset.height / level.height, self.dataset.width / level.width
        area = (
            (window.row * down, (window.row + window.height) * down),
            (window.column * across, (window.column + window.width) * across),
        )
        shape = (window.height, window.width)
        return np.asarray(self.dataset.read_masks(number, window=area, out_shape=shape))


def _read(level: DatasetReader, numbers: Sequence[int], window: Window) -> NDArray[Any]:
    """Pixels of bands, in a type that holds those of each."""
    if len({level.dtypes[number - 1] for number in numbers}) == 1:
        return np.asarray(level.read(list(numbers), window=window.edges))
    return np.stack([level.read(number, window=window.edges) for number in numbers])


def _validity(
    raw: NDArray[Any],
    data: Float32Array,
    differing: Sequence[BoolArray | None],
    masks: Sequence[tuple[slice | int, BoolArray]],
) -> BoolArray | None:
    """Everything that speaks against a pixel; None when nothing can."""
    if raw.dtype.kind in "iu" and not masks and all(mask is None for mask in differing):
        return None
    with np.errstate(invalid="ignore"):
        valid = np.abs(data) <= _LARGEST
    for plane, mask in [*enumerate(differing), *masks]:
        if mask is not None:
            valid[plane] &= mask
    return None if valid.all() else valid


def _pieces(
    dataset: DatasetReader, origin: tuple[float, float], size: tuple[float, float], bands: int
) -> list[Window]:
    """Pieces of whole blocks that cover an area, each of about `_PIECE_PIXELS`."""
    left, top = (max(int(np.floor(edge + 1e-6)), 0) for edge in origin)
    right = min(dataset.width, int(np.ceil(origin[0] + size[0] - 1e-6)))
    bottom = min(dataset.height, int(np.ceil(origin[1] + size[1] - 1e-6)))
    block_height, block_width = (int(side) for side in dataset.block_shapes[0])
    pixels = max(_PIECE_PIXELS // bands, 1)
    rows = max(pixels // (right - left) // block_height, 1) * block_height
    columns = max(pixels // rows // block_width, 1) * block_width
    if block_height * min(right - left, block_width) * bands > _WHOLE_BLOCK_PIXELS:
        rows = min(rows, max(pixels // min(right - left, block_width), 1))
        columns = min(columns, max(pixels // rows, 1))
    return [
        Window(x0, y0, x1 - x0, y1 - y0)
        for y0, y1 in _cuts(top, bottom, rows)
        for x0, x1 in _cuts(left, right, columns)
    ]


def _cuts(start: int, stop: int, step: int) -> list[tuple[int, int]]:
    """Cut a range at the multiples of `step`."""
    edges = [start, *range((start // step + 1) * step, stop, step), stop]
    return list(pairwise(edges))
