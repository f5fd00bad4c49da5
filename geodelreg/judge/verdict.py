"""The acceptance gate: evidence against limits, and the verdict.

Every reason is a measured value against a stated limit; `geodelreg.judge.evidence` measures.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from geodelreg.fine.motions import LEAST_SHARE, TORN_SHARE
from geodelreg.fit.field import FEWEST_POINTS, MOST_STRAIN
from geodelreg.options import AlignOptions
from geodelreg.pair import LATTICE, Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray
from geodelreg.values.result import RADIAL_95, Outcome, Reason, Verdict

MIN_POINTS = 8  # an affine, and one more than twice the three that fix it
_MAX_LOG_EACH = -2.0  # one alarm in a hundred
_MAX_LOG_TOGETHER = -8.0  # one alarm in 10 000 by each of two that look at different things
_OFF_WHAT_IS_DRAWN = "log10 of the chance of both, off what is drawn on both images"
_LIMITS = (
    ("tie_points", "≥", MIN_POINTS, "tie points agree"),
    ("log_nfa", "≤", _MAX_LOG_EACH, "log10 of the expected chance agreements"),
    ("log_chance", "≤", _MAX_LOG_EACH, "log10 of the chance that unrelated areas correlate so"),
    ("log_together", "≤", _MAX_LOG_TOGETHER, "log10 of the chance of both, positions and likeness"),
    ("coverage", "≥", 0.05, "share of the overlap covered"),
    ("sigma_px", "≤", 0.7, "PAN px standard error at the worst corner"),
    ("disagreement_px", "≤", 1.0, "PAN px between the correction and"),
    ("rival", "≤", 0.85, "relative correlation of the best rival place"),
    ("shading", "≤", 0.3, "relative correlation of opposite contrast beside the place"),
    ("rival_motion", "≤", 0.67, "patches agree on another motion for each that agrees on this one"),
    ("support", "≥", 0.5, "share of the areas correlates best in place"),
    ("bands_apart", "≤", 0.5, "coarser px between the places of two MS bands, as of clouds"),
)
"""Name of the evidence, what it must be, and the words for it; docs/gate.md says why so much."""
_KEYPOINTS = "coarser px from where keypoints, more certain, put the ground"
_OF_BANDS = ("bands_apart", "bands")
"""Not asked where each band is corrected by itself."""
OF_THE_WHOLE = ("two_motions", "local")
"""Asked of all patches about a map that those which agree speak for."""
_BANDS_APART = "PAN px at least between the places of two MS bands"
_APART_FROM = {True: "half of the tie points", False: "the patches around it"}
"""What `disagreement_px` compares it with, in our method and in others."""
_UNCERTAINTY = "PAN px uncertainty (95 %) at the worst corner"
SYSTEMATIC_PX = 0.005  # of PAN; by hand: ½ to 2 × alike
SIGNIFICANCE = 3.0
MAX_KEYPOINTS_APART = 2.0
"""Coarser pixels: further is another place, and no inaccuracy of keypoints."""
MAX_BANDS_PX = 1.0
"""Between two MS bands: no one correction is right for both to half a PAN pixel."""


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
    shading : float
        The same of opposite contrast, beside the place and on one side of it.
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
    keypoints_words : str
        Which part the correction follows, and how that lies to the ground by the keypoints.
    residual_low_px : float
        Lower end of the 95 % interval of what the correction leaves of the ground's smooth map.
    moved : float
        Share of the textured patches that agree on another motion than the ground's.
    words : str
        Where those lie.
    bands : float
        PAN pixels between where two MS bands, each by itself, put the ground, beyond their standard
        errors.
    bands_words : str
        Which bands, and how they lie.
    strain : float
        Largest of a field, at its points and over the raster; 0 of what is none.
    repeated : float or None
        `log_nfa` and `log_chance` together, off structure of the pixel grid that both images
        repeat; None where there is none.
    repeated_words : str
        The values that it is drawn with.
    """

    points: int
    log_nfa: float
    log_chance: float
    coverage: float
    sigma_px: float
    disagreement_px: float
    rival: float
    shading: float
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
    bands: float = 0.0
    bands_words: str = ""
    keypoints_words: str = ""
    strain: float = 0.0
    repeated: float | None = None
    repeated_words: str = ""


def judge(evidence: Evidence, options: AlignOptions) -> tuple[Reason, ...]:
    """Hold each piece of evidence against its limit.

    Returns
    -------
    tuple of Reason
        The correction is believed when all passed.
    """
    where = f": {evidence.words}" if evidence.words else ""
    which = f": {evidence.bands_words}" if evidence.bands_words else ""
    most_px = options.max_residual_px if options.on_local == "refuse" else None
    repeated = _MAX_LOG_TOGETHER if evidence.repeated is not None else None
    from_here = f": {evidence.keypoints_words}" if evidence.keypoints_words else ""
    whole = (
        ("keypoints_apart", "≤", MAX_KEYPOINTS_APART, f"{_KEYPOINTS}{from_here}"),
        ("max_uncertainty", "≤", options.max_uncertainty_px, _UNCERTAINTY),
        ("repeated", "≤", repeated, f"{_OFF_WHAT_IS_DRAWN} ({evidence.repeated_words})"),
        ("bands", "≤", MAX_BANDS_PX, f"{_BANDS_APART}{which}"),
        _strain_limit(evidence.strain),
        ("two_motions", "≤", TORN_SHARE, f"of the patches follow another motion{where}"),
        ("local", "≤", most_px, "PAN px RMS at least is left of the ground's bend"),
    )
    values = asdict(evidence) | {
        "tie_points": evidence.points,
        "log_together": evidence.log_nfa + evidence.log_chance,
        "max_shift": evidence.shift_px,
        "max_rotation": evidence.rotation_deg,
        "max_scale": evidence.scale,
        "max_uncertainty": RADIAL_95 * evidence.sigma_px,
        "two_motions": evidence.moved,
        "local": evidence.residual_low_px,
    }
    reasons = []
    for name, relation, limit, what in (*_LIMITS, *_asked(options), *whole):
        if limit is not None and not (options.per_band and name in _OF_BANDS):
            apart_from = _APART_FROM[options.method == "delaunay"] if what.endswith("and") else ""
            words = f"{what} {apart_from}".rstrip()
            reasons.append(_reason(name, values[name], relation, limit, words))
    return tuple(reasons)


def judge_motion(
    shift_px: float, rotation_deg: float, scale: float, strain: float, options: AlignOptions
) -> tuple[Reason, ...]:
    """Hold a map that a person answers for against what was asked, and against folds.

    Parameters
    ----------
    shift_px, rotation_deg, scale, strain
        As in `Evidence`.
    options : AlignOptions
    """
    values = {
        "max_shift": shift_px, "max_rotation": rotation_deg, "max_scale": scale, "strain": strain
    }  # fmt: skip
    limits = [*_asked(options), _strain_limit(strain)]
    return tuple(
        _reason(name, values[name], relation, limit, what)
        for name, relation, limit, what in limits
        if limit is not None
    )


def _asked(options: AlignOptions) -> tuple[tuple[str, str, float | None, str], ...]:
    return (
        ("max_shift", "≤", options.max_shift_px, "PAN px shift"),
        ("max_rotation", "≤", options.max_rotation_deg, "deg rotation"),
        ("max_scale", "≤", options.max_scale, "scale factor"),
    )


def _strain_limit(strain: float) -> tuple[str, str, float | None, str]:
    """Asked of a field alone."""
    words = "strain of the field, which so steep would fold the ground"
    return "strain", "≤", MOST_STRAIN if strain else None, words


def passes(reasons: tuple[Reason, ...]) -> bool:
    """True when nothing speaks against a correction."""
    return all(reason.passed for reason in reasons)


def bands_reason(apart_px: float, words: str) -> Reason:
    """The reason of MS bands that were found one by one, and lie at least so far apart."""
    return _reason("bands", apart_px, "≤", MAX_BANDS_PX, f"{_BANDS_APART}: {words}")


def nothing_agrees() -> Reason:
    """The reason when no transformation was found at all."""
    message = "no transformation was found that enough places agree on"
    return Reason("tie_points", 0.0, float(MIN_POINTS), False, message)


def too_few_for_a_field(points: int) -> Reason:
    """The reason when a field was asked for that the tie points do not determine."""
    message = f"{points} tie points that agree determine no field (needs ≥ {FEWEST_POINTS})"
    return Reason("field_points", float(points), float(FEWEST_POINTS), False, message)


def clouds_in_the_way(share: float) -> Reason:
    """The reason when a field was asked for and much moves as clouds do: it would follow them.

    One affine is told from clouds because they do not move as one; a field may move as they do.
    """
    message = f"{share:.4g} of the patches move as clouds do, and a field would follow them"
    return Reason("field_clouds", share, LEAST_SHARE, False, f"{message} (needs ≤ {LEAST_SHARE:g})")


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


def moves_pair(pair: Pair, correction: PixelMap) -> bool:
    """True of a correction that is worth to be applied."""
    spots = pair.source_lattice(LATTICE)
    move_px = np.hypot(*pair.move_px(correction, spots).T)
    sigma_px = correction.sigma_at(spots) * pair.pan_px_per_source_px
    return is_worthwhile(move_px, sigma_px, pair.options.tolerance_px)


def _reason(name: str, value: float, relation: str, limit: float, what: str) -> Reason:
    passed = value >= limit if relation == "≥" else value <= limit
    number = f"{value:.4g}"
    if number == "1":
        what = what.replace("points agree", "point agrees").replace("patches agree", "patch agrees")
    message = f"{number} {what} (needs {relation} {limit:g})"
    return Reason(name, float(value), float(limit), bool(passed), message)
