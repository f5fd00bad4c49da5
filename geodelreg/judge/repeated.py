"""What both images repeat on the pixel grid: collars, labels, stripes, logos, dead pixels.

It is drawn with a few exact values, and lies where the drawing put it, not where the ground is.  A
correction that brings such structure together must be proven by the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from geodelreg.fine.least_squares import MatchOptions
from geodelreg.fine.matching import match_pass, patches_log_nfa, tie_points
from geodelreg.fine.passes import Refinement
from geodelreg.fine.tiles import Tile
from geodelreg.fine.tuning import lattice
from geodelreg.geo.affine import apply_affine
from geodelreg.judge.in_place import area_evidence
from geodelreg.values.drawn import SAMPLES, drawn_values
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import Band, BoolArray, FloatArray

_TOGETHER = 0.5
"""Share of the drawn pixels of the coarser image that must lie on such of the finer one."""


class Repeated(NamedTuple):
    """What speaks for a correction off what both images repeat.

    Attributes
    ----------
    log_chance : float or None
        log10 of the chance of agreement and likeness together; None when nothing is suspected.
    words : str
        The values that are drawn.
    """

    log_chance: float | None = None
    words: str = ""


def proof_without_repeated(refined: Refinement, correction: PixelMap, sample_size: int) -> Repeated:
    """What is left of the evidence for a correction without what is drawn on both images.

    Parameters
    ----------
    refined : Refinement
    correction : PixelMap
        MS pixels to MS header pixels.
    sample_size : int
        Patches that fix the model.

    Returns
    -------
    Repeated
        Of nearly all pairs nothing is suspected.
    """
    part, tiles, tuning, size = refined.part, refined.tiles, refined.tuning, refined.size
    drawn = _drawn([tile.surface for tile in tiles])
    if not any(map(len, drawn)):
        return Repeated()
    coarse = _drawn([tile.template for tile in tiles])
    hidden = [
        Tile(_without(tile.template, coarse), _without(tile.surface, drawn)) for tile in tiles
    ]
    if not _lie_together(refined, correction, hidden):
        return Repeated()
    found = match_pass(part, hidden, correction, tuning, MatchOptions(size=size))
    tied = tie_points(part, found.matched, correction, found.status)
    area = area_evidence(part, hidden, correction, tuning, size, few=True)
    one, other = (
        " and ".join(f"{value:g}" for value in np.unique(np.concatenate(values)))
        for values in ((coarse, drawn) if part.ms_is_template else (drawn, coarse))
    )
    log_chance = patches_log_nfa(part, tied, sample_size) + area.log_chance
    return Repeated(log_chance, f"{one} in MS, {other} in PAN")


def _drawn(images: Sequence[Sequence[Band]]) -> list[FloatArray]:
    """Of each band the values that are far more frequent than those beside them."""
    step = max(sum(bands[0].data.size for bands in images) // SAMPLES, 1)
    found = []
    for number in range(len(images[0])):
        every = [(one[number].data.ravel(), one[number].valid.ravel()) for one in images]
        seen = [data[::step][valid[::step]] for data, valid in every]
        found.append(drawn_values(np.concatenate(seen)))
    return found


def _without(bands: Sequence[Band], drawn: Sequence[FloatArray]) -> list[Band]:
    """The bands without the pixels that show a drawn value in all of them."""
    on = np.logical_and.reduce(
        [np.isin(band.data, values) for band, values in zip(bands, drawn, strict=True)]
    )
    return [replace(band, valid=band.valid & ~on) for band in bands]


def _lie_together(refined: Refinement, correction: PixelMap, hidden: Sequence[Tile]) -> bool:
    """True when what is drawn in the one image lies on what is drawn in the other."""
    part = refined.part
    there = part.to_surface(correction)
    on_both = drawn = 0
    for tile, rest in zip(refined.tiles, hidden, strict=True):
        seen = tile.template[0].valid & ~rest.template[0].valid
        xy, take = lattice(tile.template[0], part, SAMPLES)
        spots = there.forward(xy[seen[take]])
        finer = tile.surface[0]
        to_band = ~finer.grid.transform @ part.surface.grid.transform
        columns, rows = np.floor(apply_affine(to_band, spots)).astype(np.intp).T
        height, width = finer.data.shape
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        place = rows[inside], columns[inside]
        shown: BoolArray = finer.valid[place]
        on_both += int((shown & ~rest.surface[0].valid[place]).sum())
        drawn += int(shown.sum())
    return on_both > _TOGETHER * drawn
