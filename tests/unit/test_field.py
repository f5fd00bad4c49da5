"""A field through tie points: true to the map, and sure of no more than it knows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geodelreg.fit.estimate import Observations
from geodelreg.fit.field import Field, fit_field
from geodelreg.fit.residual import residual_of, shared_by_neighbours
from geodelreg.geo.maps.affine import AffineMap

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


def fitted(length: float, seed: int, outliers: float = 0.0) -> Field:
    xy = lattice()
    return fit_field(observe(wave(0.35, length, xy), xy, np.random.default_rng(seed), outliers))


def error(fit: Field, length: float, xy: Array) -> Array:
    return np.asarray(fit.forward(xy) - xy - wave(0.35, length, xy))


def best_affine(field: Field, xy: Array) -> AffineMap:
    columns = np.column_stack([xy, np.ones(len(xy))])
    return AffineMap.of(np.linalg.lstsq(columns, field.forward(xy), rcond=None)[0].T)


@pytest.mark.parametrize(("length", "most"), [(150.0, 0.025), (400.0, 0.012)])
def test_a_field_follows_waves_with_outliers_among_its_points(length: float, most: float) -> None:
    fit = fitted(length, seed=1, outliers=0.08)
    gap = error(fit, length, places(np.random.default_rng(2)))
    assert np.sqrt((gap**2).sum(axis=1).mean()) < most
    assert len(fit.points) == pytest.approx(0.92 * len(lattice()), rel=0.03)


def test_points_of_an_affine_give_the_affine() -> None:
    xy = lattice()
    move = np.array([[0.3, -0.2]]) + 0.001 * xy
    fit = fit_field(observe(move, xy, np.random.default_rng(0)))
    gap = fit.forward(xy) - xy - move
    assert np.sqrt((gap**2).sum(axis=1).mean()) < 0.005
    assert residual_of(fit, best_affine(fit, xy), xy[::3], np.eye(2)).high_px < 0.01


def test_far_from_all_points_the_affine_is_left_and_the_error_grows() -> None:
    xy = lattice()
    part = xy[xy[:, 0] < SIDE / 2]
    fit = fit_field(observe(wave(0.35, 150.0, part), part, np.random.default_rng(3)))
    away = np.array([[x, SIDE / 2] for x in (SIDE / 2, 0.75 * SIDE, 2 * SIDE, 4 * SIDE)])
    variance = fit.joint_covariance(away).diagonal(axis1=1, axis2=2).sum(axis=0)
    assert (np.diff(variance) > 0).all()
    far = fit.forward(np.array([[3.0, 0.5], [4.0, 0.5], [5.0, 0.5]]) * SIDE)
    assert np.abs(far[0] - 2 * far[1] + far[2]).max() < 1e-3


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
        fit = fit_field(observe(wave(amplitude, 250.0, xy), xy, np.random.default_rng(seed)))
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
