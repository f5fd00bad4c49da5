"""The Delaunay filters on matches whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from geodelreg.fit.consensus import Consensus, consensus
from geodelreg.fit.delaunay_mesh import filter_matches, star_filter, unfolded
from geodelreg.geo.triangulation import delaunay, twice_area
from geodelreg.values.points import Status
from geodelreg.values.raster import BoolArray, FloatArray, StatusArray

SIZE_PX = 1000.0


def contaminated(
    count: int, outlier_share: float, seed: int, distortion_px: float = 2.0, sigma_px: float = 0.3
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Matches under a random similarity and smooth distortion, and which of them are right."""
    rng = np.random.default_rng(seed)
    source = rng.uniform(0, SIZE_PX, (count, 2))
    turn, scale = rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 1.1)
    linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    reference = (source - SIZE_PX / 2) @ linear.T + SIZE_PX / 2 + rng.uniform(-50, 50, 2)
    phase = 2 * np.pi * source / SIZE_PX + rng.uniform(0, 2 * np.pi, 2)
    wave = np.sin(phase) * np.cos(phase[:, ::-1])
    reference += distortion_px * wave + sigma_px * rng.standard_normal((count, 2))
    wrong = np.arange(count) < round(outlier_share * count)
    reference[wrong] = rng.uniform(0, SIZE_PX, (int(wrong.sum()), 2))
    return source, reference, rng.uniform(0.4, 0.8, count), ~wrong


def filtered(
    source: FloatArray, reference: FloatArray, ratio: FloatArray, found: Consensus | None = None
) -> StatusArray:
    """What the mesh leaves of a loose consensus."""
    if found is None:
        found = consensus(source, reference, 8.0)
    return filter_matches(source, reference, found)


def precision_recall(keep: BoolArray, right: BoolArray) -> tuple[float, float]:
    both = (keep & right).sum()
    return float(both / max(keep.sum(), 1)), float(both / right.sum())


@pytest.mark.parametrize("distortion_px", [0.0, 2.0])
@pytest.mark.parametrize("outlier_share", [0.0, 0.3, 0.5, 0.7])
@pytest.mark.parametrize("count", [300, 1000])
def test_precision_and_recall(count: int, outlier_share: float, distortion_px: float) -> None:
    figures = []
    for seed in range(3):
        *matches, right = contaminated(count, outlier_share, seed, distortion_px)
        keep = filtered(*matches) == Status.KEPT
        figures.append(precision_recall(keep, right))
    precision, recall = np.mean(figures, axis=0)
    assert precision >= 0.99
    assert recall >= 0.97


def test_global_consensus_alone_would_lose_distorted_inliers() -> None:
    """What the mesh is for: at the tolerance that noise alone asks for, an affine loses many."""
    source, reference, ratio, right = contaminated(500, 0.3, seed=4)
    alone = consensus(source, reference, 1.5).inliers
    assert precision_recall(alone, right)[1] < 0.8
    mesh = filtered(source, reference, ratio) == Status.KEPT
    assert precision_recall(mesh, right)[1] > 0.99


def test_recovers_inliers_that_the_consensus_lost() -> None:
    source, reference, ratio, right = contaminated(500, 0.5, seed=5, distortion_px=4.0)
    found = consensus(source, reference, 2.5)
    lost = right & ~found.inliers
    assert lost.sum() > 30
    kept = filtered(source, reference, ratio, found) == Status.KEPT
    assert kept[lost].mean() > 0.8
    assert precision_recall(kept, right)[0] > 0.99


@pytest.mark.parametrize("outlier_share", [0.1, 0.33])
def test_star_alone_stands_a_third_of_mismatches(outlier_share: float) -> None:
    figures = []
    for seed in range(4):
        source, reference, _, right = contaminated(400, outlier_share, seed)
        figures.append(precision_recall(star_filter(source, reference), right))
    assert np.mean(figures, axis=0)[0] > 0.99
    assert np.mean(figures, axis=0)[1] > 0.98


def test_star_finds_small_mismatches_where_covariance_is_small() -> None:
    source, reference, _, _ = contaminated(400, 0.0, seed=6, distortion_px=0.5, sigma_px=0.02)
    moved = np.arange(400) % 20 == 0
    reference[moved] += 0.4
    covariance = np.tile(0.02**2 * np.eye(2), (400, 1, 1))
    keep = star_filter(source, reference, covariance)
    assert not keep[moved].any()
    assert keep[~moved].mean() > 0.97
    assert star_filter(source, reference)[moved].all()


def test_star_stands_understated_covariance() -> None:
    """The spread is taken from the mesh itself where that is larger than stated."""
    source, reference, _, _ = contaminated(400, 0.0, seed=7, distortion_px=0.0, sigma_px=0.5)
    covariance = np.tile(0.01**2 * np.eye(2), (400, 1, 1))
    assert star_filter(source, reference, covariance).mean() > 0.98


def test_nothing_is_kept_of_random_matches() -> None:
    rejected = 0
    for seed in range(10):
        *matches, _ = contaminated(200, 1.0, 100 + seed)
        result = filtered(*matches)
        rejected += not (result == Status.KEPT).any()
        if rejected == seed + 1:
            assert (result == Status.CONSENSUS).all()
    assert rejected >= 9


def test_status_tells_consensus_from_star() -> None:
    source, reference, ratio, right = contaminated(300, 0.3, seed=8, distortion_px=0.5)
    near = np.flatnonzero(right)[::20]
    reference[near] += 5.0
    result = filtered(source, reference, ratio)
    assert (result[near] == Status.STAR).all()
    assert (result[~right] == Status.CONSENSUS).mean() > 0.97


def test_given_consensus_is_used() -> None:
    source, reference, ratio, right = contaminated(300, 0.4, seed=10, distortion_px=0.0)
    found = consensus(source, reference, 8.0)
    given = filtered(source, reference, ratio, found)
    assert given.tolist() == filtered(source, reference, ratio).tolist()
    nothing = Consensus(None, np.zeros(300, dtype=np.bool_))
    assert (filtered(source, reference, ratio, nothing) != Status.KEPT).all()
    assert right.any()


def test_same_input_gives_the_same_bytes() -> None:
    *matches, _ = contaminated(400, 0.6, seed=11)
    first, again = filtered(*matches), filtered(*matches)
    assert first.tobytes() == again.tobytes()


def test_unfolded_leaves_no_point_most_of_whose_triangles_flip() -> None:
    def flipped_share(xy: FloatArray, other: FloatArray) -> FloatArray:
        triangles = delaunay(xy)
        flipped = np.repeat(twice_area(other, triangles) <= 0, 3)
        corners = triangles.ravel()
        return np.bincount(corners, flipped, len(xy)) / np.bincount(corners, minlength=len(xy))

    source, reference, _, right = contaminated(300, 0.2, seed=12)
    assert (flipped_share(source, reference) > 0.5).sum() > 10
    keep = unfolded(source, reference)
    assert (flipped_share(source[keep], reference[keep]) <= 0.5).all()
    assert keep[right].mean() > 0.95
    assert keep[~right].mean() < 0.8


def test_mirrored_matches_are_not_kept() -> None:
    source = np.random.default_rng(13).uniform(0, SIZE_PX, (100, 2))
    assert not star_filter(source, source * [-1.0, 1.0]).any()


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_too_few_points_to_tell(count: int) -> None:
    source, reference, ratio, _ = contaminated(count, 0.0, seed=14)
    assert star_filter(source, reference).tolist() == [True] * count
    assert filtered(source, reference, ratio).shape == (count,)


@pytest.mark.parametrize("count", [5, 9, 14])
def test_few_points_with_one_mismatch(count: int) -> None:
    source, reference, ratio, _ = contaminated(count, 0.0, seed=15, distortion_px=0.0)
    reference[2] += [90.0, -60.0]
    expected = [i != 2 for i in range(count)]
    assert (filtered(source, reference, ratio) == Status.KEPT).tolist() == expected


def test_points_on_a_line_and_at_one_place_do_no_harm() -> None:
    line = np.stack([np.arange(40.0), np.arange(40.0)], 1)
    assert star_filter(line, line + 3.0).all()
    source, reference, _, _ = contaminated(60, 0.0, seed=16)
    twice = np.concatenate([source, source[:5]])
    assert star_filter(twice, np.concatenate([reference, reference[:5]])).mean() > 0.95
