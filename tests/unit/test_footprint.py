"""Overlap of two rasters by their headers, against points scattered over both."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from pyproj import CRS, Transformer

from geodelreg.geo.footprint import footprint_in, overlap_windows
from geodelreg.values.raster import Grid, Window


def grid(transform: Affine, shape: tuple[int, int], crs: int) -> Grid:
    return Grid(transform, shape, CRS.from_epsg(crs).to_wkt())


def shared_pixels(source: Grid, reference: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Points of the source that lie on the reference, in pixels of both; by pyproj itself."""
    columns, rows = np.meshgrid(
        np.linspace(0, source.shape[1], 90), np.linspace(0, source.shape[0], 90)
    )
    transformer = Transformer.from_crs(source.crs_wkt, reference.crs_wkt, always_xy=True)
    x, y = transformer.transform(*(source.transform @ (columns.ravel(), rows.ravel())))
    good = np.isfinite(x) & np.isfinite(y)
    there = np.stack(~reference.transform @ (np.where(good, x, 0), np.where(good, y, 0)), axis=1)
    inside = good & (there >= 0).all(axis=1) & (there <= reference.shape[::-1]).all(axis=1)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)[inside], there[inside]


def assert_inside(points: np.ndarray, window: Window) -> None:
    column, row, width, height = window
    assert (points >= [column, row]).all()
    assert (points <= [column + width, row + height]).all()


PAN = grid(Affine(15, 0, 5e5, 0, -15, 14e5), (1000, 1200), 32616)
WORLD = grid(Affine(1 / 120, 0, -180, 0, -1 / 120, 90), (21600, 43200), 4326)
ROTATED = Affine.translation(508_000, 1_393_000) @ Affine.rotation(33) @ Affine.scale(30, -30)

PAIRS = {
    "same CRS": (grid(Affine(30, 0, 503_000, 0, -30, 1_406_000), (500, 600), 32616), PAN),
    "south-up": (grid(Affine(30, 0, 503_000, 0, 30, 1_391_000), (500, 600), 32616), PAN),
    "rotated": (grid(ROTATED, (200, 500), 32616), PAN),
    "geographic": (grid(Affine(3e-4, 0, -87.05, 0, -3e-4, 12.66), (300, 900), 4326), PAN),
    "neighbouring zone": (grid(Affine(30, 0, -148_000, 0, -30, 14e5), (500, 500), 32617), PAN),
    "finer source": (grid(Affine(2, 0, 505_000, 0, -2, 1_395_000), (700, 700), 32616), PAN),
    "within the world": (PAN, WORLD),
    "the world within": (WORLD, PAN),
    "polar": (grid(Affine(5000, 0, -4e6, 0, -5000, 4e6), (1600, 1600), 3413), WORLD),
    "around the pole": (WORLD, grid(Affine(5000, 0, -4e6, 0, -5000, 4e6), (1600, 1600), 3413)),
    "antimeridian": (grid(Affine(30, 0, 1e5, 0, -30, 1e5), (4000, 4000), 32601), WORLD),
}


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("grow_px", [0.0, 40.0])
def test_windows_cover_the_overlap(name: str, grow_px: float) -> None:
    source, reference = PAIRS[name]
    windows = overlap_windows(source, reference, grow_px)
    assert windows is not None
    in_source, in_reference = shared_pixels(source, reference)
    if name != "the world within":  # its 90 × 90 points miss the small raster
        assert len(in_source) > 20
    for points, window, full in zip(
        (in_source, in_reference), windows, (source, reference), strict=True
    ):
        assert_inside(points, window)
        column, row, width, height = window
        ends = np.array([[column, row], [column + width, row + height]])
        assert_inside(ends, Window(0, 0, full.shape[1], full.shape[0]))


@pytest.mark.parametrize("name", ["same CRS", "south-up", "geographic", "neighbouring zone"])
def test_windows_are_tight(name: str) -> None:
    source, reference = PAIRS[name]
    windows = overlap_windows(source, reference, 0.0)
    assert windows is not None
    for points, window in zip(shared_pixels(source, reference), windows, strict=True):
        seen = np.ptp(points, axis=0)
        assert (np.array([window.width, window.height]) <= seen * (1 + 2 / 45) + 8).all()


def test_growing_reaches_as_far_as_the_header_may_be_wrong() -> None:
    source = grid(Affine(15, 0, 5e5 + 1230 * 15, 0, -15, 14e5), (1000, 1200), 32616)
    assert overlap_windows(source, PAN, 0.0) is None
    assert overlap_windows(source, PAN, 25.0) is None
    windows = overlap_windows(source, PAN, 100.0)
    assert windows is not None
    in_source, in_reference = windows
    # the source starts 30 px right of the reference's last column
    assert in_source.column == 0
    assert in_source.width == pytest.approx(70, abs=2)
    assert in_reference.column == pytest.approx(1130, abs=2)
    assert in_reference.column + in_reference.width == 1200


@pytest.mark.parametrize(
    "source",
    [
        grid(Affine(15, 0, 9e5, 0, -15, 14e5), (1000, 1200), 32616),
        grid(Affine(15, 0, 5e5, 0, -15, 14e5), (1000, 1200), 32646),
        grid(Affine(1e-3, 0, 20, 0, -1e-3, 10), (500, 500), 4326),
        grid(Affine(15, 0, 5e5 + 1200 * 15, 0, -15, 14e5), (1000, 1200), 32616),
    ],
    ids=["same zone", "other side of the earth", "geographic", "touching"],
)
def test_disjoint_rasters_share_nothing(source: Grid) -> None:
    assert overlap_windows(source, PAN, 0.0) is None


def test_footprint_of_a_raster_in_itself_is_its_frame() -> None:
    footprint = footprint_in(PAN, PAN)
    assert footprint is not None
    assert footprint.bounds == pytest.approx((0, 0, 1200, 1000))
    assert footprint.area == pytest.approx(1200 * 1000)


def test_footprint_that_cannot_be_followed_is_none() -> None:
    assert footprint_in(WORLD, PAN) is None
    assert footprint_in(PAIRS["antimeridian"][0], WORLD) is None


def test_footprint_torn_at_the_antimeridian_is_no_frame_around_the_rest() -> None:
    # straight edges in both CRSs: the torn outline is a valid polygon, 358 degrees wide
    mercator_150_east = grid(Affine(1000, 0, 3_228_000, 0, -1000, 4e5), (300, 222), 3832)
    assert footprint_in(mercator_150_east, WORLD) is None


def test_grown_rasters_that_touch_at_a_corner_only_overlap() -> None:
    """Further apart than the search radius along the diagonal, but not along either axis."""
    reference = grid(Affine(10, 0, 500_000, 0, -10, 1_400_000), (50, 50), 32616)
    source = grid(Affine(10, 0, 500_640, 0, -10, 1_399_360), (50, 50), 32616)
    windows = overlap_windows(source, reference, 17.0)
    assert windows is not None
    assert windows[0].column == 0
    assert windows[1].column + windows[1].width == 50
