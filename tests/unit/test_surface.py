"""Surfaces against scipy's splines: the same values, and no sub-pixel phase is preferred."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray
from scipy import ndimage

from geodelreg.fine.surface import (
    high_pass,
    low_pass_taps,
    make_surface,
    sample,
    sample_patches,
    window_matrix,
)
from geodelreg.values.raster import Band, Grid

SHAPE = (90, 110)
INNER = (20.0, 70.0)
FULL = Grid(Affine(2.0, 0.0, 500_000.0, 0.0, -2.0, 1_300_000.0), SHAPE, "")
ROTATED = Grid(
    Affine.translation(500_000, 1_300_000) @ Affine.rotation(20) @ Affine.scale(2, 3), SHAPE, ""
)
MIRRORED = "mirror"


def band(data: NDArray[np.floating], grid: Grid = FULL, valid: NDArray[np.bool_] | None = None):
    good = np.ones(data.shape, bool) if valid is None else valid
    return Band(data.astype(np.float32), good, grid, "test")


def texture(shape: tuple[int, int] = SHAPE, sigma: float = 1.0, seed: int = 0) -> NDArray:
    noise = np.random.default_rng(seed).standard_normal(shape)
    smooth = ndimage.gaussian_filter(noise, sigma)
    return smooth / smooth.std() * 100 + 1000


def positions(count: int = 4000, seed: int = 1) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(*INNER, (count, 1, 2))


def scipy_values(image: NDArray, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cubic spline at outer-corner positions, whose index is half a pixel less."""
    index = [xy[..., 1] - 0.5, xy[..., 0] - 0.5]
    return ndimage.map_coordinates(image.astype(np.float64), index, order=3, mode=MIRRORED)


@pytest.mark.parametrize("sigma", [(0.0, 0.0), (1.3, 1.3), (0.6, 2.4)])
def test_samples_equal_scipys_cubic_spline(sigma: tuple[float, float]) -> None:
    image = texture()
    surface = make_surface(band(image), FULL, sigma)
    values, usable = sample(surface, positions())
    smooth = ndimage.correlate1d(image, low_pass_taps(sigma[0]), axis=1, mode=MIRRORED)
    smooth = ndimage.correlate1d(smooth, low_pass_taps(sigma[1]), axis=0, mode=MIRRORED)
    assert usable.all()
    assert np.abs(values + surface.level - scipy_values(smooth, positions())).max() < 0.02


def test_ramps_are_exact_at_every_phase() -> None:
    """INTER_CUBIC is wrong by up to 0.048 px here."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    slope = 20.0
    image = slope * (0.8 * columns - 0.6 * rows)
    phase = np.linspace(0, 1, 41)
    xy = np.stack(np.meshgrid(40 + phase, 40 + phase), axis=-1)
    for sigma in (0.0, 2.0):
        surface = make_surface(band(image), FULL, (sigma, sigma))
        values, _ = sample(surface, xy)
        error = values + surface.level - slope * (0.8 * xy[..., 0] - 0.6 * xy[..., 1])
        assert np.abs(error).max() / slope < 1e-3


def test_pixel_centres_give_back_the_pixels() -> None:
    image = texture()
    surface = make_surface(band(image), FULL, (0.0, 0.0))
    rows, columns = np.mgrid[20:60, 20:60]
    values, _ = sample(surface, np.stack([columns + 0.5, rows + 0.5], axis=-1).astype(float))
    assert np.abs(values + surface.level - image[20:60, 20:60]).max() < 0.02


@pytest.mark.parametrize("sigma", [0.3, 0.5, 1.0, 2.0, 8.0])
def test_taps_are_a_normalised_gaussian(sigma: float) -> None:
    taps = low_pass_taps(sigma)
    x = np.arange(len(taps)) - len(taps) // 2
    assert len(taps) % 2 == 1
    assert taps.sum() == pytest.approx(1.0)
    assert np.array_equal(taps, taps[::-1])
    assert np.log(taps / taps.max()) == pytest.approx(-(x**2) / (2 * sigma**2))
    assert taps[0] / taps.max() < 0.005


def test_no_low_pass_is_one_tap() -> None:
    assert low_pass_taps(0.0).tolist() == [1.0]


def test_large_values_keep_their_small_detail() -> None:
    """The mean is taken off before single precision filters it."""
    image = texture() + 60_000
    surface = make_surface(band(image), FULL, (0.0, 0.0))
    values, _ = sample(surface, positions())
    assert np.abs(values + surface.level - scipy_values(image, positions())).max() < 0.05


def test_outside_is_not_usable_and_neither_is_nan() -> None:
    surface = make_surface(band(texture()), FULL, (0.0, 0.0))
    outside = np.array([[-5.0, 40], [40, -5], [115, 40], [40, 95], [np.nan, 40], [1e9, 40]])
    values, usable = sample(surface, outside[:, None])
    assert not usable.any()
    assert np.isfinite(values).all()
    _, inside = sample(surface, np.array([[[2.0, 2.0], [108.0, 88.0], [55.0, 45.0]]]))
    assert inside.all()


def test_masked_pixels_change_nothing_where_the_surface_is_usable() -> None:
    image, valid = texture(), np.ones(SHAPE, bool)
    valid[30:45, 40:60] = False
    valid[70:, :25] = False
    spoilt = np.where(valid, image, 60_000.0)
    sigma = 1.2
    clean = make_surface(band(image), FULL, (sigma, sigma))
    masked = make_surface(band(spoilt, valid=valid), FULL, (sigma, sigma))
    xy = np.random.default_rng(3).uniform(5, 85, (8000, 1, 2))
    wanted, _ = sample(clean, xy)
    values, usable = sample(masked, xy)
    column, row = (np.floor(xy[:, 0].T)).astype(int)
    near = ndimage.binary_dilation(~valid, iterations=round(3.5 * sigma) + 1)
    assert not usable[~valid[row, column], 0].any()
    assert usable[~near[row, column], 0].all()
    gap = np.abs(values + masked.level - wanted - clean.level)[usable]
    assert gap.max() < 0.15 * image.std()
    assert np.median(gap) < 0.005 * image.std()


def test_a_band_without_a_valid_pixel_is_usable_nowhere() -> None:
    surface = make_surface(band(texture(), valid=np.zeros(SHAPE, bool)), FULL, (1.0, 1.0))
    values, usable = sample(surface, positions(50))
    assert not usable.any()
    assert np.isfinite(values).all()


@pytest.mark.parametrize("full", [FULL, ROTATED], ids=["north-up", "rotated"])
def test_windows_are_addressed_in_full_raster_pixels(full: Grid) -> None:
    image = texture()
    offset = Affine.translation(12, 9)
    part = Grid(full.transform @ offset, (60, 70), "")
    surface = make_surface(band(image[9:69, 12:82], part), full, (0.0, 0.0))
    xy = np.random.default_rng(2).uniform((24, 21), (70, 57), (2000, 2))[:, None]
    values, usable = sample(surface, xy)
    assert usable.all()
    assert np.abs(values + surface.level - scipy_values(image, xy)).max() < 0.05


def test_decimated_windows_keep_outer_corners_in_place() -> None:
    """A ramp averaged over 2.5 × 3 pixels is the same ramp, read at full-raster positions."""
    part = Grid(FULL.transform @ Affine.translation(10, 9) @ Affine.scale(2.5, 3.0), (24, 32), "")
    rows, columns = np.mgrid[:24, :32] + 0.5
    image = 7.0 * (10 + 2.5 * columns) + 3.0 * (9 + 3.0 * rows)
    surface = make_surface(band(image, part), FULL, (0.0, 0.0))
    xy = np.random.default_rng(2).uniform(38, 60, (500, 1, 2))
    values, usable = sample(surface, xy)
    assert usable.all()
    assert values + surface.level == pytest.approx(7 * xy[..., 0] + 3 * xy[..., 1], abs=0.02)


def test_window_matrix_is_the_change_of_pixels() -> None:
    inner = Affine.translation(10, 9) @ Affine.scale(2.5, 3.0)
    part = Grid(ROTATED.transform @ inner, (24, 32), "")
    expected = np.array([[1 / 2.5, 0, -4.0], [0, 1 / 3.0, -3.0]])
    assert window_matrix(ROTATED, part) == pytest.approx(expected, abs=1e-6)


def test_patches_are_samples_around_anchors() -> None:
    surface = make_surface(band(texture()), FULL, (0.7, 0.7))
    rng = np.random.default_rng(4)
    anchor = rng.uniform(40, 50, (6, 2))
    linear = np.eye(2) * 1.7 + rng.normal(0, 0.2, (6, 2, 2))
    offsets = rng.uniform(-5, 5, (30, 2))
    owner = np.zeros(6, dtype=np.intp)
    values, usable = sample_patches([surface], owner, anchor, linear, offsets)
    expected, _ = sample(surface, anchor[:, None] + np.einsum("pij,kj->pki", linear, offsets))
    assert usable.all()
    assert values == pytest.approx(expected, abs=0.05)


def test_patches_are_sampled_each_on_its_own_surface() -> None:
    image = texture()
    hidden = np.ones(SHAPE, dtype=bool)
    hidden[40:44, 40:44] = False
    surfaces = [
        make_surface(band(image), FULL, (0.7, 0.7)),
        make_surface(band(-image[:60, :80]), FULL, (0.7, 0.7)),
        make_surface(band(image, valid=hidden), FULL, (0.7, 0.7)),
    ]
    rng = np.random.default_rng(4)
    anchor = rng.uniform(20, 75, (40, 2))
    owner = np.repeat([0, 1, 2], [15, 10, 15])
    linear, offsets = np.broadcast_to(np.eye(2), (40, 2, 2)), rng.uniform(-3, 3, (9, 2))
    values, usable = sample_patches(surfaces, owner, anchor, linear, offsets)
    for number, surface in enumerate(surfaces):
        mine = owner == number
        alone = sample(surface, anchor[mine][:, None] + offsets)
        assert values[mine] == pytest.approx(alone[0], abs=0.05)
        assert (usable[mine] == alone[1]).mean() > 0.99
    assert 0 < usable[owner == 1].mean() < 1


def test_high_pass_leaves_the_mean_and_masked_values_out() -> None:
    image, valid = texture(sigma=0.7), np.ones(SHAPE, bool)
    valid[:, 60:] = False
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    haze = 500 * np.sin(columns / 40.0) + 300 * np.cos(rows / 35.0)
    plain = high_pass(band(image, valid=valid), 2.0).data
    hazy = high_pass(band(np.where(valid, image + haze, 9e4), valid=valid), 2.0).data
    inner = (slice(10, 80), slice(10, 50))
    assert abs(plain[inner].mean()) < 0.05 * image.std()
    assert (hazy - plain)[inner].std() < 0.02 * image.std()
    assert np.abs(hazy[valid]).max() < 8 * image.std()


def test_high_passed_surface_is_blind_to_a_slow_slope() -> None:
    image = texture(sigma=0.7)
    columns = np.broadcast_to(np.arange(SHAPE[1]), SHAPE)
    plain = make_surface(band(image), FULL, (0.5, 0.5), high_pass_px=2.0)
    sloped = make_surface(band(image + 40.0 * columns), FULL, (0.5, 0.5), high_pass_px=2.0)
    xy = positions()
    assert sample(plain, xy)[0] == pytest.approx(sample(sloped, xy)[0], abs=0.1)
