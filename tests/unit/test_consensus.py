"""Global consensus and its number of false alarms, statistically."""

from __future__ import annotations

import math

import numpy as np
import pytest

from geodelreg.fit.chance import log_nfa
from geodelreg.fit.consensus import consensus, fit_plainly, radial_residuals
from geodelreg.geo.affine import affine_matrix
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray

SIZE_PX = 1000.0


def similarity(scale: float, turn_deg: float, dx: float, dy: float) -> FloatArray:
    c, s = scale * math.cos(math.radians(turn_deg)), scale * math.sin(math.radians(turn_deg))
    return np.array([[c, -s, dx], [s, c, dy]])


def transform(matrix: FloatArray, xy: FloatArray) -> FloatArray:
    return xy @ matrix[:, :2].T + matrix[:, 2]


def contaminated(
    matrix: FloatArray, inliers: int, count: int, seed: int, sigma_px: float = 0.3
) -> tuple[FloatArray, FloatArray]:
    """Matches of which the first `inliers` follow `matrix`."""
    rng = np.random.default_rng(seed)
    source = rng.uniform(0, SIZE_PX, (count, 2))
    reference = rng.uniform(0, SIZE_PX, (count, 2))
    true = transform(matrix, source[:inliers])
    reference[:inliers] = true + sigma_px * rng.standard_normal(true.shape)
    return source, reference


def corner_error(found: PixelMap | None, truth: FloatArray) -> float:
    assert found is not None
    corners = np.array([[0.0, 0], [SIZE_PX, 0], [0, SIZE_PX], [SIZE_PX, SIZE_PX]])
    return float(np.abs(found.forward(corners) - transform(truth, corners)).max())


@pytest.mark.parametrize("kind", ["similarity", "affine"])
@pytest.mark.parametrize("share", [1.0, 0.5, 0.2])
def test_finds_the_model_and_its_inliers(kind: str, share: float) -> None:
    truth = similarity(1.02, 36.0, 400.0, -180.0)
    if kind == "affine":
        truth[:, :2] = truth[:, :2] @ [[1.1, 0.05], [0.0, 0.95]]
    inliers = int(400 * share)
    source, reference = contaminated(truth, inliers, 400, seed=1)
    found = consensus(source, reference, 1.5, kind)
    assert corner_error(found.map, truth) < 0.3
    assert found.inliers[:inliers].mean() > 0.99
    assert found.inliers[inliers:].sum() <= 3


def test_affine_follows_an_anisotropic_model() -> None:
    truth = np.array([[0.5, 0.0, 30.0], [0.0, 1.0, -20.0]])
    source, reference = contaminated(truth, 60, 150, seed=2)
    found = consensus(source, reference, 1.5)
    assert corner_error(found.map, truth) < 0.6


def test_the_same_matches_give_the_same_bytes() -> None:
    source, reference = contaminated(similarity(1, 5, 3, 4), 60, 300, seed=5)
    first, again = (consensus(source, reference, 1.5) for _ in range(2))
    assert first.map is not None
    assert again.map is not None
    assert first.map.affine == again.map.affine
    assert first.inliers.tobytes() == again.inliers.tobytes()


@pytest.mark.parametrize(("kind", "inliers"), [("similarity", 8), ("affine", 16)])
def test_few_of_200_matches_are_enough(kind: str, inliers: int) -> None:
    right = 0
    for seed in range(10):
        truth = similarity(1.1, 30.0 * seed, 50.0, 20.0)
        source, reference = contaminated(truth, inliers, 200, seed)
        found = consensus(source, reference, 1.5, kind)
        assert found.map is not None
        residual = radial_residuals(found.map, source, reference)
        nfa, _ = log_nfa(residual, SIZE_PX**2, 2 if kind == "similarity" else 3)
        right += corner_error(found.map, truth) < 3.0 and nfa < 0
    assert right >= 9


@pytest.mark.parametrize(("kind", "sample_size"), [("similarity", 2), ("affine", 3)])
def test_random_matches_say_nothing(kind: str, sample_size: int) -> None:
    alarms = 0
    for seed in range(20):
        source, reference = contaminated(similarity(1, 0, 0, 0), 0, 200, 100 + seed)
        found = consensus(source, reference, 1.5, kind)
        if found.map is not None:
            residual = radial_residuals(found.map, source, reference)
            alarms += log_nfa(residual, SIZE_PX**2, sample_size)[0] < 0
    assert alarms <= 1


def test_mirrored_scene_is_not_a_model() -> None:
    mirror = np.array([[-1.0, 0.0, SIZE_PX], [0.0, 1.0, 0.0]])
    source, reference = contaminated(mirror, 200, 200, seed=6, sigma_px=0.0)
    found = consensus(source, reference, 1.5)
    assert found.inliers.sum() < 10


def test_matches_that_collapse_to_one_point_are_not_a_model() -> None:
    rng = np.random.default_rng(7)
    source = rng.uniform(0, SIZE_PX, (100, 2))
    reference = np.full((100, 2), 500.0) + rng.uniform(-1, 1, (100, 2))
    found = consensus(source, reference, 1.5)
    assert found.inliers.sum() < 50


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_matches_give_no_map_and_no_inliers(count: int) -> None:
    xy = np.arange(2.0 * count).reshape(count, 2)
    found = consensus(xy, xy, 1.5)
    assert found.map is None
    assert found.inliers.shape == (count,)
    assert not found.inliers.any()


def test_collinear_matches_do_not_fix_an_affine() -> None:
    xy = np.stack([np.arange(20.0), 2 * np.arange(20.0)], 1)
    assert consensus(xy, xy, 1.5).map is None


def test_log_nfa_equals_its_formula() -> None:
    residual = np.array([0.5, 0.7, 300.0, 0.2, 400.0, 0.9])
    area, size = 1e6, 2
    expected = min(
        math.log10(
            (6 - size)
            * math.comb(6, k)
            * math.comb(k, size)
            * (math.pi * sorted(residual)[k - 1] ** 2 / area) ** (k - size)
        )
        for k in range(size + 1, 7)
    )
    found, threshold = log_nfa(residual, area, size)
    assert found == pytest.approx(expected, rel=1e-12)
    assert threshold == 0.9


def test_log_nfa_with_no_more_matches_than_the_sample_is_infinite() -> None:
    assert log_nfa(np.zeros(3), 1e6, 3)[0] == math.inf
    assert log_nfa(np.empty(0), 1e6, 3)[0] == math.inf


def test_log_nfa_ignores_thresholds_beyond_the_limit() -> None:
    residual = np.array([1.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0, 5.0])
    assert log_nfa(residual, 1e6, 2)[1] == 5.0
    assert log_nfa(residual, 1e6, 2, max_residual_px=2.0)[1] == 1.0


def test_a_plain_fit_recovers_exact_models() -> None:
    rng = np.random.default_rng(8)
    xy = rng.uniform(0, SIZE_PX, (12, 2))
    turned = similarity(1.3, 77.0, 12.0, -9.0)
    sheared = np.array([[1.1, 0.2, 5.0], [-0.1, 0.9, -7.0]])
    for truth, kind in ((turned, "similarity"), (sheared, "affine")):
        found = fit_plainly(xy, transform(truth, xy), kind)
        np.testing.assert_allclose(affine_matrix(found.affine), truth)
