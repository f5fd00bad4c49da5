"""Averaging and overlap for arbitrary windows, ratios and geotransforms."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from geodelreg.geo.footprint import overlap_windows
from geodelreg.geo.grid import decimated_grid, gsd_px_m
from geodelreg.raster.decimate import BoxAverage
from geodelreg.values.raster import Grid, Window

UTM = CRS.from_epsg(32616).to_wkt()


@st.composite
def grids(draw: st.DrawFn) -> Grid:
    """Rotated, mirrored, non-square grids near one place."""
    transform = (
        Affine.translation(5e5 + draw(st.floats(-3e3, 3e3)), 14e5 + draw(st.floats(-3e3, 3e3)))
        @ Affine.rotation(draw(st.floats(0, 360)))
        @ Affine.scale(draw(st.floats(2, 40)), draw(st.floats(2, 40)))
        @ Affine.scale(1, draw(st.sampled_from([-1, 1])))
    )
    shape = (draw(st.integers(2, 400)), draw(st.integers(2, 400)))
    return Grid(transform, shape, UTM)


@st.composite
def windows(draw: st.DrawFn, shape: tuple[int, int]) -> Window:
    column = draw(st.integers(0, shape[1] - 1))
    row = draw(st.integers(0, shape[0] - 1))
    width = draw(st.integers(1, shape[1] - column))
    return Window(column, row, width, draw(st.integers(1, shape[0] - row)))


@given(st.data(), grids())
def test_decimated_grid_keeps_the_corners(data: st.DataObject, grid: Grid) -> None:
    window = data.draw(windows(grid.shape))
    shape = (data.draw(st.integers(1, window.height)), data.draw(st.integers(1, window.width)))
    small = decimated_grid(grid, window, shape)
    assert small.shape == shape
    for u, v in ((0, 0), (1, 0), (0, 1), (1, 1)):
        corner = (window.column + u * window.width, window.row + v * window.height)
        expected = grid.transform @ corner
        np.testing.assert_allclose(small.transform @ (u * shape[1], v * shape[0]), expected)
    gsd, small_gsd = gsd_px_m(grid), gsd_px_m(small)
    np.testing.assert_allclose(small_gsd[0] * shape[1], gsd[0] * window.width)
    np.testing.assert_allclose(small_gsd[1] * shape[0], gsd[1] * window.height)


def average(
    data: np.ndarray, valid: np.ndarray | None, shape: tuple[int, int], cuts: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """`BoxAverage` of a whole array, added in bands of rows."""
    box = BoxAverage(1, shape, (0.0, 0.0), (data.shape[1], data.shape[0]))
    edges = sorted({0, *cuts, data.shape[0]})
    for top, bottom in pairwise(edges):
        part = None if valid is None else valid[None, top:bottom]
        box.add(data[None, top:bottom], part, 0, top)
    values, known = box.result()
    return values[0], known[0]


sizes = st.integers(1, 60)


@given(st.data(), sizes, sizes)
def test_ramps_stay_exact_at_any_ratio(data: st.DataObject, height: int, width: int) -> None:
    shape = (data.draw(st.integers(1, height)), data.draw(st.integers(1, width)))
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    ramp = (3.0 * columns - 2.0 * rows + 50).astype(np.float32)
    values, known = average(ramp, None, shape, [])
    centre_rows = (np.arange(shape[0])[:, None] + 0.5) * height / shape[0]
    centre_columns = (np.arange(shape[1]) + 0.5) * width / shape[1]
    assert known.all()
    np.testing.assert_allclose(values, 3 * centre_columns - 2 * centre_rows + 50, atol=2e-3)


@given(st.data(), sizes, sizes, st.integers(0, 2**32 - 1))
def test_sums_are_conserved(data: st.DataObject, height: int, width: int, seed: int) -> None:
    shape = (data.draw(st.integers(1, height)), data.draw(st.integers(1, width)))
    cuts = data.draw(st.lists(st.integers(0, height), max_size=4))
    noise = np.random.default_rng(seed).random((height, width), dtype=np.float32)
    values, known = average(noise, None, shape, cuts)
    assert known.all()
    np.testing.assert_allclose(values.mean(), noise.mean(), rtol=1e-5)


@given(*[st.integers(1, 8)] * 4, st.integers(0, 2**32 - 1))
def test_whole_ratios_average_the_valid_pixels(
    height: int, width: int, down: int, across: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    data = rng.random((height * down, width * across), dtype=np.float32)
    valid = rng.random(data.shape) < 0.6
    data[~valid] = 0
    values, known = average(data, valid, (height, width), [int(rng.integers(0, len(data)))])
    cells = (height, down, width, across)
    counts = valid.reshape(cells).sum(axis=(1, 3))
    np.testing.assert_array_equal(known, counts >= 0.5 * down * across)
    expected = data.reshape(cells).sum(axis=(1, 3), dtype=np.float64) / np.maximum(counts, 1)
    np.testing.assert_allclose(values[known], expected[known], rtol=1e-5)


@given(st.data(), sizes, sizes, st.integers(0, 2**32 - 1))
def test_averages_ignore_what_is_not_valid(
    data: st.DataObject, height: int, width: int, seed: int
) -> None:
    shape = (data.draw(st.integers(1, height)), data.draw(st.integers(1, width)))
    valid = np.random.default_rng(seed).random((height, width)) < 0.7
    constant = np.where(valid, np.float32(7), np.float32(0))
    values, known = average(constant, valid, shape, [])
    np.testing.assert_allclose(values[known], 7, rtol=1e-4)


@given(grids(), grids(), st.sampled_from([0.0, 17.0]))
def test_overlap_windows_cover_all_shared_points(
    source: Grid, reference: Grid, grow_px: float
) -> None:
    columns, rows = np.meshgrid(*(np.linspace(0, side, 30) for side in source.shape[::-1]))
    mapped = (~reference.transform @ source.transform) @ (columns, rows)
    near = (mapped[0] >= -grow_px) & (mapped[0] <= reference.shape[1] + grow_px)
    near &= (mapped[1] >= -grow_px) & (mapped[1] <= reference.shape[0] + grow_px)
    result = overlap_windows(source, reference, grow_px)
    if result is None:
        strict = near & (np.abs(columns / source.shape[1] - 0.5) < 0.49)
        assert not (strict & (np.abs(rows / source.shape[0] - 0.5) < 0.49)).any()
        return
    window = result[0]
    assert (columns[near] >= window.column).all()
    assert (columns[near] <= window.column + window.width).all()
    assert (rows[near] >= window.row).all()
    assert (rows[near] <= window.row + window.height).all()
    window = result[1]
    inside = near & (np.clip(mapped[0], 0, reference.shape[1]) == mapped[0])
    inside &= np.clip(mapped[1], 0, reference.shape[0]) == mapped[1]
    assert (mapped[0][inside] >= window.column - 1e-6).all()
    assert (mapped[0][inside] <= window.column + window.width + 1e-6).all()
    assert (mapped[1][inside] >= window.row - 1e-6).all()
    assert (mapped[1][inside] <= window.row + window.height + 1e-6).all()
