"""Places seen in both images: keypoints, their matches, tie points, ground control points."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from geodelreg.values.raster import BoolArray, Float32Array, FloatArray, IntArray, StatusArray


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """SIFT keypoints of one image.

    Attributes
    ----------
    xy : (N, 2) float64
        Outer-corner pixel coordinates.
    scale_px, angle_deg, response : (N,) float64
        Diameter of the neighbourhood, orientation (clockwise), strength.
    descriptors : (N, 128) float32
    """

    xy: FloatArray
    scale_px: FloatArray
    angle_deg: FloatArray
    response: FloatArray
    descriptors: Float32Array

    def __len__(self) -> int:
        return len(self.xy)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Index pairs between two sets of keypoints.

    Attributes
    ----------
    source_index, reference_index : (M,) intp
    distance : (M,) float64
        Euclidean distance of the two descriptors.
    ratio : (M,) float64
        Distance over that of the second nearest reference descriptor.
    """

    source_index: IntArray
    reference_index: IntArray
    distance: FloatArray
    ratio: FloatArray

    def __len__(self) -> int:
        return len(self.source_index)

    def take(self, keep: BoolArray | IntArray) -> Matches:
        """Some of the matches, by mask or index."""
        return Matches(
            self.source_index[keep],
            self.reference_index[keep],
            self.distance[keep],
            self.ratio[keep],
        )

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
    """

    source_px: FloatArray
    reference_px: FloatArray
    covariance_px2: FloatArray
    score: FloatArray
    status: StatusArray
    residual_px: FloatArray

    def __len__(self) -> int:
        return len(self.source_px)

    @property
    def kept(self) -> BoolArray:
        """(M,) bool, True where no stage rejected the point."""
        return np.asarray(self.status == Status.KEPT)

    @property
    def sigma_px(self) -> FloatArray:
        """(M, 2) float64, standard deviation along PAN columns and rows, in PAN pixels."""
        return np.sqrt(np.stack([self.covariance_px2[:, 0, 0], self.covariance_px2[:, 1, 1]], 1))


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
class Gcp:
    """A ground control point: MS pixel (outer corner) ↔ map coordinates in the MS CRS."""

    id: str
    column: float
    row: float
    x: float
    y: float
    z: float = 0.0
    info: str = ""
