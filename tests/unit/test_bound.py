"""The Cramér–Rao bound on cases with a known answer."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.accuracy.bound import (
    Knowledge,
    Signal,
    bounds,
    fisher,
    jacobian,
    rmse_bound,
    spread,
)
from benchmarks.scenes.truth import check_points

SHAPE = (30, 40)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
PIXELS = np.stack([COLUMNS.ravel(), ROWS.ravel()], axis=1)
LINEAR = 4.0 * np.eye(2)


def test_bound_of_a_shift_is_the_noise_over_the_gradients() -> None:
    slope, sigma = 7.0, 3.0
    half = len(PIXELS) // 2
    gradient = np.zeros((len(PIXELS), 2))
    gradient[:half, 0] = slope
    gradient[half:, 1] = slope
    one_px = np.tile(np.eye(2), (len(PIXELS), 1, 1))
    information = fisher(gradient, np.full(len(PIXELS), sigma**2), one_px)
    # each axis is known to sigma / (slope √half)
    assert rmse_bound(information, one_px) == pytest.approx(sigma / slope * np.sqrt(2 / half))


@pytest.mark.parametrize("model", ["shift", "scale", "similarity", "affine"])
def test_weighted_least_squares_reaches_the_bound(model: str) -> None:
    rng = np.random.default_rng(3)
    gradient = rng.normal(0, 10, (len(PIXELS), 2))
    variance = rng.uniform(4, 25, len(PIXELS))
    move = jacobian(model, PIXELS, SHAPE, LINEAR)
    check = jacobian(model, check_points(SHAPE), SHAPE, LINEAR)
    slope = np.einsum("ni,nip->np", gradient, move) / np.sqrt(variance)[:, None]
    noise = rng.standard_normal((1500, len(PIXELS)))
    parameters = noise @ np.linalg.pinv(slope).T
    errors = np.einsum("nip,rp->rni", check, parameters)
    observed = np.sqrt((errors**2).sum(axis=2).mean())
    bound = rmse_bound(fisher(gradient, variance, move), check)
    assert observed == pytest.approx(bound, rel=0.06)


def test_models_nest_and_less_knowledge_is_worse() -> None:
    rng = np.random.default_rng(8)
    signals = [
        Signal(rng.uniform(500, 2000, len(PIXELS)), rng.normal(0, 30, (len(PIXELS), 2)))
        for _ in range(4)
    ]
    pan = Signal(0.5 * (signals[1].values + signals[2].values), signals[1].gradient)
    nothing = np.empty((0, 0))
    knowledge = Knowledge(signals, pan, 0.03, PIXELS, LINEAR, (nothing, nothing))
    by_model = [bounds(knowledge, model, SHAPE) for model in ("shift", "scale", "affine")]
    for less, more in pairwise(by_model):
        assert all(less[key] < more[key] for key in less)
    for found in by_model:
        assert found["known bands"] < found["known PAN"] <= found["misfit as noise"]


def test_scatter_and_common_part_are_told_apart() -> None:
    rng = np.random.default_rng(1)
    errors = np.array([0.3, -0.4]) + 0.1 * rng.standard_normal((400, 50, 2))
    scatter, common = spread(errors)
    assert scatter == pytest.approx(0.1 * np.sqrt(2), rel=0.02)
    assert common == pytest.approx(0.5, rel=0.02)
