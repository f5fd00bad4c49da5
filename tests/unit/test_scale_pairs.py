"""The pairs of any size that `benchmarks scale` runs on, and its figures."""

from __future__ import annotations

import math

import numpy as np
import pytest
from affine import Affine
from pyproj import CRS

from benchmarks.scale.pairs import EndlessGround, integration_axis, pair_truth
from benchmarks.scale.row import PLAIN, Row
from benchmarks.scale.run import growth, table
from benchmarks.scenes.imagery import Imagery
from benchmarks.scenes.truth import grid_rmse


@pytest.fixture(scope="module")
def imagery() -> Imagery:
    bands = np.random.default_rng(3).uniform(200, 3000, (4, 60, 64)).astype(np.float32)
    return Imagery(bands, Affine(10, 0, 5e5, 0, -10, 5e6), CRS.from_epsg(32633).to_wkt(), "noise")


def test_ground_is_the_same_through_every_window(imagery: Imagery) -> None:
    ground = EndlessGround.of(imagery, 300)
    whole = list(ground.radiance((0, 300), (0, 300)))
    parts = list(ground.radiance((57, 188), (119, 241)))
    for one, part in zip(whole, parts, strict=True):
        np.testing.assert_allclose(part, one[57:188, 119:241], rtol=1e-5)


def test_ms_pixels_integrate_a_ramp_at_their_centres() -> None:
    matrix, (start, stop) = integration_axis((3, 9), 4.002, 7.3)
    ramp = np.arange(start, stop) + 0.5
    np.testing.assert_allclose(matrix @ ramp, (np.arange(3, 9) + 0.5) * 4.002 + 7.3, atol=1e-4)


def test_header_of_a_pair_is_off_by_what_scene_j_is(imagery: Imagery) -> None:
    truth = pair_truth(300, imagery)
    error = grid_rmse(Affine(*truth.ms_header), truth)["rmse_px"]
    assert error == pytest.approx(math.hypot(12.3, 7.8), abs=0.1)
    assert grid_rmse(Affine(*truth.ms_true), truth)["max_px"] == 0


def row(size: int, match_s: float, wall_s: float = 4.0) -> Row:
    return Row(PLAIN, size, 1, 1, wall_s, 3, 200, match_s, 0.001, {}, 1.0, 0.5, "")


def test_growth_is_per_four_times_the_pixels() -> None:
    assert growth([row(1000, 1.0), row(2000, 1.1), row(8000, 1.1 * 1.2**2)]) == pytest.approx(1.2)


def test_limits_decide_what_is_met() -> None:
    kept, missed = row(1000, 1.0, 5.2), row(1000, 1.0, 5.3)
    assert kept.limit_s == pytest.approx(5.25)
    assert [line.split(" | ")[-1] for line in table([kept, missed])][-2:] == ["met |", "missed |"]
