"""The survey of all patches, far beyond the reach of dense matching."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from geodelreg.fine.overlay import Overlay
from geodelreg.fine.survey import survey


def texture(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).normal(size=shape)
    return np.asarray(1000 + 200 * gaussian_filter(noise, 1.2), dtype=np.float32)


def overlay(one: NDArray[np.float32], other: NDArray[np.float32]) -> Overlay:
    full = np.ones(one.shape, dtype=bool)
    return Overlay(one, other, full, full)


def test_a_torn_image_shows_where_its_lower_part_went() -> None:
    image = texture((300, 320), 0)
    torn = image.copy()
    torn[180:] = np.roll(image, (3, 11), axis=(0, 1))[180:]
    found = survey(overlay(image, torn))
    upper, lower = found.centre[:, 1] < 160, found.centre[:, 1] > 200
    inside = (found.centre[:, 0] > 30) & (found.centre[:, 0] < 290)
    assert np.abs(found.move[upper]).max() < 0.2
    assert np.abs(found.move[lower & inside] - [11.0, 3.0]).max() < 0.2
    assert (found.z[lower & inside] > 3).all()
    assert found.textured.all()


def test_flat_patches_show_nothing() -> None:
    image = texture((200, 200), 1)
    image[:, 100:] = 1000
    found = survey(overlay(image, image))
    assert found.textured[found.centre[:, 0] < 80].all()
    flat = found.centre[:, 0] > 120
    assert not found.textured[flat].any()


def test_what_is_invalid_is_not_asked() -> None:
    image = texture((200, 200), 4)
    valid = np.ones(image.shape, dtype=bool)
    valid[:100] = False
    found = survey(Overlay(image, image, valid, np.ones_like(valid)))
    assert len(found.centre)
    assert (found.centre[:, 1] > 90).all()


def test_of_images_that_show_nothing_together_no_patch_is_placed() -> None:
    image, hidden = texture((200, 240), 2), np.zeros((200, 240), dtype=bool)
    found = survey(Overlay(image, image, hidden, hidden))
    assert len(found.centre) == len(found.move) == len(found.brightest) == 0
    assert len(found.z) == 0


def test_nothing_lies_where_an_image_has_ended() -> None:
    """Beyond it all is flat, and what is divided by the spread of nothing is anything."""
    image, other = texture((240, 178), 5), texture((240, 178), 6)
    found = survey(overlay(image, other), ("flush", "flush"), 12)
    assert found.size == 12
    there = found.centre + found.move
    assert (there > 0).all()
    assert (there < [178, 240]).all()
