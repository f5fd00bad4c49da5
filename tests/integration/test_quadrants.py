"""The benchmark of quarters of a pair against the rest: what it tells of pairs with known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from benchmarks.accuracy.quadrants import Quadrant, interval, quadrants
from benchmarks.scenes.imagery import sample_imagery
from benchmarks.scenes.make import HeaderError, SceneSpec, make_scene, write_scene

SPEC = SceneSpec("quarters", "", HeaderError((1.3, -0.7)), (400, 400), (190, 190), ratio=2.0)


def test_a_quarter_that_was_moved_is_told_from_the_rest_by_as_much(tmp_path: Path) -> None:
    write_scene(make_scene(SPEC, sample_imagery()), tmp_path)
    with rasterio.open(tmp_path / "ms.tif", "r+") as source:
        data = source.read()
        data[:, 95:, 95:] = np.roll(data, 1, axis=2)[:, 95:, 95:]
        source.write(data)
    found = list(quadrants("made", tmp_path / "ms.tif", tmp_path / "pan.tif", 1))
    assert found[0] is None  # its rest is torn
    assert found[3] is not None
    assert found[3].apart_px == pytest.approx(2.0, abs=0.1)
    assert found[3].normalised > 10


def test_the_interval_is_of_pairs_and_not_of_quarters() -> None:
    calm, rough = ([Quadrant(name, z, 1.0)] * 4 for name, z in (("calm", 0.5), ("rough", 2.0)))
    assert interval([calm]) == (0.5, 0.5)
    low, high = interval([calm, rough])
    assert (low, high) == (0.5, 2.0)
