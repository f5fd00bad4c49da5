"""Refinement of ground that changed between the images."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS
from scipy import ndimage

from geodelreg.fit.models import IDENTITY
from geodelreg.options import AlignOptions
from geodelreg.pipeline.refinement import refine_densely
from geodelreg.pipeline.search import Hypothesis, read_working_pair, scopes
from geodelreg.pipeline.state import make_pair
from geodelreg.pipeline.tiles import roles
from geodelreg.types import Band, Grid, Status
from tests.unit.test_gate_evidence import ArrayReader, texture

SIDE = 90


def fields(rng: np.random.Generator) -> NDArray[np.float64]:
    """Values of either sign that change from field to field."""
    smooth = ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 14, mode="wrap")
    return np.asarray(smooth / smooth.std())


@pytest.mark.parametrize("seed", range(4))
def test_patches_match_where_every_field_changed_in_its_own_way(seed: int) -> None:
    """No common tone relates the images; a patch's own weights of the bands do."""
    rng = np.random.default_rng(seed)
    shift = np.array([0.6, -0.4])
    detail = [texture(10 * seed + number, (SIDE, SIDE)) for number in range(3)]
    moved = [ndimage.shift(band, shift[::-1], order=3, mode="wrap") for band in detail]
    pan = sum(fields(rng) * band for band in detail) + 600 * fields(rng)
    ms = [band + 600 * fields(rng) for band in moved]
    grid = Grid(Affine(2.0, 0.0, 5e5, 0.0, -2.0, 1e6), (SIDE, SIDE), CRS.from_epsg(32616).to_wkt())
    valid = np.ones(grid.shape, dtype=bool)
    bands = tuple(Band(band.astype(np.float32), valid, grid) for band in ms)
    reference = ArrayReader((Band(pan.astype(np.float32), valid, grid),))
    pair = make_pair(ArrayReader(bands), reference, AlignOptions())
    images = read_working_pair(pair, next(scopes(pair)))
    refined = refine_densely(roles(pair), Hypothesis(IDENTITY, float("nan"), {}, images), {})
    assert refined is not None
    assert (refined.dense.status == Status.KEPT).sum() >= 12
    np.testing.assert_allclose(refined.matrix[:, 2], -shift, atol=0.15)
