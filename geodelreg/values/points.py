"""Places seen in both images: keypoints, matches, tie points; and where a search looked."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import (
    Band,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    StatusArray,
    Window,
)


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """SIFT keypoints of one image.

    Attributes
    ----------
    xy : (N, 2) float64
        Outer-corner pixel coordinates.
    descriptors : (N, 128) float32
    """

    xy: FloatArray
    descriptors: Float32Array

    def __len__(self) -> int:
        return len(self.xy)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Index pairs between two sets of keypoints.

    Attributes
    ----------
    source_index, reference_index : (M,) intp
    ratio : (M,) float64
        Distance of the two descriptors over that of the second nearest reference descriptor.
    """

    source_index: IntArray
    reference_index: IntArray
    ratio: FloatArray

    def __len__(self) -> int:
        return len(self.source_index)

    def take(self, keep: BoolArray | IntArray) -> Matches:
        """Some of the matches, by mask or index."""
        return Matches(self.source_index[keep], self.reference_index[keep], self.ratio[keep])

    def xy(self, source: Keypoints, reference: Keypoints) -> tuple[FloatArray, FloatArray]:
        """Positions, (M, 2) float64 each, outer-corner pixels of either image."""
        return source.xy[self.source_index], reference.xy[self.reference_index]


class Status(IntEnum):
    """Which stage rejected a tie point; 0 is kept."""

    KEPT = 0
    RATIO = 1
    DUPLICATE = 2
    COLLINEAR = 3
    COCIRCULAR = 4
    TOPOLOGY = 5
    CONSENSUS = 6
    TEXTURE = 7
    CONVERGENCE = 8
    CORRELATION = 9
    STAR = 10
    RESIDUAL = 11
    EXCLUDED = 12


@dataclass(frozen=True, slots=True, eq=False)
class TiePoints:
    """Ground features seen in both images.  Points are never dropped: `status` tells.

    Attributes
    ----------
    source_px, reference_px : (M, 2) float64
        Outer-corner pixel coordinates in MS and in PAN, full resolution.
    covariance_px2 : (M, 2, 2) float64
        Of the position in PAN, in PAN pixels squared.
    score : (M,) float64
        Larger is better: correlation for refined points, 1 - ratio for descriptor matches.
    status : (M,) uint8
        `Status` code; 0 = kept.
    residual_px : (M, 2) float64
        Corrected source position minus reference, in PAN pixels; NaN before the fit.
    weight : (M,) float64, optional
        By which the fit divided a point's variance; NaN of points that it was not given.
    """

    source_px: FloatArray
    reference_px: FloatArray
    covariance_px2: FloatArray
    score: FloatArray
    status: StatusArray
    residual_px: FloatArray
    weight: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.source_px)

    @property
    def kept(self) -> BoolArray:
        """(M,) bool, True where no stage rejected the point."""
        return np.asarray(self.status == Status.KEPT)

    @property
    def sigma_px(self) -> FloatArray:
        """(M, 2) float64, standard deviation along PAN columns and rows, in PAN pixels."""
        return np.asarray(np.sqrt(self.covariance_px2.diagonal(axis1=1, axis2=2)))


_NOWHERE: FloatArray = np.empty((0, 2))
NO_TIE_POINTS = TiePoints(
    source_px=_NOWHERE,
    reference_px=_NOWHERE,
    covariance_px2=np.empty((0, 2, 2)),
    score=np.empty(0),
    status=np.empty(0, dtype=np.uint8),
    residual_px=_NOWHERE,
)


@dataclass(frozen=True, slots=True)
class FitForm:
    """What a fit has beside its points: with it and their weights the same map comes out again.

    Attributes
    ----------
    model : str
    spread_px2 : float
        Variance per axis that every point has besides its own, MS pixels squared.
    range_px : float
        Of a field: distance scale of its correlation, MS pixels.
    variance_px2 : (float, float)
        Of a field: variance of the residual along columns and rows.
    jump_rows : tuple of float
        Of a field: where it is cut.
    """

    model: str
    spread_px2: float
    range_px: float = 0.0
    variance_px2: tuple[float, float] = (0.0, 0.0)
    jump_rows: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class GivenPoints:
    """Points out of a file that a person may have edited, in MS pixels.

    Attributes
    ----------
    file : str
        For messages.
    ids : tuple of str
    source_px : (N, 2) float64
        MS pixel; NaN of a point that was drawn, and whose pixel is to be looked for.
    target_px : (N, 2) float64
        The pixel by the original header, where the content belongs.
    covariance_px2 : (N, 2, 2) float64
        Of `target_px`, MS pixels squared; NaN of points that were placed by hand.
    score : (N,) float64
        Correlation; NaN where it is not known.
    enabled : (N,) bool
    status : (N,) uint8
        Why those that are not enabled are not.
    weight : (N,) float64
        In the fit that they come from; NaN of points that it was not given, or that were edited.
    form : FitForm or None
        Of that fit, where the file tells.
    """

    file: str
    ids: tuple[str, ...]
    source_px: FloatArray
    target_px: FloatArray
    covariance_px2: FloatArray
    score: FloatArray
    enabled: BoolArray
    status: StatusArray
    weight: FloatArray
    form: FitForm | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def placed(self) -> BoolArray:
        """(N,) bool, True where the pixel of MS is known."""
        return np.asarray(np.isfinite(self.source_px).all(axis=1))

    @property
    def by_hand(self) -> BoolArray:
        """(N,) bool, True where nothing tells how sure a point is."""
        return np.asarray(~np.isfinite(self.covariance_px2).all(axis=(1, 2)))


@dataclass(frozen=True, slots=True)
class Gcp:
    """A ground control point: MS pixel (outer corner) ↔ map coordinates in the MS CRS.

    `facts` are its numbers by name, for formats that have fields; a rejected one is not `enabled`.
    `form` is that of the fit it comes from, where one is known.
    """

    id: str
    column: float
    row: float
    x: float
    y: float
    z: float = 0.0
    info: str = ""
    enabled: bool = True
    facts: tuple[tuple[str, float | None], ...] = ()
    form: FitForm | None = None


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
    is_closer : bool
        The scope before it looked at the same parts, decimated further.
    """

    source: Window
    reference: Window
    budget_px: int
    keypoints: int
    name: str
    is_whole: bool = False
    is_closer: bool = False


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
    source_px: FloatArray = field(default_factory=lambda: _NOWHERE)
    header_px: FloatArray = field(default_factory=lambda: _NOWHERE)
    candidates: int = 0
    bright: tuple[BoolArray, BoolArray] | None = None

    @property
    def search(self) -> str:
        """Where it was looked for: at the header's place, or with keypoints there or everywhere."""
        if math.isnan(self.log_nfa):
            return "header"
        return "whole" if self.images.scope.is_whole else "keypoints"

    @property
    def agreeing(self) -> int:
        """Keypoint matches that agree."""
        return len(self.source_px)
