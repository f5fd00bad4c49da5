"""Raster masks on any grid: a pixel of the image is hidden when a hiding mask pixel touches it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.errors import CrsTransformError, GeodelregError, MaskError, MissingCrsError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import crs_operation, map_points
from geodelreg.geo.grid import decimated_grid
from geodelreg.geo.pixel import pixel_centres
from geodelreg.masking import (
    AUTO,
    BINARY,
    LANDSAT_QA,
    SENTINEL2_SCL,
    MaskSpec,
    is_old_landsat,
    quality_bands,
)
from geodelreg.raster.environment import gdal_calls
from geodelreg.raster.inputs import Opened
from geodelreg.raster.opening import dataset_grid
from geodelreg.raster.quality import hidden_values, impossible_values
from geodelreg.raster.validity import alpha_bands
from geodelreg.values.raster import BoolArray, FloatArray, Grid, IntArray, Window

_TOUCH_PX = 1e-3
"""Mask pixels that reach into an image pixel by less do not touch it: geotransforms are rounded."""

_FAR_PX = 1e9
_NODE_STEP_PX = 32
_BLOCK_PX = 1_000_000
_MASK_BLOCK_PX = 4_000_000
_LATTICE = 128
_SAMPLES_PER_AXIS = 4
_SAMPLE_PX = 128
_MOST_IMPOSSIBLE = 0.01


class RasterMask:
    """A raster that says which pixels of an image to leave out.

    Parameters
    ----------
    spec : MaskSpec
    image : Grid
        Of the image; a mask of its size that does not say where it lies lies there, too.
    opened : Opened
    band : int, optional
        Number of the mask's band; the only one when not given.

    Attributes
    ----------
    kind : str
        ``binary``, ``values``, ``landsat-qa`` or ``sentinel2-scl``.
    band : int
    hide : ranges of values
        For ``values``.
    covered_share : float
        Share of the image that lies on the mask, 0 to 1.

    Raises
    ------
    MaskError
        If it is no mask of this kind, or lies elsewhere.
    """

    def __init__(
        self, spec: MaskSpec, image: Grid, opened: Opened, band: int | None = None
    ) -> None:
        self.path, self._dataset = spec.path, opened.dataset
        self.hide = spec.hide
        self._lock = threading.Lock()  # several threads read the image, and the mask has one handle
        self.band = band or _only_band(spec.path, self._dataset)
        self.kind = self._kind_of(spec.kind)
        self._nodata = self._dataset.nodatavals[self.band - 1]
        self._grid = _grid_of(spec.path, self._dataset, image)
        try:
            self.covered_share = _covered_share(image, self._grid)
        except CrsTransformError as error:
            raise MaskError(
                f"the mask {spec.path} cannot be put on the image: {error.cause}", error.remedy
            ) from error
        if not self.covered_share:
            raise MaskError(
                f"the mask {spec.path} does not cover the image at any place",
                "Give the mask of this image; if it is, correct its geotransform or CRS.",
            )
        if self.kind in (LANDSAT_QA, SENTINEL2_SCL):
            self._check_values()

    def hides(self, grid: Grid) -> BoolArray:
        """(H, W) bool, True for the pixels of `grid` that are to be left out.

        Raises
        ------
        MaskError
            If a block of the mask cannot be decoded.
        """
        out = np.zeros(grid.shape, dtype=np.bool_)
        for window in _blocks(grid, self._grid):
            rows, columns = window.edges
            out[slice(*rows), slice(*columns)] = self._hidden_block(decimated_grid(grid, window))
        return out

    def _hidden_block(self, grid: Grid) -> BoolArray:
        columns, rows = _touched(grid, self._grid)
        columns, rows = (
            _clipped(*pair) for pair in zip((columns, rows), self._grid.shape[::-1], strict=True)
        )
        x, y = int(columns[0].min()), int(rows[0].min())
        width, height = int(columns[1].max()) - x, int(rows[1].max()) - y
        if min(width, height) < 1:
            return np.zeros(grid.shape, dtype=np.bool_)
        stored = self._stored(Window(x, y, width, height))
        there = hidden_values(stored, self.kind, self.hide, self._nodata)
        if not there.any():
            return np.zeros(grid.shape, dtype=np.bool_)
        (left, right), (top, bottom) = columns, rows
        return _any_inside(there, left - x, right - x, top - y, bottom - y)

    def _stored(self, window: Window) -> NDArray[Any]:
        from rasterio.errors import RasterioError

        try:
            with self._lock, gdal_calls():
                return np.asarray(self._dataset.read(self.band, window=window.edges))
        except (RasterioError, OSError, MemoryError, ValueError) as error:
            reason = " ".join(str(error.__cause__ or error).split())
            raise MaskError(
                f"the mask {self.path} cannot be decoded ({reason})",
                "The file is truncated or damaged: copy or download it again.",
            ) from error

    def _kind_of(self, asked: str) -> str:
        if asked != AUTO:
            return asked
        descriptions = self._dataset.descriptions
        name = PurePath(self.path).stem
        if is_old_landsat(name) or is_old_landsat(descriptions[self.band - 1] or ""):
            raise MaskError(
                f"the mask {self.path} is a Landsat quality band from before Collection 2, whose "
                "bits mean other things",
                f"Take QA_PIXEL of Collection 2, or list the values to hide: {self.path}=2800,6896",
            )
        return quality_bands(self.path, descriptions).get(self.band, BINARY)

    def _check_values(self) -> None:
        """Look at samples all over the band for values that the producer does not write."""
        height, width = self._grid.shape
        found, absurd, example = 0, 0, 0.0
        for y in _starts(height):
            for x in _starts(width):
                size = min(_SAMPLE_PX, width - x), min(_SAMPLE_PX, height - y)
                stored = self._stored(Window(x, y, *size))
                bad = impossible_values(stored, self.kind, self._nodata)
                found, absurd = found + bad.size, absurd + int(bad.sum())
                if bad.any():
                    example = float(stored[bad][0])
        if absurd > _MOST_IMPOSSIBLE * found:
            band = {LANDSAT_QA: "QA_PIXEL of Landsat Collection 2", SENTINEL2_SCL: "Sentinel-2 SCL"}
            raise MaskError(
                f"the mask {self.path} (band {self.band}) holds values that {band[self.kind]} "
                f"does not know, such as {example:g}: it is from another product or collection, or "
                "was interpolated",
                f"List the values to hide, e.g. {self.path}=3,8-10, or say {self.path}={BINARY}.",
            )


def _only_band(path: str, dataset: Any) -> int:
    with gdal_calls():
        others = alpha_bands(dataset)
    bands = [number for number in range(1, dataset.count + 1) if number not in others]
    quality = quality_bands(path, dataset.descriptions)
    if len(bands) > 1 and len(quality) == 1:
        return next(iter(quality))
    if len(bands) > 1:
        raise MaskError(
            f"the mask {path} has {len(bands)} bands, none of which is called QA_PIXEL or SCL",
            "A mask has one: write it to a file of its own (gdal_translate -b N).",
        )
    return bands[0] if bands else 1


def _grid_of(path: str, dataset: Any, image: Grid) -> Grid:
    """Grid of a mask; that of the image when it has its size and says nothing else."""
    try:
        return dataset_grid(path, dataset)
    except GeodelregError as error:
        own = dataset.transform
        same_place = not isinstance(error, MissingCrsError) or own.almost_equals(image.transform)
        if (dataset.height, dataset.width) == image.shape and same_place:
            return image
        raise MaskError(
            f"the mask {error.cause}, and it does not have the size of the image",
            error.remedy or "Give a mask that says where it lies.",
        ) from error


def _covered_share(image: Grid, mask: Grid) -> float:
    """Share of a lattice over the image that lies on the mask; above 0 when they only meet."""
    share = _share_inside(image, mask)
    return share or min(_share_inside(mask, image), 1 / _LATTICE**2)


def _share_inside(one: Grid, other: Grid) -> float:
    axis = pixel_centres(np.arange(_LATTICE)) / _LATTICE
    columns, rows = np.meshgrid(axis * one.shape[1], axis * one.shape[0])
    there = _to_mask(np.stack([columns, rows], axis=-1), one, other)
    with np.errstate(invalid="ignore"):
        inside = (there >= 0) & (there <= np.array(other.shape[::-1]))
    return float(inside.all(axis=-1).mean())


def _to_mask(px: FloatArray, image: Grid, mask: Grid) -> FloatArray:
    """(..., 2) image pixels to mask pixels, exactly; NaN where there is no way."""
    ground = map_points(apply_affine(image.transform, px), image.crs_wkt, mask.crs_wkt)
    return apply_affine(~mask.transform, ground)


def _starts(length: int) -> list[int]:
    """Where samples along an axis begin, each once."""
    last = max(length - _SAMPLE_PX, 0)
    return sorted({last * i // (_SAMPLES_PER_AXIS - 1) for i in range(_SAMPLES_PER_AXIS)})


def _blocks(grid: Grid, mask: Grid) -> Iterator[Window]:
    """Parts of an image window that touch a bounded number of mask pixels."""
    height, width = grid.shape
    step = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    ends = _to_mask(np.array([width, height]) / 2 + step, grid, mask)
    (a, b), (c, d) = ends[1] - ends[0], ends[2] - ends[0]
    ratio = (abs(a) + abs(c)) * (abs(b) + abs(d))
    limit = min(_BLOCK_PX, _MASK_BLOCK_PX / ratio) if ratio > 0 else _BLOCK_PX
    across = int(np.clip(limit, 1, width))
    down = int(np.clip(limit // across, 1, height))
    for row in range(0, height, down):
        for column in range(0, width, across):
            yield Window(column, row, min(across, width - column), min(down, height - row))


Span = tuple[IntArray, IntArray]
"""First pixel and the one after the last, along one axis."""


def _touched(grid: Grid, mask: Grid) -> tuple[Span, Span]:
    """Columns and rows of the mask that each image pixel touches.

    The box around the pixel is taken where the grids are turned against each other.  Arrays
    broadcast to the image's shape: (1, W) and (H, 1) where they are not turned.
    """
    height, width = grid.shape
    relative = ~mask.transform @ grid.transform
    same_crs = not crs_operation(grid.crs_wkt, mask.crs_wkt).description
    if same_crs and max(abs(relative.b) * height, abs(relative.d) * width) < _TOUCH_PX:
        x = relative.a * np.arange(width + 1.0)[None, :] + relative.c
        y = relative.e * np.arange(height + 1.0)[:, None] + relative.f
        sides = (x[:, :-1], x[:, 1:]), (y[:-1], y[1:])
        columns, rows = (_whole(np.minimum(*side), np.maximum(*side)) for side in sides)
        return columns, rows
    at_rows, at_columns = (_nodes(side) for side in grid.shape)
    places = pixel_centres(np.stack(np.meshgrid(at_columns, at_rows), axis=-1))
    columns, rows = (
        _whole(*_boxes(nodes, at_rows, at_columns, grid.shape))
        for nodes in np.moveaxis(_to_mask(places, grid, mask), -1, 0)
    )
    return columns, rows


def _boxes(
    nodes: FloatArray, rows: FloatArray, columns: FloatArray, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Where image pixels begin and end along an axis of the mask.

    Parameters
    ----------
    nodes : (R, C) float64
        Mask pixels at the centres of some image pixels.
    rows, columns : (R,) and (C,) float64
        Which these are, the first and the last ones included.
    shape : tuple of int
        ``(height, width)`` of the image.

    Returns
    -------
    low, high : (H, W) float64
        Bilinear between nodes; far outside where there is no way.
    """
    height, width = shape
    slopes = [
        np.abs(np.diff(nodes, axis=axis)).ravel() / step
        for axis, step in ((0, rows[1] - rows[0]), (1, columns[1] - columns[0]))
    ]
    reach = sum(float(np.nanmax(slope)) if np.isfinite(slope).any() else 0.0 for slope in slopes)
    # far outside any raster, but not outside the integers
    bounded = np.clip(np.nan_to_num(nodes, nan=-_FAR_PX), -_FAR_PX, _FAR_PX)
    wide = _between(bounded.T, columns, width)
    centre = _between(np.ascontiguousarray(wide.T), rows, height)
    low = centre - reach / 2
    centre += reach / 2
    return low, centre


def _nodes(side: int) -> FloatArray:
    """Indices of pixels, the first and the last included and at least two."""
    last = max(side - 1, 1)
    return np.linspace(0.0, last, -(-last // _NODE_STEP_PX) + 1)


def _between(values: FloatArray, nodes: FloatArray, count: int) -> FloatArray:
    """Linear interpolation along the first axis, at 0 to `count` - 1."""
    at = np.arange(float(count))
    first = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    share = ((at - nodes[first]) / (nodes[first + 1] - nodes[first]))[:, None]
    low = np.take(values, first, axis=0)
    step = np.take(np.diff(values, axis=0), first, axis=0)
    step *= share
    step += low
    return step


def _whole(low: FloatArray, high: FloatArray) -> Span:
    """Pixels that intervals touch."""
    first = np.floor(low + _TOUCH_PX).astype(np.intp)
    return first, np.maximum(np.ceil(high - _TOUCH_PX).astype(np.intp), first + 1)


def _clipped(span: Span, length: int) -> Span:
    for edge in span:
        np.clip(edge, 0, length, out=edge)
    return span


def _any_inside(
    there: BoolArray, left: IntArray, right: IntArray, top: IntArray, bottom: IntArray
) -> BoolArray:
    """Whether any pixel is True in boxes of columns and rows, the last ones not included."""
    if left.shape[0] == 1 and top.shape[1] == 1:
        across = _any_along(there.T, left[0], right[0]).T
        return _any_along(across, top[:, 0], bottom[:, 0])
    total = np.zeros((there.shape[0] + 1, there.shape[1] + 1), dtype=np.int32)
    np.cumsum(there, axis=0, dtype=np.int32, out=total[1:, 1:])
    np.cumsum(total, axis=1, out=total)
    count = total[bottom, right] - total[top, right]
    count -= total[bottom, left] - total[top, left]
    return np.asarray(count > 0)


def _any_along(there: BoolArray, first: IntArray, stop: IntArray) -> BoolArray:
    """The same along the first axis alone."""
    if (stop == first + 1).all():
        return np.take(there, first, axis=0)
    total = np.zeros((there.shape[0] + 1, there.shape[1]), dtype=np.int32)
    np.cumsum(there, axis=0, dtype=np.int32, out=total[1:])
    return np.asarray(np.take(total, stop, axis=0) > np.take(total, first, axis=0))
