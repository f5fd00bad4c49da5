"""Whether anything moves between two images, so that what is bright may be a cloud."""

from __future__ import annotations

import numpy as np
import pytest

from geodelreg.fine.layers import Pass, nothing_moves
from geodelreg.fine.least_squares import Matched
from geodelreg.fit.estimate import Observations, robust_fit
from geodelreg.fit.models import Frame


@pytest.mark.parametrize(("share", "move_px", "still"), [(0.3, 0.25, True), (0.1, 0.8, False)])
def test_unlike_bands_are_still_and_a_tenth_of_clouds_is_not(
    share: float, move_px: float, still: bool
) -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 500, (400, 2))
    target = xy + rng.normal(0, 0.02, xy.shape)
    target[rng.random(400) < share, 0] += move_px
    points = Observations(xy, target, np.tile(np.eye(2) * 4e-4, (400, 1, 1)))
    frame = Frame((250.0, 250.0), 250.0)
    found = Pass(
        Matched.joined([]), points, np.zeros(400, np.uint8), robust_fit("shift", points, frame)
    )
    assert nothing_moves(found, 1.0) == still
