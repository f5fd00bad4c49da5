"""Delaunay triangulation and its measures on hand-made points."""

from __future__ import annotations

import numpy as np
import pytest

from geodelreg.geo.triangulation import (
    delaunay,
    edges,
    incircle_sine,
    interior_edges,
    relative_altitude,
    twice_area,
)

SQUARE = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10], [5, 4]])


def test_square_with_a_point_inside() -> None:
    triangles = delaunay(SQUARE)
    assert triangles.tolist() == [[0, 1, 4], [0, 4, 3], [1, 2, 4], [2, 3, 4]]
    assert twice_area(SQUARE, triangles).tolist() == [40.0, 50.0, 50.0, 60.0]


@pytest.mark.parametrize(
    "xy",
    [
        np.empty((0, 2)),
        np.array([[1.0, 2]]),
        np.array([[1.0, 2], [3, 4]]),
        np.array([[1.0, 2], [1.0, 2], [3, 4], [3, 4]]),
        np.stack([np.arange(9.0), 3 * np.arange(9.0)], 1),
        np.array([[0.0, 0], [1, 0], [np.nan, 1]]),
    ],
)
def test_nothing_to_triangulate(xy: np.ndarray) -> None:
    triangles = delaunay(xy)
    assert triangles.shape == (0, 3)
    assert edges(triangles).shape == (0, 2)
    assert len(interior_edges(triangles).ends) == 0
    assert relative_altitude(xy, triangles).shape == (0,)
    assert incircle_sine(xy, interior_edges(triangles)).shape == (0,)


def test_of_points_at_one_place_the_first_takes_part() -> None:
    xy = np.array([[0.0, 0], [10, 0], [10, 0], [0, 10], [-0.0, 0.0]])
    assert delaunay(xy).tolist() == [[0, 1, 3]]


def test_points_that_are_not_finite_do_not_take_part() -> None:
    xy = np.array([[np.nan, 0], [0.0, 0], [10, 0], [np.inf, 1], [0, 10]])
    assert delaunay(xy).tolist() == [[1, 2, 4]]


def test_order_of_points_does_not_change_the_mesh() -> None:
    xy = np.random.default_rng(1).uniform(0, 100, (60, 2))
    shuffle = np.random.default_rng(2).permutation(60)
    mapped = shuffle[delaunay(xy[shuffle])]
    assert {frozenset(t) for t in mapped.tolist()} == {frozenset(t) for t in delaunay(xy).tolist()}


def test_edges_of_the_square() -> None:
    triangles = delaunay(SQUARE)
    assert edges(triangles).tolist() == [
        [0, 1], [0, 3], [0, 4], [1, 2], [1, 4], [2, 3], [2, 4], [3, 4],
    ]  # fmt: skip


def test_interior_edges_of_the_square() -> None:
    interior = interior_edges(delaunay(SQUARE))
    found = {
        tuple(ends): set(opposite)
        for ends, opposite in zip(interior.ends.tolist(), interior.opposite.tolist(), strict=True)
    }
    assert found == {(0, 4): {1, 3}, (1, 4): {0, 2}, (2, 4): {1, 3}, (3, 4): {0, 2}}


def test_relative_altitude_is_known_for_simple_triangles_and_free_of_scale() -> None:
    xy = np.array([[0.0, 0], [1, 0], [0.5, np.sqrt(3) / 2], [0.5, 0.01], [2, 0]])
    triangles = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    expected = [np.sqrt(3) / 2, 0.01, 0.0]
    np.testing.assert_allclose(relative_altitude(xy, triangles), expected, atol=1e-12)
    np.testing.assert_allclose(relative_altitude(1e5 * xy + 3, triangles), expected, atol=1e-12)


def test_incircle_sine_is_zero_on_a_circle_and_grows_off_it() -> None:
    angle = np.radians([0.0, 80.0, 170.0, 265.0])
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    values = []
    for outwards in (1.0, 1.02, 1.1):
        xy = circle.copy()
        xy[3] *= outwards
        interior = interior_edges(delaunay(xy))
        assert len(interior.ends) == 1
        values.append(float(incircle_sine(xy, interior)[0]))
    assert abs(values[0]) < 1e-12
    assert 0.001 < values[1] < values[2] < 0.5


def test_incircle_sine_is_the_determinant_over_the_four_sides() -> None:
    xy = np.random.default_rng(3).uniform(0, 1000, (40, 2))
    interior = interior_edges(delaunay(xy))
    sine = incircle_sine(xy, interior)
    for k, ((i, j), (p, q)) in enumerate(
        zip(interior.ends.tolist(), interior.opposite.tolist(), strict=True)
    ):
        rows = [[*(xy[n] - xy[q]), ((xy[n] - xy[q]) ** 2).sum(), 1] for n in (i, j, p, q)]
        sides = np.prod([np.linalg.norm(xy[n] - xy[m]) for n in (i, j) for m in (p, q)])
        determinant = abs(np.linalg.det(np.array(rows))) / sides
        assert determinant == pytest.approx(sine[k], rel=1e-6) or sine[k] == 1.0


def test_incircle_sine_is_one_for_far_apart_circles() -> None:
    xy = np.array([[0.0, -0.5], [0.0, 0.5], [5.0, 0.0], [-5.0, 0.0]])
    interior = interior_edges(np.array([[0, 2, 1], [0, 1, 3]]))
    assert incircle_sine(xy, interior).tolist() == [1.0]
