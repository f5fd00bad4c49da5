"""The values that flow between the stages: image → match → fit → product.

Pixel coordinates are float64 ``(column, row)`` with the *outer corner* of the upper-left pixel
at (0, 0), as in GDAL; `geodelreg.geo.pixel` alone converts to and from pixel centres.
"Source" is the multispectral image (MS), "reference" the panchromatic one (PAN).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from affine import Affine
from numpy.typing import NDArray

if TYPE_CHECKING:
    from geodelreg.masking import MaskUse
    from geodelreg.options import AlignOptions

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
StatusArray = NDArray[np.uint8]


class Window(NamedTuple):
    """A rectangle of whole pixels: offsets of its upper-left corner, then its size."""

    column: int
    row: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the pixels of a raster lie on the ground.

    Attributes
    ----------
    transform : Affine
        Pixel (outer corner) to map coordinates.
    shape : tuple of int
        ``(height, width)`` in pixels.
    crs_wkt : str
        Coordinate reference system as WKT2; map axes are in (easting, northing) order.
    unit_m : float or None
        Metres to a map unit if whoever opened the raster knew; else look it up in `crs_wkt`.
    """

    transform: Affine
    shape: tuple[int, int]
    crs_wkt: str
    unit_m: float | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """One band, or a combination of bands, of a window of a raster.

    Attributes
    ----------
    data : (H, W) float32
        Pixel values; arbitrary but finite where `valid` is False.
    valid : (H, W) bool
        True where the value is good.
    grid : Grid
        Of these pixels: of the window, and decimated if the read was.
    name : str
        For messages and reports.
    """

    data: Float32Array
    valid: BoolArray
    grid: Grid
    name: str = ""


class WindowReader(Protocol):
    """Pixels on demand.  `geodelreg.image.reader` has it on rasterio, tests have it on arrays."""

    @property
    def grid(self) -> Grid:
        """Grid of the full raster."""

    @property
    def name(self) -> str:
        """File name, for messages."""

    @property
    def band_names(self) -> tuple[str, ...]:
        """One name per band; band numbers are 1-based positions in it."""

    @property
    def decimations(self) -> tuple[float, ...]:
        """Factors at which a decimated read is cheap (1.0 first, then the overviews')."""

    def read(
        self, bands: Sequence[int], window: Window, shape: tuple[int, int] | None = None
    ) -> list[Band]:
        """Read 1-based `bands` of `window`, averaged down to `shape` when given."""


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
    is_check : (M,) bool
        Held out of the fit that `residual_px` refers to.
    residual_px : (M, 2) float64
        Corrected source position minus reference, in PAN pixels; NaN before the fit.
    """

    source_px: FloatArray
    reference_px: FloatArray
    covariance_px2: FloatArray
    score: FloatArray
    status: StatusArray
    is_check: BoolArray
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


@dataclass(frozen=True, slots=True)
class Correction:
    """What must be known to correct a header, and no more.

    Attributes
    ----------
    model : str
        ``shift``, ``scale``, ``similarity``, ``affine`` or ``none``.
    crs_wkt : str
        CRS of both geotransforms (the MS raster's), WKT2.
    original, corrected : Affine
        Geotransform of the MS raster before and after.
    """

    model: str
    crs_wkt: str
    original: Affine
    corrected: Affine

    @property
    def map_transform(self) -> Affine:
        """Header map coordinates to true map coordinates."""
        transform: Affine = self.corrected @ ~self.original
        return transform

    def apply(self, transform: Affine) -> Affine:
        """Corrected geotransform of another raster that shares the header error."""
        corrected: Affine = self.map_transform @ transform
        return corrected


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


class Outcome(Enum):
    """What an alignment ended as."""

    ALIGNED = "aligned"
    ALREADY_ALIGNED = "already_aligned"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Reason:
    """One piece of evidence of the gate: a measured value against its limit."""

    name: str
    value: float
    limit: float
    passed: bool
    message: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome with the evidence behind it."""

    outcome: Outcome
    reasons: tuple[Reason, ...] = ()

    @property
    def accepted(self) -> bool:
        """True unless refused."""
        return self.outcome is not Outcome.REFUSED


class CheckOutcome(Enum):
    """What a check ended as."""

    ALIGNED = "aligned"
    MISALIGNED = "misaligned"
    CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True, slots=True)
class Misalignment:
    """How far off MS lies, at the corner of the overlap where that is most; NaN = not known.

    Attributes
    ----------
    distance_px, distance_m : float
        In PAN pixels, and in metres on the ground.
    sigma_px : float
        Standard error of the distance, that of the worst corner.
    local_px : float
        RMS of smooth distortion that no affine transformation takes away, PAN pixels.
    """

    distance_px: float = float("nan")
    distance_m: float = float("nan")
    sigma_px: float = float("nan")
    local_px: float = float("nan")


@dataclass(frozen=True, slots=True)
class Accuracy:
    """How good the fit is.  ``_px`` are PAN pixels, ``_m`` metres on the ground; NaN = not known.

    Attributes
    ----------
    fit_rmse_px : float
        Weighted-fit residuals at kept points.
    check_rmse_px, check_ce90_px, check_rmse_m, check_ce90_m : float
        At check points, by k-fold: every kept point predicted by a fit that has not seen it.
    before_rmse_px, before_rmse_m : float
        Of the kept tie points under the original header.
    sigma_centre_px, sigma_corner_px : float
        Standard error of the correction (radial) at the MS raster's centre and worst corner.
    coverage : float
        Share of the overlap's area inside the hull of the kept points, 0 to 1.
    e1_before, e1_after : float
        The paper's grey-value RMSE after histogram matching, in DN.
    ncc_before, ncc_after : float
        Correlation of the areas under the original and the corrected header.
    kept, checked : int
        Numbers of points.
    """

    fit_rmse_px: float = float("nan")
    check_rmse_px: float = float("nan")
    check_ce90_px: float = float("nan")
    check_rmse_m: float = float("nan")
    check_ce90_m: float = float("nan")
    before_rmse_px: float = float("nan")
    before_rmse_m: float = float("nan")
    sigma_centre_px: float = float("nan")
    sigma_corner_px: float = float("nan")
    coverage: float = float("nan")
    e1_before: float = float("nan")
    e1_after: float = float("nan")
    ncc_before: float = float("nan")
    ncc_after: float = float("nan")
    kept: int = 0
    checked: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Everything `align` found out.

    Attributes
    ----------
    source, reference : Grid
        Original grids of the MS and the PAN raster.
    source_paths : tuple of str
        MS file, or one file per band.
    reference_path : str
    correction, tie_points, accuracy, verdict : as their types say
    step_counts : dict of str to int
        Points that survive each step, in order; the paper's "112 → 97 → 91".
    band_weights : dict of str to float
        Bands matched on and their weights in the synthetic PAN.
    warnings : tuple of str
    crs_operation : str
        pyproj's operation from MS to PAN coordinates, with its accuracy; "" for equal CRSs.
    options : AlignOptions
    versions, timings_s : dict
        Of everything that can change a result; wall time of the stages.
    masks : tuple of MaskUse
    """

    source: Grid
    reference: Grid
    source_paths: tuple[str, ...]
    reference_path: str
    correction: Correction
    tie_points: TiePoints
    accuracy: Accuracy
    verdict: Verdict
    step_counts: Mapping[str, int]
    band_weights: Mapping[str, float]
    warnings: tuple[str, ...]
    crs_operation: str
    options: AlignOptions
    versions: Mapping[str, str] = field(default_factory=dict)
    timings_s: Mapping[str, float] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)
    masks: tuple[MaskUse, ...] = ()
