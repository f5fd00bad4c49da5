"""Ways to look at the MS bands with keypoints."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine

from geodelreg.fine.looks import band_looks, mean_band
from geodelreg.values.raster import Band, Grid


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8])
def test_no_look_is_taken_twice(count: int) -> None:
    rng = np.random.default_rng(count)
    grid = Grid(Affine.identity(), (30, 40), "")
    bands = [
        Band(rng.random(grid.shape, np.float32), np.ones(grid.shape, np.bool_), grid, f"band {n}")
        for n in range(count)
    ]
    seen = [mean_band([look]).data for look in band_looks(bands)]
    alike = [
        np.abs(one - other).max() < 1e-3 for n, one in enumerate(seen) for other in seen[n + 1 :]
    ]
    assert not any(alike)
