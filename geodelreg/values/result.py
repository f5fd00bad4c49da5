"""What an alignment found out: accuracy, verdict, the correction and all that led to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from affine import Affine

from geodelreg.masking import MaskUse
from geodelreg.options import AlignOptions
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import FitForm, TiePoints
from geodelreg.values.raster import Grid
from geodelreg.values.remedies import remedy_for

RADIAL_95 = 1.73
"""Radius that 95 % of errors stay within, over their root mean square: √(ln 20)."""


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
    def original_geotransform(self) -> tuple[float, ...]:
        """`original` in GDAL's order, as in the JSON report."""
        return tuple(self.original.to_gdal())

    @property
    def corrected_geotransform(self) -> tuple[float, ...]:
        """`corrected` in GDAL's order, as in the JSON report."""
        return tuple(self.corrected.to_gdal())

    @property
    def map_transform(self) -> Affine:
        """Header map coordinates to true map coordinates."""
        transform: Affine = self.corrected @ ~self.original
        return transform

    def apply(self, transform: Affine) -> Affine:
        """Corrected geotransform of another raster that shares the header error."""
        corrected: Affine = self.map_transform @ transform
        return corrected


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

    @property
    def knows_the_place(self) -> bool:
        """True unless refused for want of evidence; parts of the ground may lie elsewhere."""
        failed = self._failed
        return self.accepted or (bool(failed) and failed <= {"local", "two_motions"})

    @property
    def remedy(self) -> str:
        """What can be done about a refusal."""
        return remedy_for(self._failed)

    @property
    def _failed(self) -> set[str]:
        return {reason.name for reason in self.reasons if not reason.passed}


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
    residual_interval_px : (float, float)
        95 % interval of what one affine leaves of the ground's map, RMS, PAN pixels.
    moved : str
        Which part lies elsewhere than the rest, and where; empty when none does.
    """

    distance_px: float = float("nan")
    distance_m: float = float("nan")
    sigma_px: float = float("nan")
    local_px: float = float("nan")
    residual_interval_px: tuple[float, float] = (float("nan"), float("nan"))
    moved: str = ""


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
    systematic_px : float
        What of it moves all patches alike, and no residual shows.
    coverage : float
        Share of the overlap's area inside the hull of the kept points, 0 to 1.
    e1_before, e1_after : float
        The paper's grey-value RMSE after histogram matching, in DN.
    ncc_before, ncc_after : float
        Correlation of the areas under the original and the corrected header.
    residual_rms_px, residual_p95_px : float
        What the correction leaves of the ground's smooth map where both images show it, without
        the noise of patches: root mean square and 95th percentile.
    residual_interval_px : (float, float)
        95 % interval of that root mean square.
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
    systematic_px: float = float("nan")
    coverage: float = float("nan")
    e1_before: float = float("nan")
    e1_after: float = float("nan")
    ncc_before: float = float("nan")
    ncc_after: float = float("nan")
    residual_rms_px: float = float("nan")
    residual_p95_px: float = float("nan")
    residual_interval_px: tuple[float, float] = (float("nan"), float("nan"))
    kept: int = 0
    checked: int = 0

    @property
    def uncertainty_px(self) -> float:
        """Uncertainty of the correction: 95 % of its errors at the worst corner are smaller."""
        return RADIAL_95 * self.sigma_corner_px


@dataclass(frozen=True, slots=True, eq=False)
class BandMap:
    """Where one MS band lies, matched by itself.

    Attributes
    ----------
    number : int
        From 1.
    name : str
    map : PixelMap
        Its MS pixels to MS header pixels.
    sigma_px : float
        Standard error of the place at the raster's centre, PAN pixels.
    correlation : float
        With PAN, where it lies; NaN when not known.
    """

    number: int
    name: str
    map: PixelMap
    sigma_px: float
    correlation: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What the two images say: a map, with everything known about it.

    Attributes
    ----------
    model : str
        Of `map`: ``shift``, ``scale``, ``similarity``, ``affine``; ``none`` when nothing was found.
    map : PixelMap
        MS pixels to MS header pixels: where the header should put what a pixel shows.
    tie_points : TiePoints
    accuracy : Accuracy
    verdict : Verdict
    step_counts : dict of str to int
        Points that survive each step, in order; the paper's "112 → 97 → 91".
    band_weights : dict of str to float
        Bands matched on and their weights in the synthetic PAN.
    warnings : tuple of str
    search : str
        Which search led to it: ``header``, ``keypoints``, ``whole``; ``none`` when none did.
    bands : tuple of BandMap
        With ``per_band`` those of the bands that show enough by themselves, else none.
    form : FitForm or None
        With which the weighted tie points give `map` again; None where they do not.
    """

    model: str
    map: PixelMap
    tie_points: TiePoints
    accuracy: Accuracy
    verdict: Verdict
    step_counts: Mapping[str, int]
    band_weights: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    search: str = "none"
    bands: tuple[BandMap, ...] = ()
    form: FitForm | None = None


@dataclass(frozen=True, slots=True)
class Input:
    """A raster as it was read.

    Attributes
    ----------
    paths : tuple of str
        Its file, or one file per band.
    grid : Grid
    fingerprints : tuple of str
        Of the files when they were read; "" of what is no local file.
    in_memory : bool
        It is no file, or not all of it: of arrays and open datasets `paths` are mere names.
    """

    paths: tuple[str, ...]
    grid: Grid
    fingerprints: tuple[str, ...] = ()
    in_memory: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Everything `align` found out.

    Attributes
    ----------
    source, reference : Input
        MS and PAN.
    solution : Solution
    options : AlignOptions
    crs_operation : str
        pyproj's operation from MS to PAN coordinates, with its accuracy; "" for equal CRSs.
    warnings : tuple of str
        Those of the solution and of the files.
    masks : tuple of MaskUse
    versions, timings_s : dict
        Of everything that can change a result; wall time of the stages.
    points : Input or None
        File of the points that a refit was made to; where no PAN was given it is `reference`, too,
        on the grid of MS.
    """

    source: Input
    reference: Input
    solution: Solution
    options: AlignOptions
    crs_operation: str = ""
    warnings: tuple[str, ...] = ()
    masks: tuple[MaskUse, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    timings_s: Mapping[str, float] = field(default_factory=dict)
    points: Input | None = None

    @property
    def has_pan(self) -> bool:
        """False of a refit to points alone: pixels are then those of MS."""
        return self.points is None or self.points.paths != self.reference.paths

    @property
    def tie_points(self) -> TiePoints:
        """Of the solution."""
        return self.solution.tie_points

    @property
    def accuracy(self) -> Accuracy:
        """Of the solution."""
        return self.solution.accuracy

    @property
    def verdict(self) -> Verdict:
        """Of the solution."""
        return self.solution.verdict

    @property
    def fits_a_header(self) -> bool:
        """False of a correction that no geotransform can hold."""
        moves = self.verdict.outcome is Outcome.ALIGNED
        return not moves or self.solution.map.as_affine() is not None

    @property
    def correction(self) -> Correction:
        """The correction to write: of an unbelieved or needless one, the header as it is.

        Of one that no geotransform can hold, what comes nearest to it at the raster's centre.
        """
        grid, moves = self.source.grid, self.verdict.outcome is Outcome.ALIGNED
        corrected = grid.transform @ self._affine() if moves else grid.transform
        model = self.solution.model if moves else "none"
        return Correction(model, grid.crs_wkt, grid.transform, corrected)

    def _affine(self) -> Affine:
        affine = self.solution.map.as_affine()
        if affine is not None:
            return affine
        height, width = self.source.grid.shape
        centre = np.array([[width / 2, height / 2]])
        local = self.solution.map.linearise(centre)[0].ravel().tolist()
        return Affine(*local) @ Affine.translation(*-centre[0])
