"""The acceptance gate: evidence against limits, and the verdict.

Every reason is a measured value against a stated limit; `geodelreg.judge.evidence` measures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.fine.motions import LEAST_SHARE
from geodelreg.options import AlignOptions
from geodelreg.values.raster import FloatArray
from geodelreg.values.result import Outcome, Reason, Verdict

MIN_POINTS = 8  # unexplained: ablate
MAX_LOG_EACH = -2.0
MAX_LOG_TOGETHER = -8.0  # unexplained: ablate
MAX_SIGMA_PX = 0.7  # unexplained: ablate
MIN_COVERAGE = 0.05  # unexplained: ablate
MAX_DISAGREEMENT_PX = 1.0
MAX_RIVAL = 0.85  # unexplained: ablate
MAX_RIVAL_MOTION = 0.67  # two thirds; unexplained: ablate
MIN_SUPPORT = 0.5
MAX_BANDS_APART = 0.5
MAX_KEYPOINTS_APART = 2.0
SYSTEMATIC_PX = 0.005  # of PAN; unexplained: ablate
SIGNIFICANCE = 3.0


_APART_FROM = {
    True: "PAN px between the corrections of two halves of the tie points",
    False: "PAN px between the correction and the patches around it",
}


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for and against a correction.  ``_px`` are PAN pixels; NaN = not measured.

    Attributes
    ----------
    points : int
        Tie points that the fit kept.
    log_nfa : float
        log10 of the expected number of chance agreements as good as the tie points'.
    log_chance : float
        log10 of the probability that unrelated areas correlate best, as often as here, just where
        the correction puts them and not at displaced places.
    coverage : float
        Share of the overlap inside the hull of the tie points.
    sigma_px : float
        Standard error of the correction at the worst corner of the overlap.
    disagreement_px : float
        Half the distance between fits to two halves of the tie points at the worst corner of the
        overlap; of other methods than ours, that from what dense patches around it say.
    rival : float
        Correlation at the best displaced place over that at the correction; near 1 = ambiguous.
    shift_px, rotation_deg, scale : float
        Of the correction, for the limits the user gave.
    rival_motion : float
        Patches that agree on another motion over those that agree on the correction's.
    support : float
        Share of the areas that resemble the other image that do so best in place.
    bands_apart : float
        Coarser pixels between where two MS bands, each by itself, put the ground, beyond their
        standard errors.
    keypoints_apart : float
        Coarser pixels between the correction and what stronger, refused keypoint matches say.
    residual_low_px : float
        Lower end of the 95 % interval of what the correction leaves of the ground's smooth map.
    moved : float
        Share of the textured patches that agree on another motion than the ground's.
    words : str
        Where those lie.
    """

    points: int
    log_nfa: float
    log_chance: float
    coverage: float
    sigma_px: float
    disagreement_px: float
    rival: float
    shift_px: float
    rotation_deg: float
    scale: float
    rival_motion: float
    support: float
    bands_apart: float
    keypoints_apart: float
    residual_low_px: float = 0.0
    moved: float = 0.0
    words: str = ""


def judge(evidence: Evidence, options: AlignOptions) -> tuple[Reason, ...]:
    """Hold each piece of evidence against its limit.

    Returns
    -------
    tuple of Reason
        The correction is believed when all passed.
    """
    reasons = [
        _at_least("tie_points", evidence.points, MIN_POINTS, "tie points agree"),
        _at_most(
            "log_nfa", evidence.log_nfa, MAX_LOG_EACH, "log10 of the expected chance agreements"
        ),
        _at_most(
            "log_chance",
            evidence.log_chance,
            MAX_LOG_EACH,
            "log10 of the chance that unrelated areas correlate so",
        ),
        _at_most(
            "log_together",
            evidence.log_nfa + evidence.log_chance,
            MAX_LOG_TOGETHER,
            "log10 of the chance of both, positions and likeness",
        ),
        _at_least("coverage", evidence.coverage, MIN_COVERAGE, "share of the overlap covered"),
        _at_most(
            "sigma_px", evidence.sigma_px, MAX_SIGMA_PX, "PAN px standard error at the worst corner"
        ),
        _at_most(
            "disagreement_px",
            evidence.disagreement_px,
            MAX_DISAGREEMENT_PX,
            _APART_FROM[options.method == "delaunay"],
        ),
        _at_most(
            "rival", evidence.rival, MAX_RIVAL, "relative correlation of the best rival place"
        ),
        _at_most(
            "rival_motion",
            evidence.rival_motion,
            MAX_RIVAL_MOTION,
            "patches agree on another motion for each that agrees on this one",
        ),
        _at_least(
            "support", evidence.support, MIN_SUPPORT, "share of the areas correlates best in place"
        ),
        _at_most(
            "bands_apart",
            evidence.bands_apart,
            MAX_BANDS_APART,
            "coarser px between the places of two MS bands, as of clouds",
        ),
    ]
    if options.max_shift_px is not None:
        reasons.append(
            _at_most("max_shift", evidence.shift_px, options.max_shift_px, "PAN px shift")
        )
    if options.max_rotation_deg is not None:
        reasons.append(
            _at_most(
                "max_rotation", evidence.rotation_deg, options.max_rotation_deg, "deg rotation"
            )
        )
    if options.max_scale is not None:
        reasons.append(_at_most("max_scale", evidence.scale, options.max_scale, "scale factor"))
    what = "coarser px from where keypoints, with more certainty, put the ground"
    apart = _at_most("keypoints_apart", evidence.keypoints_apart, MAX_KEYPOINTS_APART, what)
    where = f": {evidence.words}" if evidence.words else ""
    what = f"of the patches follow another motion{where}"
    whole = [_at_most("two_motions", evidence.moved, LEAST_SHARE, what)]
    if options.on_local == "refuse":
        what = "PAN px RMS at least is left by one affine of the ground's bend"
        whole.append(_at_most("local", evidence.residual_low_px, options.max_residual_px, what))
    return (*reasons, apart, *whole)


def passes(reasons: tuple[Reason, ...]) -> bool:
    """True when nothing speaks against a correction."""
    return all(reason.passed for reason in reasons)


def nothing_agrees() -> Reason:
    """The reason when no transformation was found at all."""
    message = "no transformation was found that enough places agree on"
    return Reason("tie_points", 0.0, float(MIN_POINTS), False, message)


def verdict(reasons: tuple[Reason, ...], moves: bool) -> Verdict:
    """Aligned or already aligned when every reason passed, else refused."""
    if not passes(reasons):
        return Verdict(Outcome.REFUSED, reasons)
    return Verdict(Outcome.ALIGNED if moves else Outcome.ALREADY_ALIGNED, reasons)


def is_worthwhile(move_px: FloatArray, sigma_px: FloatArray, tolerance_px: float) -> bool:
    """True when a correction is significant anywhere, or moves a pixel by more than the tolerance.

    Parameters
    ----------
    move_px : (N,) float64
        How far the correction moves points of the MS raster, PAN pixels.
    sigma_px : (N,) float64
        Its standard error there.
    tolerance_px : float
    """
    noise = np.hypot(sigma_px, SYSTEMATIC_PX)
    return bool((move_px > tolerance_px).any() or (move_px > SIGNIFICANCE * noise).any())


def _at_least(name: str, value: float, limit: float, what: str) -> Reason:
    passed = bool(value >= limit)
    return Reason(name, float(value), float(limit), passed, _sentence(value, limit, what, "≥"))


def _at_most(name: str, value: float, limit: float, what: str) -> Reason:
    passed = bool(value <= limit)
    return Reason(name, float(value), float(limit), passed, _sentence(value, limit, what, "≤"))


def _sentence(value: float, limit: float, what: str, relation: str) -> str:
    return f"{value:.4g} {what} (needs {relation} {limit:g})"
