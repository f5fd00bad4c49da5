"""Refinement of ground that changed between the images."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS
from scipy import ndimage

from geodelreg.coarse.scopes import read_overview, scopes
from geodelreg.fine.layers import Pass, agreement
from geodelreg.fine.least_squares import Matched
from geodelreg.fine.looks import preference
from geodelreg.fine.passes import refine
from geodelreg.fine.tuning import lowest
from geodelreg.fit.estimate import Observations
from geodelreg.fit.models import Frame
from geodelreg.geo.maps.affine import IDENTITY
from geodelreg.options import AlignOptions
from geodelreg.pair import make_pair, roles
from geodelreg.values.points import Guess
from geodelreg.values.raster import Band, Grid
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
    images = read_overview(pair, next(scopes(pair)))
    refined = refine(roles(pair), Guess(IDENTITY, float("nan"), {}, images))
    assert refined is not None
    assert refined.last.kept >= 12
    middle = pair.source_centre
    moved = refined.estimate.map.forward(middle) - middle
    np.testing.assert_allclose(moved[0], -shift, atol=0.15)


@pytest.mark.parametrize("factor", [1, 3])
def test_pixels_of_enlarged_rasters_are_averaged(factor: int) -> None:
    place = Affine(8.0, 0.0, 5e5, 0.0, -8.0, 1e6)
    crs = CRS.from_epsg(32616).to_wkt()
    fine = ndimage.gaussian_filter(texture(5, (640, 640)), 1.0)
    small = fine.reshape(160, 4, 160, 4).mean(axis=(1, 3))
    ms = ndimage.zoom(small, factor, order=1, mode="nearest", grid_mode=True)

    def band(values: NDArray[np.float64], pixel: float) -> Band:
        valid = np.ones(values.shape, dtype=bool)
        grid = Grid(place @ Affine.scale(pixel), values.shape, crs)
        return Band(values.astype(np.float32), valid, grid)

    source, reference = ArrayReader((band(ms, 1 / factor),)), ArrayReader((band(fine, 0.25),))
    pair = make_pair(source, reference, AlignOptions())
    images = read_overview(pair, next(scopes(pair)))
    refined = refine(roles(pair), Guess(IDENTITY, float("nan"), {}, images))
    assert refined is not None
    assert (refined.part.step > 1) == (factor > 1)
    assert not refined.is_blurred
    corners = pair.source_lattice(2)
    found = refined.estimate.map.forward(corners)
    np.testing.assert_allclose(found, corners, atol=0.01 * factor)


def test_thelowest_place_lies_between_its_neighbours() -> None:
    assert lowest({0.3: 2.0, 0.4: 1.0, 0.5: 2.0}) == pytest.approx(0.4)
    assert lowest({place: (place - 0.95) ** 2 for place in (0.7, 0.85, 1.0, 1.2)}) == pytest.approx(
        0.95
    )
    assert lowest({0.3: 1.0, 0.4: 2.0}) == 0.3
    assert lowest({0.3: 1.0, 0.4: 1.0, 0.5: 1.0}) == 0.3


def one_pass(count: int, noise_px: float) -> Pass:
    """Of so many patches that agree to within the noise."""
    rng = np.random.default_rng(count)
    source = rng.uniform(0, SIDE, (count, 2))
    target = source + rng.normal(0, noise_px, (count, 2))
    covariance = np.tile(np.eye(2) * noise_px**2, (count, 1, 1))
    points, status = Observations(source, target, covariance), np.zeros(count, np.uint8)
    frame = Frame((SIDE / 2, SIDE / 2), SIDE / 2)
    return Pass(Matched.joined([]), points, *agreement(points, status, IDENTITY, frame, 1.0))


def test_a_shift_of_few_patches_is_not_preferred_to_an_affine_of_many() -> None:
    few, many = one_pass(5, 0.02), one_pass(30, 0.02)
    assert few.estimate is not None
    assert many.estimate is not None
    assert few.estimate.is_shift
    assert not many.estimate.is_shift
    assert preference(many) < preference(few)
    assert preference(one_pass(60, 0.02)) < preference(many)
