"""A quarter of a real pair against the other three: whether stated errors hold on real ground."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from affine import Affine
from numpy.typing import NDArray

import geodelreg
from geodelreg import Alignment, AlignOptions
from geodelreg.errors import GeodelregError

DRAWS = 2000
ENDS_PERCENT = (2.5, 97.5)


@dataclass(frozen=True, slots=True)
class Quadrant:
    """What a quarter of MS says of its own centre, and what the other three say of it.

    Attributes
    ----------
    pair : str
    apart_px : float
        PAN pixels between the two.
    sigma_px : float
        The standard error of that, from those that both state there.
    """

    pair: str
    apart_px: float
    sigma_px: float

    @property
    def normalised(self) -> float:
        """True over stated error, as far as two halves of one pair can tell."""
        return self.apart_px / self.sigma_px


def quadrants(name: str, ms: Path, pan: Path, pan_band: int) -> Iterator[Quadrant | None]:
    """Each quarter of a pair; None where it, or the rest, was refused."""
    import rasterio

    with rasterio.open(ms) as source, rasterio.open(pan) as reference:
        shape, transform = source.shape, source.transform
        ratio = math.sqrt(abs(transform.determinant / reference.transform.determinant))
    half = shape[0] // 2, shape[1] // 2
    for rows in (slice(0, half[0]), slice(half[0], shape[0])):
        for columns in (slice(0, half[1]), slice(half[1], shape[1])):
            rest = np.ones(shape, dtype=np.uint8)
            rest[rows, columns] = 0
            both = (_aligned(ms, pan, pan_band, hidden) for hidden in (rest, 1 - rest))
            found = [alignment for alignment in both if alignment is not None]
            if len(found) < 2:
                yield None
                continue
            centre = np.array([[columns.start + columns.stop, rows.start + rows.stop]]) / 2
            one, other = (_place(alignment, transform, centre) for alignment in found)
            sigmas = [_sigma(alignment, centre, ratio) for alignment in found]
            apart = ratio * float(np.hypot(*(one - other)))
            yield Quadrant(name, apart, math.hypot(*sigmas))


def _aligned(ms: Path, pan: Path, pan_band: int, hidden: NDArray[np.uint8]) -> Alignment | None:
    try:
        return geodelreg.align(ms, pan, AlignOptions(pan_band=pan_band), mask=hidden)
    except GeodelregError:
        return None


def _place(alignment: Alignment, header: Affine, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2,) header pixels of MS where a correction puts a pixel of MS."""
    x, y = (~header @ alignment.correction.corrected) @ tuple(at[0])
    return np.array([x, y])


def _sigma(alignment: Alignment, at: NDArray[np.float64], ratio: float) -> float:
    """Standard error there, PAN pixels."""
    fitted = float(alignment.solution.map.sigma_at(at)[0])
    return math.hypot(ratio * fitted, alignment.accuracy.systematic_px)


def table(found: list[Quadrant], refused: dict[str, int]) -> str:
    """RMS of the normalised error by pair, and of all with a bootstrap interval by pair."""
    groups: dict[str, list[Quadrant]] = defaultdict(list)
    for one in found:
        groups[one.pair].append(one)
    lines = [
        "| pair | quarters | refused | RMS apart, PAN px | median sigma | RMS of apart / sigma |",
        "|---|---|---|---|---|---|",
    ]
    for name in refused:
        some = groups[name]
        apart, sigma = _rms([q.apart_px for q in some]), [q.sigma_px for q in some]
        middle = float(np.median(sigma)) if some else math.nan
        lines.append(
            f"| {name} | {len(some)} | {refused[name]} | {apart:.3f} | {middle:.3f} "
            f"| {_rms([q.normalised for q in some]):.2f} |"
        )
    low, high = interval(list(groups.values()))
    total = _rms([q.normalised for q in found])
    lines += ["", f"All: {total:.2f} (95 % by pair: {low:.2f} to {high:.2f})."]
    return "\n".join(lines)


def interval(groups: list[list[Quadrant]]) -> tuple[float, float]:
    """95 % bootstrap interval of the RMS of the normalised error, whole pairs drawn."""
    squares = [[q.normalised**2 for q in some] for some in groups if some]
    if not squares:
        return math.nan, math.nan
    random = np.random.default_rng(0)
    drawn = random.integers(len(squares), size=(DRAWS, len(squares)))
    rms = [math.sqrt(np.mean(np.concatenate([squares[i] for i in row]))) for row in drawn]
    low, high = np.percentile(rms, ENDS_PERCENT)
    return float(low), float(high)


def _rms(values: list[float]) -> float:
    return math.sqrt(float(np.mean(np.square(values)))) if values else math.nan
