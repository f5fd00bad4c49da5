"""Correlation of whole areas: sign and size of shifts, and rivals of repeated texture."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from geodelreg.coarse.correlation import best_shift
from geodelreg.fine.overlay import Overlay
from geodelreg.judge.rival import rival_correlation

Array = NDArray[np.float64]
SIZE = 240


def texture(seed: int = 0, size: int = 400, sigma: float = 1.5) -> Array:
    """Fine and coarse structure together, as the ground has."""
    noise = np.random.default_rng(seed).standard_normal((size, size))
    levels = [s * ndimage.gaussian_filter(noise, s) for s in (sigma, 4 * sigma)]
    return sum(levels) / np.std(sum(levels)) * 100 + 1000


def cut(image: Array, column: int, row: int, shape: tuple[int, int] = (SIZE, SIZE)) -> Array:
    return image[row : row + shape[0], column : column + shape[1]]


def overlay(
    template: Array,
    surface: Array,
    template_valid: NDArray[np.bool_] | None = None,
    surface_valid: NDArray[np.bool_] | None = None,
) -> Overlay:
    every = np.ones(template.shape, bool)
    return Overlay(
        template.astype(np.float32),
        surface.astype(np.float32),
        every if template_valid is None else template_valid,
        every if surface_valid is None else surface_valid,
    )


@pytest.mark.parametrize("sign", [1, -1], ids=["same contrast", "inverted"])
@pytest.mark.parametrize("shift", [(0, 0), (7, 0), (0, -12), (31, 22), (-60, 45)])
def test_content_of_the_template_is_that_of_the_surface_so_much_further(
    shift: tuple[int, int], sign: int
) -> None:
    ground = texture()
    template = cut(ground, 80 + shift[0], 80 + shift[1])
    surface = 2000 - sign * 0.4 * cut(ground, 80, 80)
    assert best_shift(overlay(template, surface)).move == pytest.approx(shift, abs=1.0)


def test_shift_is_in_pixels_of_the_overlay_however_large_it_is() -> None:
    ground = texture(1, 1100, 3.0)
    template, surface = cut(ground, 90, 200, (700, 800)), cut(ground, 50, 230, (700, 800))
    assert best_shift(overlay(template, surface)).move == pytest.approx((40, -30), abs=4)


@pytest.mark.parametrize("seed", range(6))
def test_a_weak_agreement_of_much_outweighs_a_strong_one_of_little(seed: int) -> None:
    """Small overlaps correlate by chance; those of changed ground hardly at all, but everywhere."""
    ground, before, after = (texture(10 * seed + number, 200) for number in range(3))
    template = cut(ground, 63, 58, (70, 70)) + 0.9 * cut(before, 0, 0, (70, 70))
    surface = cut(ground, 60, 60, (70, 70)) + 0.9 * cut(after, 0, 0, (70, 70))
    assert best_shift(overlay(template, surface)).move == pytest.approx((3, -2), abs=1.5)


def test_masked_pixels_do_not_pull_the_shift() -> None:
    """A no-data frame that lies at the same place in both images must not win."""
    ground = texture(2)
    template, surface = cut(ground, 100, 60), cut(ground, 80, 80)
    valid = np.ones((SIZE, SIZE), bool)
    valid[:, :50], valid[200:] = False, False
    spoilt = [np.where(valid, image, 0.0) for image in (template, surface)]
    assert best_shift(overlay(*spoilt, valid, valid)).move == pytest.approx((20, -20), abs=1)
    other = valid[::-1, ::-1]
    view = overlay(spoilt[0], np.where(other, surface, 9e4), valid, other)
    assert best_shift(view).move == pytest.approx((20, -20), abs=1)


@pytest.mark.parametrize("seed", range(3))
def test_natural_texture_has_no_rival(seed: int) -> None:
    image = texture(seed)[:SIZE, :SIZE]
    noise = np.random.default_rng(9).normal(0, 30, image.shape)
    assert 0 < rival_correlation(overlay(image, image + noise)).elsewhere < 0.6
    assert 0 < rival_correlation(overlay(image, 3000 - image + noise)).elsewhere < 0.6


@pytest.mark.parametrize("period", [30, 48])
def test_tiled_texture_rivals_itself(period: int) -> None:
    image = np.tile(texture(3, period), (6, 9))[:180, :260]
    noise = np.random.default_rng(9).normal(0, 10, image.shape)
    assert rival_correlation(overlay(image, image + noise)).elsewhere > 0.9


def test_fields_of_inverted_contrast_do_not_make_a_rival() -> None:
    """The whole correlates little where half of it is inverted; its blocks correlate well."""
    image = texture(4)[:SIZE, :SIZE]
    columns = np.arange(SIZE) // 40 % 2 == 0
    turned = np.where(columns, 2000 - image, image)
    assert rival_correlation(overlay(image, turned)).elsewhere < 0.7


@pytest.mark.parametrize("axis", [0, 1])
def test_an_image_shaded_like_relief_fits_on_both_sides_of_its_slopes(axis: int) -> None:
    """The derivative of an image resembles it best where it does not lie."""
    image = texture(7)[:SIZE, :SIZE]
    shaded = np.gradient(image, axis=axis)
    places = [np.roll(shaded, step, axis=axis) for step in range(1, 8)]
    best = max(places, key=lambda there: float(np.corrcoef(there.ravel(), image.ravel())[0, 1]))
    assert rival_correlation(overlay(image, best)).beside > 0.85


def test_furrows_have_valleys_on_both_sides_and_no_rival() -> None:
    noise = np.random.default_rng(8).standard_normal((SIZE, SIZE))
    steps = np.arange(-12, 13)
    furrow = np.cos(2 * np.pi * steps / 10) * np.exp(-((steps / 4) ** 2) / 2)
    image = ndimage.gaussian_filter1d(ndimage.convolve1d(noise, furrow, axis=1), 1.5, axis=0)
    assert max(rival_correlation(overlay(image, image))) < 0.6


def test_unrelated_images_have_rivals() -> None:
    view = overlay(texture(5)[:SIZE, :SIZE], texture(6)[:SIZE, :SIZE])
    assert rival_correlation(view).elsewhere > 0.85


def test_rivals_are_unknown_without_enough_to_look_at() -> None:
    image = texture(7)
    assert math.isnan(rival_correlation(overlay(image[:20, :20], image[:20, :20])).elsewhere)
    nothing = np.zeros((SIZE, SIZE), bool)
    square = image[:SIZE, :SIZE]
    assert math.isnan(rival_correlation(overlay(square, square, nothing, nothing)).elsewhere)


def test_narrow_strips_are_looked_at_along_their_length() -> None:
    noise = np.random.default_rng(9).normal(0, 10, (160, 24))
    strip, repeated = texture(8)[:160, :24], np.tile(texture(8)[:40, :24], (4, 1))
    assert rival_correlation(overlay(strip, strip + noise)).elsewhere < 0.6
    assert rival_correlation(overlay(repeated, repeated + noise)).elsewhere > 0.9
