"""Stretch to 8 bit."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine

from geodelreg.coarse.grey import to_uint8
from geodelreg.errors import NoDataError
from geodelreg.values.raster import Band, Grid


def band(data: np.ndarray, valid: np.ndarray | None = None, name: str = "") -> Band:
    data = data.astype(np.float32)
    grid = Grid(Affine.identity(), data.shape, "")
    return Band(data, np.ones(data.shape, np.bool_) if valid is None else valid, grid, name)


def test_percentiles_become_the_ends_and_the_rest_is_linear() -> None:
    values = np.arange(10000.0).reshape(100, 100)
    grey = to_uint8(band(values))
    assert grey.dtype == np.uint8
    low, high = np.percentile(values, (0.5, 99.5))
    expected = np.clip(np.rint((values - low) * 255 / (high - low)), 0, 255)
    assert np.abs(grey - expected).max() <= 1
    assert grey.min() == 0
    assert grey.max() == 255


def test_gain_and_offset_of_the_input_do_not_matter() -> None:
    values = np.random.default_rng(1).uniform(0, 1, (80, 80))
    first, second = to_uint8(band(values)), to_uint8(band(values * 4000 + 100))
    assert np.abs(first.astype(int) - second.astype(int)).max() <= 1


def test_outliers_do_not_flatten_the_rest() -> None:
    values = np.random.default_rng(2).uniform(0, 100, (100, 100))
    values[0, :5] = 1e6
    assert to_uint8(band(values)).std() > 60


def test_invalid_pixels_neither_count_nor_make_an_edge() -> None:
    values = np.linspace(100, 200, 200)[None, :].repeat(200, 0)
    valid = np.ones(values.shape, np.bool_)
    valid[60:120, 50:130] = False
    holed = np.where(valid, values, -9999.0)
    grey = to_uint8(band(holed, valid)).astype(int)
    assert np.abs(grey - to_uint8(band(values)).astype(int))[valid].max() <= 2
    assert np.abs(np.diff(grey, axis=0)).max() <= 60
    border = grey[60, 50:130] - grey[59, 50:130]
    assert np.abs(border).max() <= 3


def test_large_bands_are_sampled_alike() -> None:
    values = np.random.default_rng(3).normal(1000, 50, (1500, 1500))
    sampled = to_uint8(band(values))
    low, high = np.percentile(values.astype(np.float32), (0.5, 99.5))
    exact = np.clip(np.rint((values - low) * 255 / (high - low)), 0, 255)
    assert np.abs(sampled - exact).max() <= 4


def test_few_valid_pixels_between_the_samples_are_found() -> None:
    valid = np.zeros((1500, 1500), np.bool_)
    valid[1, 1::3] = True
    values = np.tile(np.arange(1500.0), (1500, 1))
    assert to_uint8(band(values, valid))[valid].std() > 60


def test_rare_values_are_stretched_when_percentiles_coincide() -> None:
    values = np.zeros((100, 100))
    values[50, 50] = 7.0
    grey = to_uint8(band(values))
    assert grey[50, 50] == 255
    assert grey.sum() == 255


@pytest.mark.parametrize("value", [0.0, 5.0])
def test_constant_band_is_refused(value: float) -> None:
    with pytest.raises(NoDataError, match=r"blue is constant"):
        to_uint8(band(np.full((20, 20), value), name="blue"))


def test_band_without_valid_pixels_is_refused() -> None:
    values = np.arange(400.0).reshape(20, 20)
    with pytest.raises(NoDataError, match="no valid pixel"):
        to_uint8(band(values, np.zeros((20, 20), np.bool_)))
