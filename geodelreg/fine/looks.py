"""Which look at the images is best: bands for keypoints; edges, haze and tones for patches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from geodelreg.fine.layers import CLEARLY, Pass, difference
from geodelreg.fine.least_squares import MatchOptions
from geodelreg.fine.matching import match_pass
from geodelreg.fine.tiles import Tile
from geodelreg.fine.tuning import Tuning
from geodelreg.pair import Roles
from geodelreg.values.raster import Band

_VISIBLE_BANDS = 3
_MOVE_PX = 0.1  # of MS; by hand: ½ to 2 × alike
_SHARPER_SHARE = 0.6  # by hand: ½ to 2 × alike


class Look(NamedTuple):
    """High-pass and local tone, as in `geodelreg.fine.tuning.Tuning`."""

    high_pass: float
    local_tone: bool


PLAIN = Look(0.0, False)
HAZE = Look(1.0, False)
SHARPER = (Look(1.5, True), Look(1.0, True))
"""Without the second, eight of fifteen pairs are worse by a fifth to a half."""


def band_looks(bands: list[Band]) -> Iterator[Band]:
    """The mean of the first (visible) bands, then single bands, spread over the spectrum."""
    if len(bands) == 1:
        yield bands[0]
        return
    yield mean_band(bands[:_VISIBLE_BANDS])
    if len(bands) > _VISIBLE_BANDS:
        yield bands[_VISIBLE_BANDS]
        if len(bands) > _VISIBLE_BANDS + 1:
            yield mean_band(bands[_VISIBLE_BANDS:])
        yield bands[2]


def mean_band(bands: list[Band]) -> Band:
    """Mean of standardised bands."""
    data = np.zeros(bands[0].data.shape, dtype=np.float32)
    valid = np.ones(data.shape, dtype=bool)
    for band in bands:
        values = band.data[band.valid]
        spread = float(values.std()) if values.size else 0.0
        if spread == 0.0:
            continue
        data += (band.data - np.float32(values.mean())) / np.float32(spread)
        valid &= band.valid
    return Band(data, valid, bands[0].grid, "mean of " + ", ".join(b.name for b in bands))


def preference(found: Pass) -> tuple[bool, float]:
    """Less for the start from which more patches agree more closely: model, then variance."""
    assert found.estimate is not None
    return found.estimate.is_shift, float(np.diag(found.estimate.covariance).sum())


def sharpest(
    part: Roles,
    tiles: list[Tile],
    plain: tuple[Tuning, Pass],
    others: Sequence[Look],
    options: MatchOptions,
) -> tuple[Tuning, Pass]:
    """Try edges alone, with each patch's own tone: better where light or land changed."""
    (tuning, best), changed = plain, False
    for look in others:
        assert best.estimate is not None
        local = look.local_tone and part.ms_is_template
        other = replace(tuning, high_pass=look.high_pass, local_tone=local)
        found = match_pass(part, tiles, best.estimate.map, other, options)
        if not _is_sharper(part, found, best, 1.0 if changed else CLEARLY):
            break
        haze = plain[0].high_pass and not plain[0].local_tone
        if haze and difference(part.pair, found, best)[0] > _MOVE_PX:
            break  # more certain of another place is no gain where clouds are about
        tuning, best, changed = other, found, True
    return tuning, best


def _is_sharper(part: Roles, one: Pass, other: Pass, factor: float) -> bool:
    """True when a pass is more certain, by a factor, without losing many patches.

    One of enough patches for an affine is, whatever the factor, when the other's are too few.
    """
    if one.estimate is None or other.estimate is None:
        return one.estimate is not None
    if one.estimate.is_shift != other.estimate.is_shift:
        return other.estimate.is_shift  # a shift is more certain, but of few patches
    sigma = difference(part.pair, one, other)[1]
    return one.kept >= _SHARPER_SHARE * other.kept and sigma[0] < factor * sigma[1]
