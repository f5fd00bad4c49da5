"""Points between CRSs, against pyproj called directly and against the definition of UTM."""

from __future__ import annotations

import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from affine import Affine
from pyproj import CRS, Transformer
from pyproj.transformer import TransformerGroup

import geodelreg.geo.crs
from geodelreg.errors import CrsTransformError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import crs_operation, map_points
from geodelreg.geo.maps.header import header_map
from geodelreg.values.raster import Grid

UTM17 = CRS.from_epsg(32617).to_wkt()
UTM18 = CRS.from_epsg(32618).to_wkt()
GEOGRAPHIC = CRS.from_epsg(4326).to_wkt()
POINTS = np.array([[[437_256.4, 4_176_413.8], [500_000.0, 0.0]], [[350_000.0, 9e6], [6e5, 1e6]]])
CUSTOM = CRS.from_proj4(
    "+proj=laea +lat_0=38 +lon_0=-75.5 +x_0=1234 +y_0=-99 +ellps=GRS80 +units=us-ft"
).to_wkt()


def swapped_axes(wkt: str) -> str:
    """The same CRS with northing first, as some are defined."""
    fields = CRS.from_wkt(wkt).to_json_dict()
    fields.pop("id", None)
    fields["coordinate_system"]["axis"].reverse()
    return CRS.from_json_dict(fields).to_wkt()


def test_equal_crss_leave_points_alone() -> None:
    found = map_points(POINTS, UTM18, UTM18)
    assert np.array_equal(found, POINTS)
    assert not np.shares_memory(found, POINTS)
    assert crs_operation(UTM18, UTM18).description == ""
    wkt1 = CRS.from_epsg(32618).to_wkt("WKT1_GDAL")
    assert np.array_equal(map_points(POINTS, UTM18, wkt1), POINTS)
    assert header_map(Grid(Affine.scale(2), (9, 9), UTM18), Grid(Affine.scale(2), (9, 9), wkt1)
                          ).as_affine() is not None  # fmt: skip


@pytest.mark.parametrize("wkt", [UTM17, GEOGRAPHIC, CUSTOM], ids=["zone", "geographic", "custom"])
def test_points_go_where_pyproj_puts_them_and_come_back(wkt: str) -> None:
    near = POINTS[:, :1]
    found = map_points(near, UTM18, wkt)
    direct = Transformer.from_crs(UTM18, wkt, always_xy=True)
    expected = np.stack(direct.transform(near[..., 0], near[..., 1]), axis=-1)
    assert found.shape == near.shape
    assert found == pytest.approx(expected, rel=1e-12)
    assert map_points(found, wkt, UTM18) == pytest.approx(near, abs=1e-3)


def test_longitude_comes_first() -> None:
    """EPSG:4326 is latitude first on paper; rasters never are."""
    found = map_points(np.array([500_000.0, 0.0]), UTM18, GEOGRAPHIC)
    assert found == pytest.approx([-75.0, 0.0], abs=1e-9)
    assert map_points(np.array([[-75.0, 0.0]]), GEOGRAPHIC, UTM18) == pytest.approx(
        np.array([[500_000.0, 0.0]]), abs=1e-3
    )


def test_swapped_axes_on_paper_swap_nothing() -> None:
    swapped = swapped_axes(UTM18)
    assert CRS.from_wkt(swapped).axis_info[0].direction == "north"
    assert np.array_equal(map_points(POINTS, swapped, UTM18), POINTS)
    found = map_points(POINTS[:, :1], swapped, UTM17)
    assert found == pytest.approx(map_points(POINTS[:, :1], UTM18, UTM17), abs=1e-6)


def test_points_without_an_image_are_nan() -> None:
    world = np.array([[-75.5, 38.0], [-75.5, 91.0], [np.nan, 38.0], [np.inf, 0.0]])
    found = map_points(world, GEOGRAPHIC, UTM18)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1:]).all()


def test_the_operation_is_described_with_its_accuracy() -> None:
    operation = crs_operation(UTM17, UTM18)
    assert "UTM zone 17N" in operation.description
    assert "UTM zone 18N" in operation.description
    assert "accuracy 0 m" in operation.description
    assert operation.warning == ""


def test_a_missing_grid_is_warned_about_by_name_and_by_the_result_alone() -> None:
    """NAD27 to WGS 84 needs grids for its best accuracy."""
    nad27 = CRS.from_epsg(26718).to_wkt()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        operation = crs_operation(nad27, UTM18)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(CRS.from_wkt(nad27), CRS.from_wkt(UTM18), always_xy=True)
    if group.best_available:
        assert operation.warning == ""
    else:
        missing = [grid.short_name for grid in group.unavailable_operations[0].grids]
        assert missing[0] in operation.warning
    assert f"(accuracy {group.transformers[0].accuracy:g} m)" in operation.description


def test_engineering_crss_have_no_way_out() -> None:
    local = 'ENGCRS["local",EDATUM["x"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],UNIT["m",1]]'
    with pytest.raises(CrsTransformError, match="no transformation"):
        map_points(POINTS, local, UTM18)


def test_a_header_map_is_affine_between_equal_crss() -> None:
    source = Grid(Affine(40, 1, 437_256.4, 2, -41, 4_176_413.8), (200, 210), UTM18)
    reference = Grid(Affine(10, 0, 437_330, 0, -10, 4_176_460), (800, 810), UTM18)
    mapping = header_map(source, reference)
    xy = np.random.default_rng(0).uniform(0, 200, (7, 3, 2))
    expected = apply_affine(~reference.transform @ source.transform, xy)
    affine = mapping.as_affine()
    assert affine is not None
    assert apply_affine(affine, xy) == pytest.approx(expected)
    assert mapping.forward(xy) == pytest.approx(expected)
    assert mapping.inverse(expected) == pytest.approx(xy, abs=1e-6)


def test_a_header_map_between_zones_is_curved_and_exact() -> None:
    source = Grid(Affine(40, 0, 437_256.4, 0, -40, 4_176_413.8), (2000, 2000), UTM18)
    x, y = Transformer.from_crs(UTM18, UTM17, always_xy=True).transform(437_256.4, 4_176_413.8)
    reference = Grid(Affine(10, 0, x, 0, -10, y), (8000, 8000), UTM17)
    mapping = header_map(source, reference)
    assert mapping.as_affine() is None
    corners = np.array([[0.0, 0.0], [2000.0, 0.0], [0.0, 2000.0], [2000.0, 2000.0]])
    image = mapping.forward(corners)
    assert image[0] == pytest.approx((0, 0), abs=1e-4)
    assert mapping.inverse(image) == pytest.approx(corners, abs=1e-6)
    assert np.hypot(*(image[1] + image[2] - image[3])) > 1
    local = mapping.linearise(np.array([[1000.0, 1000.0]]))[0]
    step = np.array([3.0, -2.0])
    there = mapping.forward(np.array([1000.0, 1000.0]) + step)
    assert local[:, :2] @ step + local[:, 2] == pytest.approx(there, abs=1e-3)


def test_one_thread_at_a_time_asks_a_transformation(monkeypatch: pytest.MonkeyPatch) -> None:
    """pyproj makes those of a `TransformerGroup` for one thread each."""
    busy: list[int] = []
    most: list[int] = []

    class Counting:
        def transform(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            busy.append(1)
            most.append(len(busy))
            time.sleep(0.002)
            busy.pop()
            return x, y

    operation = (Counting(), geodelreg.geo.crs.CrsOperation())
    monkeypatch.setattr(geodelreg.geo.crs, "_operation", lambda *_: operation)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: map_points(POINTS, UTM17, UTM18), range(20)))
    assert len(most) == 20
    assert max(most) == 1
