"""Dense patches that agree, a few that do, and none: a fit, or none, and no error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geodelreg.fine.layers import agreement
from geodelreg.fit.estimate import Observations
from geodelreg.fit.models import Frame
from geodelreg.geo.maps.affine import IDENTITY
from geodelreg.values.points import Status

FRAME = Frame((100.0, 100.0), 100.0)


def observe(moves: np.ndarray, sigma_px: float = 0.01) -> Observations:
    """Patches of a raster of 200 px that moved so far, with errors."""
    rng = np.random.default_rng(len(moves))
    source = rng.uniform(0, 200, (len(moves), 2))
    target = source + moves + sigma_px * rng.standard_normal(moves.shape)
    return Observations(source, target, np.broadcast_to(sigma_px**2 * np.eye(2), (*moves.shape, 2)))


@pytest.mark.parametrize("alike", [0, 2, 4, 30])
def test_patches_most_of_which_go_their_own_way(alike: int) -> None:
    rng = np.random.default_rng(alike)
    moves = np.concatenate([np.full((alike, 2), 0.4), rng.uniform(-1.5, 1.5, (12, 2))])
    points = observe(moves)
    status, estimate = agreement(points, np.zeros(len(moves), np.uint8), IDENTITY, FRAME, 1.0)
    assert len(status) == len(moves)
    if alike == 30:
        assert estimate is not None
        assert (status[:alike] == Status.KEPT).mean() > 0.9
        moved = estimate.map.forward(np.array([[100.0, 100.0]])) - 100.0
        np.testing.assert_allclose(moved, 0.4, atol=0.02)


def test_patches_over_relief_all_have_their_say() -> None:
    """It displaces neighbours alike; those that happen to agree are no better than the others."""
    points = observe(np.zeros((400, 2)))
    x, y = points.source.T
    true = np.array([[1.002, 0.001], [-0.001, 0.998]])
    relief = 0.4 * np.stack([np.sin(y / 12), np.cos(x / 12)], axis=1)
    points = replace(points, target=(points.source - 100) @ true.T + 100 + relief)
    status, estimate = agreement(points, np.zeros(400, np.uint8), IDENTITY, FRAME, 1.0)
    assert estimate is not None
    assert (status == Status.KEPT).mean() > 0.9
    corners = np.array([[0.0, 0.0], [200.0, 0.0], [0.0, 200.0], [200.0, 200.0]])
    expected = (corners - 100) @ true.T + 100
    np.testing.assert_allclose(estimate.map.forward(corners), expected, atol=0.25)


def test_ground_between_clouds_of_many_heights_is_found() -> None:
    rng = np.random.default_rng(7)
    heights = rng.uniform(0.2, 1.4, 280)
    moves = np.concatenate([np.zeros((120, 2)), heights[:, None] * [0.2, 1.0]])
    points = observe(moves, 0.03)
    status, estimate = agreement(points, np.zeros(400, np.uint8), IDENTITY, FRAME, 1.0)
    assert estimate is not None
    assert (status[:120] == Status.KEPT).mean() > 0.9
    middle = np.array([[100.0, 100.0]])
    np.testing.assert_allclose(estimate.map.forward(middle), middle, atol=0.03)


@pytest.mark.parametrize(("count", "model"), [(0, None), (3, None), (8, "shift"), (40, "affine")])
def test_the_model_grows_with_the_number_of_patches(count: int, model: str | None) -> None:
    points = observe(np.full((count, 2), 0.3))
    _, estimate = agreement(points, np.zeros(count, np.uint8), IDENTITY, FRAME, 1.0)
    assert (estimate.model if estimate else None) == model
