"""Band weights against scipy's non-negative least squares, and under clouds and curved tones."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage, optimize

from geodelreg.fine.tone import (
    SyntheticPan,
    fit_synthetic_pan,
    non_negative_weights,
    robust_band_weights,
    single_band,
)
from geodelreg.values.raster import Band, Grid

Array = NDArray[np.float64]
SHAPE = (80, 100)
GRID = Grid(Affine.identity(), SHAPE, "")
TRUE = np.array([0.15, 0.4, 0.35, 0.0])


def bands(seed: int = 0, count: int = 4) -> NDArray[np.float32]:
    """(B, N) correlated bands, as reflectances are: a common part and each one's own."""
    rng = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(rng.standard_normal((count + 1, *SHAPE)), (0, 1.5, 1.5))
    noise /= noise.std()
    mixed = 1000 + 150 * noise[:1] + 100 * noise[1:]
    return np.clip(mixed, 10, None).reshape(count, -1).astype(np.float32)


def noisy(values: Array, sigma: float, seed: int = 9) -> NDArray[np.float32]:
    noise = sigma * np.random.default_rng(seed).standard_normal(values.shape)
    return (values + noise).astype(np.float32)


@settings(max_examples=80)
@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.floats(-3, 3))
def test_weights_are_scipys(seed: int, count: int, tilt: float) -> None:
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((40, count)) + tilt * rng.standard_normal((40, 1))
    target = rng.standard_normal(40) + design @ rng.uniform(-1, 1, count)
    expected, _ = optimize.nnls(design, target)
    found = non_negative_weights(design.T @ design, design.T @ target)
    assert (found >= 0).all()
    assert found == pytest.approx(expected, abs=1e-5 * max(1.0, expected.max()))


def test_a_repeated_band_does_no_harm() -> None:
    design = np.random.default_rng(0).standard_normal((40, 3))
    design[:, 2] = design[:, 1]
    target = design @ [0.5, 1.0, 1.0]
    found = non_negative_weights(design.T @ design, design.T @ target)
    assert design @ found == pytest.approx(target, abs=1e-5)


@pytest.mark.parametrize("levels", [2, 4])
@pytest.mark.parametrize("seed", range(8))
def test_bands_of_a_few_grey_levels_are_weighted(levels: int, seed: int) -> None:
    """Where all that is trusted has one value, rounding must not pass for contrast."""
    rng = np.random.default_rng(seed)
    ground = rng.normal(size=4000)
    noisy = ground + 0.2 * rng.normal(size=(5, 4000))
    cuts = np.quantile(ground, np.linspace(0, 1, levels + 1)[1:-1])
    *bands, target = (100 + 200 * np.searchsorted(cuts, band) for band in noisy)
    weights, correlation = robust_band_weights(np.float32(bands), np.float32(target))
    assert (weights >= 0).all()
    assert np.isfinite(correlation)


def test_nothing_positive_gives_no_weights() -> None:
    x = bands()
    assert not non_negative_weights(np.eye(3), np.array([-1.0, -0.2, 0.0])).any()
    weights, correlation = robust_band_weights(x, -x.mean(axis=0))
    assert (weights.any(), correlation) == (False, 0.0)
    assert fit_synthetic_pan(x, -x.mean(axis=0)) is None


def test_true_weights_are_found_up_to_noise() -> None:
    x = bands()
    weights, correlation = robust_band_weights(x, noisy(TRUE @ x + 77, 2.0))
    assert weights == pytest.approx(TRUE, abs=0.003)
    assert correlation > 0.99


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_clouds_do_not_bend_the_weights(share: float) -> None:
    """Bright in the target where the bands see ground, in the bands where it does, and in both."""
    x, rng = bands(), np.random.default_rng(3)
    target = TRUE @ x
    cover = rng.uniform(size=x.shape[1])
    white = rng.normal(3000, 200, x.shape[1])
    first, second = cover < share / 2, (cover >= share / 3) & (cover < share)
    target[first] = white[first]
    x[:, second] = white[second] * np.array([[1.3], [1.0], [0.9], [0.6]])
    weights, _ = robust_band_weights(x, noisy(target, 2.0))
    plain, _ = optimize.nnls((x - x.mean(axis=1, keepdims=True)).T, target - target.mean())
    assert weights == pytest.approx(TRUE, abs=0.005)
    assert np.abs(plain - TRUE).max() > 0.05
    fitted = fit_synthetic_pan(x, noisy(target, 2.0))
    assert fitted is not None
    clear = ~first & ~second
    assert np.corrcoef(synthesised(fitted, x)[clear], target[clear])[0, 1] > 0.995


def synthesised(tone: SyntheticPan, x: NDArray[np.float32]) -> NDArray[np.float32]:
    valid = np.ones(SHAPE, bool)
    made = tone([Band(b.reshape(SHAPE), valid, GRID, "") for b in x])
    assert made.valid.all()
    return made.data.ravel()


def test_curvature_is_left_out_of_a_linear_relation() -> None:
    x = bands()
    tone = fit_synthetic_pan(x, noisy(TRUE @ x, 3.0))
    assert tone is not None
    assert not tone.curvature.any()
    assert tone.weights == pytest.approx(TRUE, abs=0.005)


def test_curvature_is_kept_where_tones_are_curved() -> None:
    x = bands()
    target = 4.0 * (TRUE @ (x * (x / 1000.0)))
    tone, linear = fit_synthetic_pan(x, noisy(target, 3.0)), robust_band_weights(x, target)[0]
    assert tone is not None
    assert tone.curvature.any()
    off = [np.corrcoef(made, target)[0, 1] for made in (synthesised(tone, x), linear @ x)]
    assert 1 - off[0] < 0.1 * (1 - off[1])


def test_no_band_gets_a_negative_weight() -> None:
    for seed in range(5):
        x = bands(seed)
        z = (x[3] - x[3].mean()) / x[3].std()
        tone = fit_synthetic_pan(x, noisy(TRUE @ x + 40 * z**2 - 30 * z, 3.0))
        assert tone is not None
        assert (tone.weights >= 0).all()
        assert not np.signbit(tone.weights).any()


def test_many_bands_are_weighted_without_curvature() -> None:
    x = bands(count=9)
    true = np.linspace(0, 0.3, 9)
    tone = fit_synthetic_pan(x, noisy(true @ (x * (x / 1000.0)), 3.0))
    assert tone is not None
    assert not tone.curvature.any()


def test_a_pixel_is_valid_where_every_weighted_band_is() -> None:
    x = bands().reshape(4, *SHAPE)
    masks = np.ones((4, *SHAPE), bool)
    masks[1, :5], masks[3, 10:20] = False, False
    made = [Band(d, m, GRID, "") for d, m in zip(x, masks, strict=True)]
    tone = fit_synthetic_pan(bands(), noisy(np.array([0.5, 0.5, 0.2, 0.0]) @ bands(), 0.5))
    assert tone is not None
    assert tone.weights[3] == 0
    combined = tone(made)
    assert np.array_equal(combined.valid, masks[1])
    only = single_band(4, 3)(made)
    assert np.array_equal(only.data, x[3])
    assert np.array_equal(only.valid, masks[3])


@pytest.mark.parametrize("scale", [1e12, 1e30, 3e38])
@pytest.mark.parametrize("broken", [1, 2, 3])
def test_values_near_the_largest_are_no_error(scale: float, broken: int) -> None:
    """Damaged files hold such; where they are constant only rounding would be left of them."""
    rng = np.random.default_rng(0)
    bands = rng.normal(size=(4, 2000)).astype(np.float32)
    for number in range(broken):
        bands[number] = scale * (rng.random(2000) < 0.5)
    bands[3] = bands[0]
    target = bands[2] + rng.normal(size=2000).astype(np.float32)
    weights, correlation = robust_band_weights(bands, target)
    assert np.isfinite(weights).all()
    assert (weights >= 0).all()
    assert 0 <= correlation <= 1 + 1e-9
