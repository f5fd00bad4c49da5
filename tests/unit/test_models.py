"""Robust weighted fits, their covariances, and the choice of the model."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geodelreg.fit.choice import (
    FOLDS,
    fold_numbers,
    half_disagreement,
    held_out,
    select_model,
    spatial_blocks,
)
from geodelreg.fit.estimate import (
    Estimate,
    Observations,
    common_variance,
    minimum_points,
    robust_fit,
)
from geodelreg.fit.models import PARAMETER_COUNT, Frame, design, fitted_map

Array = NDArray[np.float64]
SIDE = 500.0
FRAME = Frame((SIDE / 2, SIDE / 2), SIDE / 2)
CORNERS = np.array([[0.0, 0.0], [SIDE, 0.0], [0.0, SIDE], [SIDE, SIDE]])
TRUTHS = {
    "shift": [0.01, -0.02],
    "scale": [0.01, -0.02, 0.0008, -0.0007],
    "similarity": [0.01, -0.02, 0.0003, 0.0008],
    "affine": [0.01, -0.02, 0.0008, 0.0004, -0.0005, -0.0006],
}


def observe(
    model: str, rng: np.random.Generator, count: int = 200, sigma: float = 0.02, extra: float = 0.0
) -> Observations:
    """Points of a known map with errors as their covariances say, and `extra` beyond."""
    source = rng.uniform(0, SIDE, (count, 2))
    turn = rng.normal(size=(count, 2, 2)) * sigma * rng.uniform(0.3, 1.5, (count, 1, 1))
    covariance = turn @ turn.transpose(0, 2, 1) + 0.1 * sigma**2 * np.eye(2)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(count, 2)))
    noise += extra * rng.normal(size=(count, 2))
    target = fitted_map(model, np.array(TRUTHS[model]), FRAME).forward(source) + noise
    return Observations(source, target, covariance)


def error(estimate: Estimate, model: str, at: Array = CORNERS) -> Array:
    truth = fitted_map(model, np.array(TRUTHS[model]), FRAME)
    return estimate.map.forward(at) - truth.forward(at)


@pytest.mark.parametrize("model", TRUTHS)
def test_parameters_are_linear_in_the_design(model: str) -> None:
    xy = np.random.default_rng(0).uniform(-100, 900, (20, 2))
    columns, base = design(model, xy, FRAME)
    assert columns.shape == (20, 2, PARAMETER_COUNT[model])
    expected = fitted_map(model, np.array(TRUTHS[model]), FRAME).forward(xy)
    assert base + columns @ TRUTHS[model] == pytest.approx(FRAME.normalise(expected), abs=1e-12)


def test_good_points_count_for_more() -> None:
    rng = np.random.default_rng(1)
    points = observe("shift", rng, 100)
    loud = np.arange(100) >= 40
    noise = rng.normal(0, 0.6, (60, 2))
    covariance = np.where(loud[:, None, None], np.eye(2) * 0.36, points.covariance)
    target = points.target.copy()
    target[loud] += noise
    weighted = robust_fit("shift", Observations(points.source, target, covariance), FRAME)
    alike = Observations(points.source, target, np.tile(np.eye(2), (100, 1, 1)))
    plain = robust_fit("shift", alike, FRAME)
    assert np.abs(error(weighted, "shift")).max() < 0.006
    assert np.abs(error(plain, "shift")).max() > 3 * np.abs(error(weighted, "shift")).max()


def test_directions_count_by_themselves() -> None:
    """Points on edges along rows and along columns: each tells one coordinate only."""
    rng = np.random.default_rng(2)
    source = rng.uniform(0, SIDE, (60, 2))
    sharp = np.where(np.arange(60)[:, None] % 2 == 0, [0.01, 5.0], [5.0, 0.01])
    covariance = np.einsum("ni,ij->nij", sharp**2, np.eye(2))
    truth = fitted_map("shift", np.array(TRUTHS["shift"]), FRAME)
    points = Observations(
        source, truth.forward(source) + sharp * rng.normal(size=(60, 2)), covariance
    )
    assert np.abs(error(robust_fit("shift", points, FRAME), "shift")).max() < 0.008


@pytest.mark.parametrize("model", TRUTHS)
@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_are_rejected_and_do_not_bend_the_fit(model: str, share: float) -> None:
    rng = np.random.default_rng(3)
    points = observe(model, rng)
    wrong = rng.uniform(size=len(points)) < share
    points.target[wrong] += rng.normal(0, 1.0, (int(wrong.sum()), 2)) + 0.5
    estimate = robust_fit(model, points, FRAME)
    assert np.abs(error(estimate, model)).max() < 0.05
    far = np.hypot(*(points.target - fitted_map(model, np.array(TRUTHS[model]), FRAME).forward(
        points.source)).T) > 0.6  # fmt: skip
    assert not estimate.inlier[far].any()
    assert estimate.inlier[~wrong].mean() > 0.97


def normalised_errors(model: str, count: int, extra: float, runs: int = 60) -> tuple[Array, Array]:
    """Errors over predicted sigma at the corners, and of the parameters with their correlations."""
    at, by_parameter = [], []
    for seed in range(runs):
        points = observe(model, np.random.default_rng(seed), count, extra=extra)
        estimate = robust_fit(model, points, FRAME)
        at.append(np.hypot(*error(estimate, model).T) / estimate.map.sigma_at(CORNERS))
        gap = estimate.parameters - TRUTHS[model]
        by_parameter.append(gap @ np.linalg.solve(estimate.covariance, gap) / len(gap))
    return np.array(at), np.sqrt(by_parameter)


@pytest.mark.parametrize("extra", [0.0, 0.04])
@pytest.mark.parametrize("model", TRUTHS)
def test_sigma_is_of_the_size_of_the_error(model: str, extra: float) -> None:
    at, by_parameter = normalised_errors(model, 60, extra)
    assert 0.85 < np.sqrt(np.mean(at**2)) < 1.2
    assert 0.85 < np.sqrt(np.mean(by_parameter**2)) < 1.2


@pytest.mark.parametrize("model", TRUTHS)
def test_sigma_is_of_the_size_of_the_error_with_few_points(model: str) -> None:
    at, _ = normalised_errors(model, 12, 0.02)
    assert 0.8 < np.sqrt(np.mean(at**2)) < 1.3


@pytest.mark.parametrize("seed", range(20))
def test_common_variance_makes_the_median_distance_that_of_chi_square(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(9, 300))
    covariance = np.tile(np.diag([0.01, 0.03]), (count, 1, 1)) * rng.lognormal(0, 1, (count, 1, 1))
    residual = rng.standard_t(2, (count, 2)) * rng.uniform(0.01, 30)
    extra = common_variance(residual, *np.linalg.eigh(covariance))
    inverse = np.linalg.inv(covariance + extra * np.eye(2))
    median = float(np.median(np.einsum("ni,nij,nj->n", residual, inverse, residual)))
    if extra:
        assert median == pytest.approx(2 * np.log(2), rel=2e-4)
    else:
        assert median <= 2 * np.log(2)


def test_points_without_any_error_leave_no_variance_over() -> None:
    assert common_variance(np.zeros((9, 2)), *np.linalg.eigh(np.zeros((9, 2, 2)))) == 0.0


def test_common_variance_is_what_the_covariances_leave_over() -> None:
    rng = np.random.default_rng(5)
    covariance = np.tile(np.diag([0.01, 0.03]), (5000, 1, 1)) * rng.uniform(0.5, 2, (5000, 1, 1))
    for extra in (0.02, 0.2, 3.0):
        spread = covariance + extra * np.eye(2)
        unit = rng.normal(size=(5000, 2))
        residual = np.einsum("nij,nj->ni", np.linalg.cholesky(spread), unit)
        assert common_variance(residual, *np.linalg.eigh(covariance)) == pytest.approx(
            extra, rel=0.08
        )
        residual[::4] += 50
        assert common_variance(residual, *np.linalg.eigh(covariance)) < 4 * extra
    within = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance * 0.9), unit)
    assert common_variance(within, *np.linalg.eigh(covariance)) == 0.0


def test_extra_variance_is_estimated_or_taken() -> None:
    points = observe("affine", np.random.default_rng(6), 800, extra=0.05)
    assert robust_fit("affine", points, FRAME).extra_variance_px2 == pytest.approx(0.0025, rel=0.2)
    assert robust_fit("affine", points, FRAME, 0.01).extra_variance_px2 == 0.01
    assert robust_fit("affine", points, FRAME, 0.0).extra_variance_px2 == 0.0


def test_blocks_cover_the_extent_and_folds_share_it_out() -> None:
    xy = np.random.default_rng(7).uniform((10, -400), (90, 800), (3000, 2))
    block = spatial_blocks(xy)
    assert sorted(set(block.tolist())) == list(range(64))
    corner = spatial_blocks(np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]]))
    assert corner.tolist() == [0, 7, 56, 63]
    fold = fold_numbers(xy)
    assert np.bincount(fold, minlength=FOLDS).min() > 500
    for number in set(block.tolist()):
        assert len(set(fold[block == number].tolist())) == 1
    by_block = {int(b): int(f) for b, f in zip(block, fold, strict=True)}
    neighbours = [(b, b + step) for b in by_block for step in (1, 8) if b % 8 < 7 and b + step < 64]
    assert all(by_block[one] != by_block[other] for one, other in neighbours)


def test_held_out_points_are_predicted_by_the_others() -> None:
    """Against refitting without the fold, and blind to the point itself."""
    points = observe("affine", np.random.default_rng(8), 120)
    estimate = robust_fit("affine", points, FRAME)
    errors = held_out(points, estimate)
    fold = fold_numbers(points.source) == 2
    rest = robust_fit("affine", points.take(~fold), FRAME, estimate.extra_variance_px2)
    expected = rest.map.forward(points.source[fold]) - points.target[fold]
    assert errors[fold] == pytest.approx(expected, abs=0.002)
    precision = np.linalg.inv(points.covariance + estimate.extra_variance_px2 * np.eye(2))
    unlike = np.einsum("ni,nij,nj->n", errors, precision, errors)
    assert unlike[estimate.inlier].mean() > estimate.distance2[estimate.inlier].mean()


def test_folds_that_leave_too_few_points_are_unknown_not_zero() -> None:
    points = observe("affine", np.random.default_rng(9), minimum_points("affine"))
    assert np.isnan(held_out(points, robust_fit("affine", points, FRAME))).all()


@pytest.mark.parametrize("extra", [0.0, 0.03])
@pytest.mark.parametrize("truth", TRUTHS)
def test_the_simplest_true_model_is_chosen(truth: str, extra: float) -> None:
    chosen = []
    for seed in range(8):
        points = observe(truth, np.random.default_rng(seed), extra=extra)
        selection = select_model(points, FRAME, CORNERS, "auto")
        chosen.append(selection.estimate.model)
        assert np.abs(error(selection.estimate, truth)).max() < 0.06
    assert chosen.count(truth) >= 7


@pytest.mark.parametrize(("tilt_px", "chosen"), [(0.0, "affine"), (50.0, "scale")])
def test_rotation_must_pay_and_what_is_neglected_is_told(tilt_px: float, chosen: str) -> None:
    points = observe("affine", np.random.default_rng(10))
    selection = select_model(points, FRAME, CORNERS, "auto", tilt_px)
    assert selection.estimate.model in (chosen, "shift" if chosen == "scale" else chosen)
    left = np.hypot(*error(robust_fit("scale", points, FRAME), "affine").T).max()
    expected = 0.0 if chosen == "affine" else left
    assert selection.neglected_px == pytest.approx(expected, rel=0.1)


def test_what_only_noise_would_rotate_is_not_called_neglected() -> None:
    points = observe("shift", np.random.default_rng(10))
    selection = select_model(points, FRAME, CORNERS, "auto", 50.0)
    assert selection.estimate.model == "shift"
    assert selection.neglected_px < 0.02


def test_a_model_that_is_asked_for_is_taken() -> None:
    points = observe("affine", np.random.default_rng(10))
    selection = select_model(points, FRAME, CORNERS, "shift")
    assert selection.estimate.model == "shift"


def test_few_points_get_a_model_they_can_carry() -> None:
    points = observe("shift", np.random.default_rng(11), 3)
    selection = select_model(points, FRAME, CORNERS, "auto")
    assert selection.estimate.model in ("shift", "scale", "similarity")
    with pytest.raises(ValueError, match="cannot determine"):
        select_model(points, FRAME, CORNERS, "affine")


def test_halves_disagree_by_about_the_error() -> None:
    disagreement, true = [], []
    for seed in range(40):
        points = observe("affine", np.random.default_rng(seed))
        estimate = robust_fit("affine", points, FRAME)
        disagreement.append(half_disagreement(points, estimate, CORNERS))
        true.append(np.hypot(*error(estimate, "affine").T).max())
    assert 0.7 < np.mean(disagreement) / np.mean(true) < 1.4


def test_halves_see_what_one_half_gets_wrong() -> None:
    points = observe("shift", np.random.default_rng(12))
    block = spatial_blocks(points.source)
    white = (block % 8 + block // 8) % 2 == 0
    points.target[white] += 0.4
    estimate = robust_fit("shift", points, FRAME)
    assert half_disagreement(points, estimate, CORNERS) == pytest.approx(0.2 * 2**0.5, rel=0.1)


def test_halves_without_enough_points_disagree_without_bound() -> None:
    points = observe("affine", np.random.default_rng(13), 6)
    estimate = robust_fit("affine", points, FRAME)
    assert half_disagreement(points, estimate, CORNERS) == float("inf")
