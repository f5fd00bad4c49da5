"""What holds for every Delaunay triangulation, with scipy as a second opinion."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import ConvexHull, Delaunay, QhullError

from geodelreg.geo.triangulation import (
    delaunay,
    edges,
    incircle_sine,
    interior_edges,
    relative_altitude,
    twice_area,
)

lattice_points = hnp.arrays(np.int64, st.tuples(st.integers(0, 40), st.just(2)),
                            elements=st.integers(0, 12)).map(lambda a: a.astype(float))  # fmt: skip
seeds = st.integers(0, 2**32 - 1)


def random_points(seed: int, count: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-500, 500, (count, 2))


def hull_area(xy: np.ndarray) -> float:
    try:
        return float(ConvexHull(xy).volume)
    except (QhullError, ValueError):
        return 0.0


@given(lattice_points)
@settings(max_examples=100)
def test_triangles_tile_the_hull_and_use_every_place(xy: np.ndarray) -> None:
    """Lattice points: duplicates, collinear and cocircular points abound."""
    triangles = delaunay(xy)
    area = hull_area(xy)
    assert np.isclose(twice_area(xy, triangles).sum() / 2, area, rtol=1e-9, atol=1e-9)
    assert (twice_area(xy, triangles) > 0).all()
    if area > 0:
        used = xy[np.unique(triangles)]
        assert len(used) == len(np.unique(xy, axis=0)) == len(np.unique(used, axis=0))


@given(lattice_points)
@settings(max_examples=60)
def test_no_point_lies_inside_a_circumcircle(xy: np.ndarray) -> None:
    for i, j, k in delaunay(xy).tolist():
        a, b, c = (xy[n] for n in (i, j, k))
        d = xy
        ad, bd, cd = a - d, b - d, c - d
        determinant = (
            (ad**2).sum(1) * (bd[:, 0] * cd[:, 1] - bd[:, 1] * cd[:, 0])
            - (bd**2).sum(1) * (ad[:, 0] * cd[:, 1] - ad[:, 1] * cd[:, 0])
            + (cd**2).sum(1) * (ad[:, 0] * bd[:, 1] - ad[:, 1] * bd[:, 0])
        )
        assert (determinant <= 0).all()  # integers: exact


@given(seeds)
@settings(max_examples=50)
def test_agrees_with_qhull_on_points_in_general_position(seed: int) -> None:
    xy = random_points(seed)
    expected = {frozenset(t) for t in Delaunay(xy).simplices.tolist()}
    assert {frozenset(t) for t in delaunay(xy).tolist()} == expected


@given(seeds, st.floats(1e-3, 1e5), st.floats(0, 7), st.floats(-1e6, 1e6))
@settings(max_examples=50)
def test_measures_do_not_depend_on_scale_rotation_or_place(
    seed: int, scale: float, turn: float, place: float
) -> None:
    xy = random_points(seed, 30)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = scale * (xy @ rotation.T) + place * scale
    triangles = delaunay(xy)
    interior = interior_edges(triangles)
    tolerance = {"rtol": 1e-6, "atol": 1e-8}
    np.testing.assert_allclose(
        relative_altitude(moved, triangles), relative_altitude(xy, triangles), **tolerance
    )
    np.testing.assert_allclose(
        incircle_sine(moved, interior), incircle_sine(xy, interior), **tolerance
    )
    assert (incircle_sine(xy, interior) > 0).all()


@given(lattice_points)
@settings(max_examples=60)
def test_counts_obey_euler(xy: np.ndarray) -> None:
    triangles = delaunay(xy)
    if len(triangles) == 0:
        return
    all_edges = edges(triangles)
    inner = interior_edges(triangles)
    assert len(np.unique(triangles)) - len(all_edges) + len(triangles) == 1
    assert 3 * len(triangles) == len(all_edges) + len(inner.ends)


@given(seeds)
@settings(max_examples=20)
def test_same_points_give_the_same_bytes(seed: int) -> None:
    xy = random_points(seed)
    assert delaunay(xy).tobytes() == delaunay(xy.copy()).tobytes()
