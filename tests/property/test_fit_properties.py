"""Models recovered from points, in any frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from geodelreg.fit.estimate import Observations, minimum_points, robust_fit
from geodelreg.fit.models import PARAMETER_COUNT, Frame, fitted_map
from geodelreg.geo.affine import affine_matrix

Array = NDArray[np.float64]
TOLERANCE_PX = 1e-6


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    """North-up, south-up, rotated and non-square pixels; degrees or metres do not matter."""
    width, height = draw(st.integers(20, 60_000)), draw(st.integers(20, 60_000))
    turn, aspect = draw(st.floats(-np.pi, np.pi)), draw(st.floats(0.3, 3.0))
    flip, unit = draw(st.sampled_from([-1.0, 1.0])), draw(st.sampled_from([1e-5, 0.3, 30.0]))
    c, s = np.cos(turn), np.sin(turn)
    metric = np.array([[c, -s], [s, c]]) @ np.diag([1.0, flip * aspect]) * unit
    return Frame((width / 2, height / 2), max(width, height) / 2, tuple(metric.ravel()))


def parameters(model: str, rng: np.random.Generator, size: float) -> Array:
    return rng.uniform(-size, size, PARAMETER_COUNT[model])


MODELS = ("shift", "scale", "similarity", "affine", "projective")


def matrix_of(model: str, values: Array, frame: Frame) -> Array:
    affine = fitted_map(model, values, frame).as_affine()
    assert affine is not None
    return affine_matrix(affine)


def spread_points(frame: Frame, count: int, rng: np.random.Generator) -> Array:
    low = np.zeros(2)
    return rng.uniform(low, 2 * np.array(frame.centre), (count, 2))


@settings(max_examples=60)
@given(frames(), st.sampled_from(MODELS), st.integers(0, 2**31), st.floats(1e-6, 0.3))
def test_models_are_recovered_from_exact_points(
    frame: Frame, model: str, seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    truth = fitted_map(model, parameters(model, rng, size), frame)
    source = spread_points(frame, 30, rng)
    spreads = rng.uniform(0.01, 1.0, (30, 2, 2))
    covariance = spreads @ spreads.transpose(0, 2, 1) + 1e-3 * np.eye(2)
    found = robust_fit(model, Observations(source, truth.forward(source), covariance), frame)
    everywhere = spread_points(frame, 50, rng)
    gap = found.map.forward(everywhere) - truth.forward(everywhere)
    assert np.abs(gap).max() < TOLERANCE_PX * max(1.0, frame.span_px / 1e3)
    assert found.inlier.all()
    assert found.extra_variance_px2 == 0.0


@settings(max_examples=60)
@given(frames(), st.integers(0, 2**31), st.floats(0, 0.3))
def test_a_similarity_is_one_on_the_ground(frame: Frame, seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    matrix = matrix_of("similarity", parameters("similarity", rng, size), frame)
    metric = np.array(frame.metric).reshape(2, 2)
    ground = metric @ matrix[:, :2] @ np.linalg.inv(metric)
    assert ground @ ground.T == pytest.approx(np.eye(2) * np.linalg.det(ground), abs=1e-9)
    assert np.linalg.det(ground) > 0


@settings(max_examples=60)
@given(frames(), st.sampled_from(MODELS), st.integers(0, 2**31), st.floats(0, 0.3))
def test_the_inverse_takes_it_back(frame: Frame, model: str, seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    there = fitted_map(model, parameters(model, rng, size), frame)
    xy = spread_points(frame, 20, rng).reshape(4, 5, 2)
    assert there.inverse(there.forward(xy)) == pytest.approx(xy, abs=1e-9 * frame.span_px + 1e-9)


@settings(max_examples=40)
@given(frames(), st.integers(0, 2**31), st.floats(0, 0.3))
def test_north_up_models_keep_the_axes(frame: Frame, seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    for model in ("shift", "scale"):
        matrix = matrix_of(model, parameters(model, rng, size), frame)
        assert matrix[0, 1] == matrix[1, 0] == 0.0
    assert matrix_of("shift", parameters("shift", rng, size), frame)[0, 0] == 1.0


@settings(max_examples=40)
@given(frames(), st.sampled_from(MODELS), st.integers(0, 2**31))
def test_too_few_points_are_refused_and_just_enough_fitted(
    frame: Frame, model: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    truth = fitted_map(model, parameters(model, rng, 0.1), frame)
    spots = [[0.1, 0.2], [0.9, 0.15], [0.2, 0.8], [0.85, 0.9], [0.45, 0.6]]
    source = np.array(spots) * 2 * frame.centre
    points = Observations(source, truth.forward(source), np.tile(np.eye(2) * 0.01, (5, 1, 1)))
    enough = minimum_points(model)
    with pytest.raises(ValueError, match=f"cannot determine a {model}"):
        robust_fit(model, points.take(np.arange(enough - 1)), frame)
    found = robust_fit(model, points.take(np.arange(enough)), frame)
    assert np.abs(found.map.forward(source) - truth.forward(source)).max() < 1e-5 * frame.span_px
