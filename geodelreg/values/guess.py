"""What the search looked at, and the first guesses it made there."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import Band, BoolArray, FloatArray, Window


def _nowhere() -> FloatArray:
    return np.empty((0, 2))


@dataclass(frozen=True, slots=True)
class Scope:
    """Which part of the rasters a search looks at, and at which size.

    Attributes
    ----------
    source, reference : Window
    budget_px : int
        Pixels of each decimated image at most.
    keypoints : int
        Keypoints of each image at most.
    name : str
    is_whole : bool
        Both rasters are looked at from edge to edge, whatever their headers say.
    """

    source: Window
    reference: Window
    budget_px: int
    keypoints: int
    name: str
    is_whole: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """Both images of a scope, decimated to one ground sampling distance.

    Attributes
    ----------
    source : list of Band
        MS bands asked for.
    reference : Band
    scope : Scope
    """

    source: list[Band]
    reference: Band
    scope: Scope


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """A first guess at the correction.

    Attributes
    ----------
    map : PixelMap
        MS pixels to MS header pixels.
    log_nfa : float
        log10 of the expected number of chance agreements as good; NaN when not from keypoints.
    counts : dict of str to int
        Points that survive each step, for the report.
    images : Overview
    source_px, header_px : (N, 2) float64
        MS pixels and MS header pixels of the keypoint matches that agree.
    candidates : int
        One-to-one matches that could have agreed.
    bright : tuple of (H, W) bool, or None
        Where the source and the reference of `images` show bright objects, if they do: the
        refinement looks whether they move differently from the rest.
    """

    map: PixelMap
    log_nfa: float
    counts: dict[str, int]
    images: Overview
    source_px: FloatArray = field(default_factory=_nowhere)
    header_px: FloatArray = field(default_factory=_nowhere)
    candidates: int = 0
    bright: tuple[BoolArray, BoolArray] | None = None

    @property
    def agreeing(self) -> int:
        """Keypoint matches that agree."""
        return len(self.source_px)
