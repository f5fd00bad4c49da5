"""The scenes' truth is true: the renderer against analytic fields and brute-force integration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from affine import Affine
from pyproj import CRS, Transformer
from scipy import ndimage

from benchmarks.accuracy.measure import MeasureOptions, Raster, measure_offsets
from benchmarks.scenes.ground import Ground, cloud_layer, cover_with
from benchmarks.scenes.imagery import Imagery
from benchmarks.scenes.make import HeaderError, Scene, SceneSpec, make_scene, write_scene
from benchmarks.scenes.simulate import affine_placement, render, system_mtf
from benchmarks.scenes.truth import Truth, check_points, grid_rmse

UTM18 = CRS.from_epsg(32618).to_wkt()
WAVES = ((0.031, 0.012, 0.3), (-0.02, 0.05, 1.1), (0.09, -0.07, 2.0))


def _waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return sum(np.cos(2 * np.pi * (fx * x + fy * y) + phase) for fx, fy, phase in WAVES)


def _imagery(size: int = 420) -> Imagery:
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((4, size, size))
    texture = sum(
        s * ndimage.gaussian_filter(noise, (0, s, s), mode="wrap") for s in (0.7, 1.5, 4.0, 12.0)
    )
    texture += texture.mean(axis=0)
    bands = np.clip(1500 + 900 * texture / texture.std(), 100, 3300).astype(np.float32)
    return Imagery(bands, Affine(10.0, 0, 435_730, 0, -10.0, 4_179_460), UTM18, "noise")


@pytest.mark.parametrize(
    "ms_to_pan",
    [
        Affine(4.0, 0, 253.37, 0, 4.0, 240.61),
        Affine.translation(260, 220) @ Affine.rotation(36) @ Affine.scale(4.1, 3.9),
        Affine(1.0, 0.01, 281.3, -0.02, 1.0, 273.8),
        Affine(2.5, 0, 271.2, 0.1, 2.5, 250.9),
    ],
    ids=["4:1", "rotated", "1:1", "2.5:1"],
)
def test_rendered_waves_have_the_analytic_amplitude_and_place(ms_to_pan: Affine) -> None:
    column, row = np.meshgrid(np.arange(600) + 0.5, np.arange(580) + 0.5)
    placement = affine_placement(ms_to_pan, (24, 26))
    rendered = render(_waves(column, row), placement, blur_ms_px=0.3)
    x, y = placement.centres_px[..., 0], placement.centres_px[..., 1]
    expected, slope = np.zeros_like(x), np.zeros_like(x)
    for fx, fy, phase in WAVES:
        u = ms_to_pan.a * fx + ms_to_pan.d * fy
        v = ms_to_pan.b * fx + ms_to_pan.e * fy
        passed = np.sinc(u) * np.sinc(v) * np.exp(-2 * (np.pi * 0.3) ** 2 * (u * u + v * v))
        angle = 2 * np.pi * (fx * x + fy * y) + phase
        expected += passed * np.cos(angle)
        slope += passed * np.sin(angle) * 2 * np.pi * fx
    # In pixels: the error of the value over the typical gradient.
    assert np.abs(rendered - expected).max() / slope.std() < 5e-4


def test_rendering_equals_brute_force_integration_of_the_pixel() -> None:
    rng = np.random.default_rng(0)
    field = ndimage.gaussian_filter(rng.standard_normal((120, 120)), 2.0)
    ms_to_pan = Affine.translation(40, 30) @ Affine.rotation(20) @ Affine.scale(4.0)
    rendered = render(field, affine_placement(ms_to_pan, (8, 8)), blur_ms_px=0.0)
    coefficients = ndimage.spline_filter(field, order=5, mode="mirror")
    inside = (np.arange(32) + 0.5) / 32
    for row, column in ((0, 0), (3, 5), (7, 7)):
        u, v = np.meshgrid(column + inside, row + inside)
        x, y = ms_to_pan @ (u, v)
        values = ndimage.map_coordinates(
            coefficients, [y - 0.5, x - 0.5], order=5, mode="mirror", prefilter=False
        )
        assert rendered[row, column] == pytest.approx(values.mean(), abs=2e-4 * field.std())


def test_mtf_is_one_at_zero_and_falls() -> None:
    mtf = system_mtf(np.array([0.0, 0.05, 0.1]), np.zeros(3), np.eye(2) * 4, 0.35)
    assert mtf[0] == 1.0
    assert 1.0 > mtf[1] > mtf[2] > 0.0


@pytest.fixture(scope="module")
def scene() -> Scene:
    spec = SceneSpec(
        "small", "for tests", HeaderError((3.37, -2.61), (1.004, 0.006, -0.003, 0.997)),
        pan_shape=(400, 400), ms_shape=(90, 88),
    )  # fmt: skip
    return make_scene(spec, _imagery())


def _rasters(scene: Scene, ms_transform: tuple[float, ...]) -> tuple[Raster, Raster]:
    ms, pan = scene.ms.astype(np.float32), scene.pan[None].astype(np.float32)
    return (
        Raster(ms, np.ones(ms.shape[1:], bool), Affine(*ms_transform), scene.truth.ms_crs),
        Raster(pan, np.ones(pan.shape[1:], bool), Affine(*scene.truth.pan), scene.truth.pan_crs),
    )


def test_correlation_finds_no_offset_under_the_true_geotransform(scene: Scene) -> None:
    ms, pan = _rasters(scene, scene.truth.ms_true)
    offsets = measure_offsets(ms, pan, MeasureOptions(window_px=32, stride_px=16))
    assert len(offsets.score) >= 9
    assert offsets.distance_px < 0.02
    assert offsets.radial_px < 0.05


def test_measurement_reads_a_known_shift_without_bias(scene: Scene) -> None:
    shift = Affine(*scene.truth.pan) @ Affine.translation(1.3, -2.4) @ ~Affine(*scene.truth.pan)
    ms, pan = _rasters(scene, tuple(shift @ Affine(*scene.truth.ms_true))[:6])
    offsets = measure_offsets(ms, pan, MeasureOptions(window_px=32, stride_px=16))
    # MS content now lies (1.3, -2.4) px from where PAN has it.
    assert offsets.median_px == pytest.approx((1.3, -2.4), abs=0.02)


def test_invalid_pixels_take_no_part_in_the_measurement(scene: Scene) -> None:
    ms, pan = _rasters(scene, scene.truth.ms_true)
    ms.data[:, :40] = ms.data[:, 40:80][..., ::-1]
    ms.valid[:40] = False
    offsets = measure_offsets(ms, pan, MeasureOptions(window_px=32, stride_px=12))
    assert len(offsets.score) >= 3
    assert offsets.centre_px[:, 1].min() > 40
    assert offsets.distance_px < 0.03


def test_same_spec_same_scene(scene: Scene) -> None:
    spec = SceneSpec(
        "small", "for tests", HeaderError((3.37, -2.61), (1.004, 0.006, -0.003, 0.997)),
        pan_shape=(400, 400), ms_shape=(90, 88),
    )  # fmt: skip
    again = make_scene(spec, _imagery())
    assert np.array_equal(again.ms, scene.ms)
    assert np.array_equal(again.pan, scene.pan)
    assert again.truth == scene.truth


def test_written_scene_carries_the_wrong_header_and_the_truth(scene: Scene, tmp_path) -> None:
    write_scene(replace(scene, nodata=0), tmp_path)
    truth = Truth.load(tmp_path / "truth.json")
    assert truth == scene.truth
    with rasterio.open(tmp_path / "ms.tif") as ms:
        assert tuple(ms.transform)[:6] == truth.ms_header
        assert ms.nodata == 0
        assert np.array_equal(ms.read(), scene.ms)
    with rasterio.open(tmp_path / "pan.tif") as pan:
        assert tuple(pan.transform)[:6] == truth.pan
        assert pan.shape == truth.pan_shape
        assert np.array_equal(pan.read(1), scene.pan)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (HeaderError((3.0, -4.0)), 5.0),
        (HeaderError.similarity(0.0, 1.0), 0.0),
        # Over ±180 px the RMS of a coordinate is 180·sqrt((n + 1) / 3(n - 1)), n = 21 points.
        (HeaderError((0.0, 0.0), (1.01, 0.0, 0.0, 1.0)), 1.8 * np.sqrt(22 / 60)),
        (HeaderError.similarity(90.0), 2 * 180 * np.sqrt(22 / 60)),
    ],
    ids=["shift", "none", "scale", "turn"],
)
def test_grid_rmse_of_the_header(error: HeaderError, expected: float) -> None:
    spec = SceneSpec("g", "", error, pan_shape=(400, 400), ms_shape=(90, 90))
    truth = make_scene(spec, _imagery()).truth
    assert grid_rmse(Affine(*truth.ms_header), truth)["rmse_px"] == pytest.approx(expected)
    assert grid_rmse(Affine(*truth.ms_true), truth)["max_px"] == 0.0


def test_check_points_span_the_raster() -> None:
    points = check_points((30, 50))
    assert points.shape == (441, 2)
    assert points.min(axis=0).tolist() == [0, 0]
    assert points.max(axis=0).tolist() == [50, 30]


def test_scene_in_another_zone_is_placed_by_exact_projection() -> None:
    spec = SceneSpec(
        "zone", "", HeaderError((2.0, 1.0)), pan_shape=(400, 400), ms_shape=(80, 80), ms_epsg=32617
    )
    scene = make_scene(spec, _imagery())
    truth = scene.truth
    assert CRS.from_wkt(truth.ms_crs).to_epsg() == 32617
    centre = Affine(*truth.ms_true) @ (40, 40)
    x, y = Transformer.from_crs(32617, 32618, always_xy=True).transform(*centre)
    assert ~Affine(*truth.pan) @ (x, y) == pytest.approx((200, 200), abs=1e-4)
    ms, pan = _rasters(scene, truth.ms_true)
    offsets = measure_offsets(ms, pan, MeasureOptions(window_px=32, stride_px=16))
    assert offsets.distance_px < 0.02
    # The header is off by hypot(2, 1) px, but for the scale factor of the zone.
    assert grid_rmse(Affine(*truth.ms_header), truth)["rmse_px"] == pytest.approx(5**0.5, rel=5e-3)


def test_clouds_move_but_the_ground_does_not() -> None:
    spec = SceneSpec(
        "cloudy", "", HeaderError((4.0, 3.0)), pan_shape=(400, 400), ms_shape=(90, 90),
        variant="clouds",
    )  # fmt: skip
    imagery = _imagery()
    cloudy, clear = make_scene(spec, imagery), make_scene(replace(spec, variant=""), imagery)
    assert cloudy.nodata == 0
    assert 0.02 < (cloudy.ms[0] == 0).mean() < 0.12
    bright = cloudy.pan.astype(float) > clear.pan + 500.0
    assert 0.08 < bright.mean() < 0.3
    ms, pan = _rasters(cloudy, cloudy.truth.ms_true)
    ms.valid[:] = cloudy.ms[0] > 0
    pan.valid[:] = (cloudy.pan > 0) & ~ndimage.binary_dilation(bright, iterations=12)
    offsets = measure_offsets(ms, pan, MeasureOptions(window_px=24, stride_px=8))
    assert len(offsets.score) >= 5
    assert offsets.distance_px < 0.15


def test_shadows_stay_on_the_ground_while_their_clouds_move() -> None:
    plain = Ground(np.full((1, 200, 220), 1000.0, np.float32), (0, 0), (200, 220))
    layer = cloud_layer((200, 220), 0.1, (9.0, -6.0), np.random.default_rng(3))
    before, after = (cover_with(plain, [seen]).bands[0] for seen in (layer, layer.moved()))
    in_sight = (layer.opacity == 0) & (layer.moved().opacity == 0)
    assert before[in_sight].min() < 600
    np.testing.assert_array_equal(after[in_sight], before[in_sight])
