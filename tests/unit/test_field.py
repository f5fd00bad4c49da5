"""A field through tie points: true to the map, and sure of no more than it knows."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.typing import NDArray

from geodelreg.fit.estimate import Observations
from geodelreg.fit.field import FieldFit, fit_field, halves_apart, held_out_errors
from geodelreg.fit.jumps import find_jumps
from geodelreg.fit.residual import residual_of, shared_by_neighbours
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.spline import interpolated

Array = NDArray[np.float64]
SIDE = 440.0
SPACING = 20.0
NOISE_PX = 0.02


def wave(amplitude: float, length: float, xy: Array) -> Array:
    """(N, 2) displacement along both axes, each by the other's place."""
    turns = 2 * np.pi * xy / length
    return amplitude * np.stack([np.sin(turns[:, 1]), np.sin(turns[:, 0] + 1.0)], axis=1)


def observe(
    move: Array, xy: Array, rng: np.random.Generator, outliers: float = 0.0
) -> Observations:
    sigma = NOISE_PX * rng.uniform(0.5, 1.5, len(xy))
    target = xy + move + rng.normal(size=xy.shape) * sigma[:, None]
    wrong = rng.random(len(xy)) < outliers
    target[wrong] += rng.uniform(-1.5, 1.5, (int(wrong.sum()), 2))
    return Observations(xy, target, sigma[:, None, None] ** 2 * np.eye(2))


def lattice() -> Array:
    axis = (np.arange(int(SIDE / SPACING)) + 0.5) * SPACING
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def places(rng: np.random.Generator, count: int = 300) -> Array:
    return rng.uniform(SPACING, SIDE - SPACING, (count, 2))


def step(xy: Array) -> Array:
    """(N, 2) displacement of what lies below a row."""
    return np.where(xy[:, 1:] > 233.0, [[0.6, 0.1]], 0.0)


def fit_of(length: float, seed: int, outliers: float = 0.0) -> FieldFit:
    xy = lattice()
    return fit_field(observe(wave(0.35, length, xy), xy, np.random.default_rng(seed), outliers))


def fitted(length: float, seed: int, outliers: float = 0.0) -> FieldMap:
    return fit_of(length, seed, outliers).field


def error(fit: FieldMap, length: float, xy: Array) -> Array:
    return np.asarray(fit.forward(xy) - xy - wave(0.35, length, xy))


def best_affine(field: FieldMap, xy: Array) -> AffineMap:
    columns = np.column_stack([xy, np.ones(len(xy))])
    return AffineMap.of(np.linalg.lstsq(columns, field.forward(xy), rcond=None)[0].T)


@pytest.mark.parametrize(("length", "most"), [(150.0, 0.025), (400.0, 0.012)])
def test_a_field_follows_waves_with_outliers_among_its_points(length: float, most: float) -> None:
    fit = fitted(length, seed=1, outliers=0.08)
    gap = error(fit, length, places(np.random.default_rng(2)))
    assert np.sqrt((gap**2).sum(axis=1).mean()) < most
    assert len(fit.source) == pytest.approx(0.92 * len(lattice()), rel=0.03)


def test_points_of_an_affine_give_the_affine() -> None:
    xy = lattice()
    move = np.array([[0.3, -0.2]]) + 0.001 * xy
    fit = fit_field(observe(move, xy, np.random.default_rng(0))).field
    gap = fit.forward(xy) - xy - move
    assert np.sqrt((gap**2).sum(axis=1).mean()) < 0.005
    assert residual_of(fit, best_affine(fit, xy), xy[::3], np.eye(2)).high_px < 0.01


def test_far_from_all_points_the_affine_is_left_and_the_error_grows() -> None:
    xy = lattice()
    part = xy[xy[:, 0] < SIDE / 2]
    fit = fit_field(observe(wave(0.35, 150.0, part), part, np.random.default_rng(3))).field
    away = np.array([[x, SIDE / 2] for x in (SIDE / 2, 0.75 * SIDE, 2 * SIDE, 4 * SIDE)])
    variance = fit.joint_covariance(away).diagonal(axis1=1, axis2=2).sum(axis=0)
    assert (np.diff(variance) > 0).all()
    np.testing.assert_allclose(fit.sigma_at(away) ** 2, variance, rtol=1e-6)
    far = fit.forward(np.array([[3.0, 0.5], [4.0, 0.5], [5.0, 0.5]]) * SIDE)
    assert np.abs(far[0] - 2 * far[1] + far[2]).max() < 1e-3


def test_its_standard_error_is_right_on_average() -> None:
    ratios = []
    for seed in range(4):
        fit, xy = fitted(200.0, seed), places(np.random.default_rng(seed + 50))
        ratios.append((error(fit, 200.0, xy) ** 2).sum(axis=1) / fit.sigma_at(xy) ** 2)
    assert 0.7 < np.sqrt(np.mean(ratios)) < 1.3


def test_inverse_undoes_forward_also_of_a_turned_and_enlarged_raster() -> None:
    xy, at = lattice(), places(np.random.default_rng(5))
    turn = 1.3 * np.array([[0.8, -0.6], [0.6, 0.8]])
    target = (xy + wave(0.35, 150.0, xy)) @ turn.T
    noise = np.tile(1e-4 * np.eye(2), (len(xy), 1, 1))
    for fit in (fitted(150.0, seed=4), fit_field(Observations(xy, target, noise)).field):
        assert np.abs(fit.inverse(fit.forward(at)) - at).max() < 1e-7


def test_the_slope_is_that_of_the_map_and_so_is_the_strain() -> None:
    fit, xy = fitted(200.0, seed=6), places(np.random.default_rng(7))
    local, small = fit.linearise(xy), 1e-4
    for axis in (0, 1):
        away = np.eye(2)[axis] * small
        slope = (fit.forward(xy + away) - fit.forward(xy - away)) / (2 * small)
        np.testing.assert_allclose(local[:, :, axis], slope, atol=1e-6)
    np.testing.assert_allclose(local[:, :, 2], fit.forward(xy))
    strain, determinant = fit.strain_at(xy)
    assert (determinant > 0.95).all()
    assert strain.max() == pytest.approx(2 * np.pi * 0.35 / 200.0, rel=0.25)


def test_what_was_held_out_is_predicted_as_well_as_it_was_measured() -> None:
    fit = fitted(400.0, seed=8)
    gap = held_out_errors(fit)
    good = np.isfinite(gap).all(axis=1)
    assert good.mean() > 0.9
    assert np.median(np.hypot(*gap[good].T)) < 3 * NOISE_PX
    assert halves_apart(fit) < 0.1


@pytest.mark.parametrize("length", [150.0, 300.0])
def test_waves_are_no_jumps(length: float) -> None:
    fit, xy = fit_of(length, seed=9), lattice()
    points = observe(wave(0.35, length, xy), xy, np.random.default_rng(9))
    assert find_jumps(points.take(fit.inlier), fit.field.kernel, fit.weight) == ()


@pytest.mark.parametrize("amplitude", [0.0, 0.35])
def test_a_jump_is_found_to_a_row_of_patches_and_cut(amplitude: float) -> None:
    xy, rng = lattice(), np.random.default_rng(10)
    points = observe(step(xy) + wave(amplitude, 300.0, xy), xy, rng, outliers=0.05)
    smooth = fit_field(points)
    jumps = find_jumps(points.take(smooth.inlier), smooth.field.kernel, smooth.weight)
    assert len(jumps) == 1
    assert abs(jumps[0] - 233.0) <= SPACING / 2
    cut = fit_field(points, jumps=jumps).field
    at = places(np.random.default_rng(11), 600)
    at = at[np.abs(at[:, 1] - jumps[0]) > SPACING / 2]
    gap = cut.forward(at) - at - step(at) - wave(amplitude, 300.0, at)
    assert np.sqrt((gap**2).sum(axis=1).mean()) < 0.0125  # 0.05 PAN pixels at 1:4
    assert np.abs(cut.inverse(cut.forward(at)) - at).max() < 1e-7


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_patches_that_a_jump_cuts_through_are_on_neither_side_of_it(share: float) -> None:
    xy = lattice()
    astride = xy[:, 1] == 230.0
    move = np.where(astride[:, None], share * step(np.array([[0.0, SIDE]])), step(xy))
    points = observe(move, xy, np.random.default_rng(12))
    smooth = fit_field(points)
    jumps = find_jumps(points.take(smooth.inlier), smooth.field.kernel, smooth.weight)
    assert jumps == (230.0,)
    cut = fit_field(points, jumps=jumps)
    assert not cut.inlier[astride].any()
    at = places(np.random.default_rng(13))
    at = at[np.abs(at[:, 1] - 230.0) > SPACING / 2]
    gap = cut.field.forward(at) - at - step(at)
    assert np.sqrt((gap**2).sum(axis=1).mean()) < NOISE_PX / 2


def test_a_field_out_of_its_numbers_is_the_same_map() -> None:
    fit, at = fitted(200.0, seed=6), places(np.random.default_rng(7))
    again = FieldMap.from_json(json.loads(json.dumps(fit.to_json())))
    np.testing.assert_array_equal(again.forward(at), fit.forward(at))


def test_few_points_or_points_on_a_line_determine_no_field() -> None:
    xy = lattice()
    points = observe(np.zeros_like(xy), xy, np.random.default_rng(0))
    with pytest.raises(ValueError, match="5 points"):
        fit_field(points.take(np.arange(5)))
    with pytest.raises(ValueError, match="on a line"):
        fit_field(points.take(xy[:, 1] == xy[0, 1]))


@pytest.mark.parametrize("amplitude", [0.08, 0.25])
def test_the_residual_that_an_affine_leaves_is_told_with_an_interval_that_holds(
    amplitude: float,
) -> None:
    xy, inside = lattice(), 0
    grid = lattice()[::2]
    truth = wave(amplitude, 250.0, grid)
    for seed in range(10):
        points = observe(wave(amplitude, 250.0, xy), xy, np.random.default_rng(seed))
        fit = fit_field(points).field
        fitted_affine = best_affine(fit, grid)
        left = grid + truth - fitted_affine.forward(grid)
        true = np.sqrt((left**2).sum(axis=1).mean())
        told = residual_of(fit, fitted_affine, grid, np.eye(2))
        assert told.rms_px == pytest.approx(true, rel=0.1)
        inside += told.low_px <= true <= told.high_px
    assert inside >= 8


def test_neighbours_share_what_bends_and_not_their_noise() -> None:
    xy, rng = lattice(), np.random.default_rng(12)
    noise = 0.05 * rng.normal(size=xy.shape)
    noise[::50] += 1.5
    alone = shared_by_neighbours(xy, noise)
    assert alone.rms_px <= alone.high_px < 0.05
    bent = shared_by_neighbours(xy, noise + wave(0.1, 400.0, xy))
    assert bent.rms_px == pytest.approx(0.1, rel=0.25)
    assert bent.low_px < bent.rms_px < bent.high_px < 0.15


def test_a_handful_of_neighbours_tells_nothing() -> None:
    assert np.isnan(shared_by_neighbours(lattice()[:10], np.zeros((10, 2))).high_px)


@pytest.mark.parametrize("jumps", [(), (233.0,)])
def test_a_spline_through_some_places_of_a_field_is_the_field(jumps: tuple[float, ...]) -> None:
    """Also where it jumps: there the field itself is asked."""
    xy = lattice()
    points = observe(wave(0.35, 150.0, xy) + step(xy), xy, np.random.default_rng(11))
    fit, axis = fit_field(points, jumps=jumps).field, np.arange(0.5, SIDE)

    def asked(y: Array, x: Array) -> Array:
        return fit.forward(np.stack(np.meshgrid(x, y), axis=-1))

    values, _ = interpolated(asked, (int(SIDE), int(SIDE)), 1e-3)
    assert np.abs(values(axis, axis) - asked(axis, axis)).max() < 1e-3
