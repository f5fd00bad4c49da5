"""Bright objects are found when they stand apart, and only then."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray
from scipy import ndimage

from geodelreg.fine.layers import bright_mask, bright_threshold
from geodelreg.values.raster import Band, Grid

SHAPE = (120, 150)


def texture(seed: int = 0, sigma: float = 2.0) -> NDArray[np.float64]:
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(SHAPE), sigma)
    return 800 + 120 * noise / noise.std()


def clouds(share: float) -> NDArray[np.bool_]:
    noise = ndimage.gaussian_filter(np.random.default_rng(7).standard_normal(SHAPE), 8)
    return noise > np.quantile(noise, 1 - share)


def band(data: NDArray[np.float64], valid: NDArray[np.bool_] | None = None) -> Band:
    good = np.ones(data.shape, bool) if valid is None else valid
    return Band(data.astype(np.float32), good, Grid(Affine.identity(), data.shape, ""), "")


@pytest.mark.parametrize("share", [0.05, 0.2, 0.5])
def test_clouds_are_covered_and_little_else(share: float) -> None:
    cloud = clouds(share)
    mask = bright_mask(band(np.where(cloud, texture() + 2400, texture())))
    assert mask is not None
    assert mask[cloud].all()
    assert not mask[ndimage.distance_transform_edt(~cloud) > 6].any()
    assert mask[ndimage.distance_transform_edt(~cloud) <= 5].all()


@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e4])
def test_the_split_does_not_depend_on_units(scale: float) -> None:
    cloud = clouds(0.2)
    threshold = bright_threshold(band(scale * np.where(cloud, texture() + 2400, texture())))
    assert threshold is not None
    assert scale * texture().max() * 0.9 < threshold < scale * 3000


@pytest.mark.parametrize("seed", range(4))
def test_plain_texture_has_no_bright_objects(seed: int) -> None:
    assert bright_mask(band(texture(seed))) is None


def test_a_smooth_slope_has_none() -> None:
    assert bright_threshold(band(np.add.outer(np.arange(120.0), np.arange(150.0)))) is None


def test_too_little_of_anything_is_no_split() -> None:
    image = np.where(clouds(0.004), 4000.0, texture())
    assert bright_threshold(band(image)) is None
    assert bright_threshold(band(np.full(SHAPE, 7.0))) is None
    assert bright_threshold(band(np.where(clouds(0.5), 1e6 + 0.1, 1e6))) is None
    assert bright_threshold(band(texture(), np.zeros(SHAPE, bool))) is None
    assert bright_threshold(band(texture()[:10, :10])) is None


def test_invalid_pixels_have_no_say() -> None:
    gap = np.zeros(SHAPE, bool)
    gap[:, :50] = True
    assert bright_mask(band(np.where(gap, 60_000.0, texture()), ~gap)) is None
    cloud = clouds(0.2)
    image = np.where(gap, 60_000.0, np.where(cloud, texture() + 2400, texture()))
    mask = bright_mask(band(image, ~gap))
    assert mask is not None
    assert mask[cloud & ~gap].all()
    assert not mask[:, :40].any()
