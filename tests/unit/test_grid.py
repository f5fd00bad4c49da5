"""Ground size of pixels and grids of windows, against formulas written down by hand."""

from __future__ import annotations

import math

import pytest
from affine import Affine
from pyproj import CRS

from geodelreg.errors import CrsTransformError
from geodelreg.geo.grid import decimated_grid, gsd_px_m, is_north_up
from geodelreg.values.raster import Grid, Window


def grid(transform: Affine, crs: int | str, shape: tuple[int, int] = (100, 200)) -> Grid:
    return Grid(transform, shape, CRS.from_user_input(crs).to_wkt())


@pytest.mark.parametrize(
    "linear",
    [
        Affine.scale(2.0, -3.0),
        Affine.scale(2.0, 3.0),
        Affine.rotation(40.0) @ Affine.scale(2.0, -3.0),
        Affine.rotation(-90.0) @ Affine.scale(-2.0, 3.0),
    ],
    ids=["north-up", "south-up", "rotated", "turned"],
)
def test_projected_pixels_have_the_size_of_their_geotransform(linear: Affine) -> None:
    assert gsd_px_m(grid(Affine.translation(5e5, 1e6) @ linear, 32616)) == pytest.approx((2, 3))


def test_feet_become_metres() -> None:
    assert gsd_px_m(grid(Affine(10, 0, 1e6, 0, -20, 2e5), 2263)) == pytest.approx(
        (10 * 1200 / 3937, 20 * 1200 / 3937)
    )


@pytest.mark.parametrize("latitude", [0.0, 12.5, -47.0, 80.0])
def test_geographic_pixels_follow_the_ellipsoid(latitude: float) -> None:
    step, a, e2 = 1e-4, 6378137.0, 0.00669437999014
    transform = Affine(step, 0, 20.0, 0, -step, latitude + 50 * step)
    sine2 = math.sin(math.radians(latitude)) ** 2
    prime_vertical = a / math.sqrt(1 - e2 * sine2)
    meridional = a * (1 - e2) / (1 - e2 * sine2) ** 1.5
    expected = (
        prime_vertical * math.cos(math.radians(latitude)) * math.radians(step),
        meridional * math.radians(step),
    )
    assert gsd_px_m(grid(transform, 4326)) == pytest.approx(expected, rel=1e-6)


def test_rotated_geographic_pixels() -> None:
    transform = Affine.translation(20, 0) @ Affine.rotation(90) @ Affine.scale(1e-4, -2e-4)
    across, down = gsd_px_m(grid(transform, 4326))
    assert across == pytest.approx(11.0574, rel=1e-4)  # along the meridian
    assert down == pytest.approx(2 * 11.1319, rel=1e-4)


def test_unknown_crs_is_an_error_of_ours() -> None:
    with pytest.raises(CrsTransformError, match="Correct the CRS"):
        gsd_px_m(Grid(Affine.scale(1), (5, 5), "nonsense"))


def test_decimation_uses_true_ratios() -> None:
    """1570 rows at a quarter are not 392.5 rows."""
    full = grid(Affine(15, 0, 5e5, 0, -15, 1e6), 32616, (1570, 800))
    small = decimated_grid(full, Window(0, 0, 800, 1570), (393, 200))
    assert small.transform.a == 60
    assert small.transform.e == pytest.approx(-15 * 1570 / 393)
    assert small.transform @ (200, 393) == pytest.approx(full.transform @ (800, 1570))


def test_window_starts_at_its_corner() -> None:
    full = grid(Affine(15, 0, 5e5, 0, -15, 1e6), 32616)
    window = decimated_grid(full, Window(4, 6, 10, 10))
    assert window.transform == Affine(15, 0, 500_060, 0, -15, 999_910)


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        (Affine(2, 0, 0, 0, -2, 0), True),
        (Affine(2, 0, 0, 0, 2, 0), False),
        (Affine(-2, 0, 0, 0, -2, 0), False),
        (Affine(2, 1e-9, 0, 0, -2, 0), False),
        (Affine(2, 0, 0, 1e-9, -2, 0), False),
    ],
)
def test_north_up_is_exact(transform: Affine, expected: bool) -> None:
    assert is_north_up(grid(transform, 32616)) is expected
