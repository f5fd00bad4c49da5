"""Stars on the mesh and what they predict."""

from __future__ import annotations

import numpy as np
import pytest

from geodelreg.fit.neighbourhood import Field, predict
from geodelreg.geo.triangulation import delaunay, edges, own_stars, stars_of
from geodelreg.values.raster import FloatArray


def scattered(count: int, seed: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(0, 1000, (count, 2))


def members(star: object, count: int) -> list[set[int]]:
    target, member = star.target, star.member  # type: ignore[attr-defined]
    return [set(member[target == i].tolist()) for i in range(count)]


def test_star_is_neighbours_and_theirs() -> None:
    xy = scattered(60, 1)
    triangles = delaunay(xy)
    adjacent = np.zeros((60, 60), dtype=int)
    adjacent[tuple(edges(triangles).T)] = 1
    adjacent += adjacent.T
    within_two = (adjacent + adjacent @ adjacent > 0) & ~np.eye(60, dtype=bool)
    expected = [set(np.flatnonzero(row).tolist()) for row in within_two]
    assert members(own_stars(triangles, 60), 60) == expected


def test_few_points_are_all_in_each_others_star() -> None:
    star = own_stars(delaunay(scattered(7, 2)), 7)
    assert members(star, 7) == [set(range(7)) - {i} for i in range(7)]


def test_star_of_a_new_point_is_that_of_the_nearest_and_the_nearest() -> None:
    xy, targets = scattered(60, 3), scattered(9, 4)
    own = own_stars(delaunay(xy), 60)
    nearest = np.linalg.norm(targets[:, None] - xy[None], axis=2).argmin(1)
    expected = [members(own, 60)[n] | {int(n)} for n in nearest]
    assert members(stars_of(targets, xy, own), 9) == expected


@pytest.mark.parametrize("wrong_share", [0.0, 0.2])
def test_small_gradients_are_reproduced_even_with_mismatches(wrong_share: float) -> None:
    xy = scattered(300, 5)
    displacement = xy @ np.array([[0.004, -0.002], [0.003, 0.001]]) + [3.0, -2.0]
    wrong = np.arange(300) < wrong_share * 300
    seen = displacement.copy()
    seen[wrong] += np.random.default_rng(6).uniform(-200, 200, (int(wrong.sum()), 2))
    told = predict(xy, own_stars(delaunay(xy), 300), Field(xy, seen, np.full(300, 0.01)), 0.02)
    error = np.hypot(*(told.displacement - displacement).T)
    assert np.median(error) < 0.02
    assert (error < 0.3).mean() > 0.97


def test_stated_variance_of_the_prediction_errs_on_the_large_side() -> None:
    xy = scattered(400, 7)
    own = own_stars(delaunay(xy), 400)
    sigma = 0.3
    ratios = []
    for seed in range(5):
        noise = sigma * np.random.default_rng(seed).standard_normal((400, 2))
        told = predict(xy, own, Field(xy, noise, np.full(400, sigma**2)), 0.02)
        ratios.append(told.displacement**2 / told.variance[:, None])
    assert 0.5 < np.sqrt(np.mean(ratios)) < 1.0


def test_accurate_members_count_more_than_vague_ones() -> None:
    xy = scattered(10, 8)
    displacement = np.tile([5.0, 5.0], (10, 1))
    displacement[0] = [4.0, 4.0]
    variance = np.full(10, 100.0)
    variance[0] = 0.01
    told = predict(xy, own_stars(delaunay(xy), 10), Field(xy, displacement, variance), 0.001)
    assert np.median(told.displacement[1:]) < 4.1


def test_scatter_is_the_variance_of_the_members() -> None:
    xy = scattered(500, 9)
    noise = 0.6 * np.random.default_rng(10).standard_normal((500, 2))
    told = predict(xy, own_stars(delaunay(xy), 500), Field(xy, noise, np.full(500, 0.36)), 0.02)
    assert 0.4 < np.median(told.scatter) < 1.2
