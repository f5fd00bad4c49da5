"""Plain words for what a result says."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from geodelreg.flags import arguments, as_typed
from geodelreg.judge.words import region
from geodelreg.options import AlignOptions
from geodelreg.product.check import Check, verdict_line
from geodelreg.product.report import accuracy_lines, found_line, next_line, short
from geodelreg.report.frame import frame_of
from geodelreg.report.residuals import WORTH_A_WORD, elsewhere, local_residual, matched, unmatched
from geodelreg.values.points import Status, TiePoints
from geodelreg.values.raster import BoolArray, FloatArray
from geodelreg.values.result import Alignment, CheckOutcome, Outcome, Reason

OUTCOMES: dict[Outcome | CheckOutcome, str] = {
    Outcome.ALIGNED: "Aligned",
    Outcome.ALREADY_ALIGNED: "Already aligned",
    Outcome.REFUSED: "Refused",
    CheckOutcome.ALIGNED: "Aligned",
    CheckOutcome.MISALIGNED: "Misaligned",
    CheckOutcome.CANNOT_TELL: "Cannot tell",
}
AFTER = {
    Outcome.ALIGNED: "corrected",
    Outcome.ALREADY_ALIGNED: "as measured (header kept)",
    Outcome.REFUSED: "candidate (refused)",
}
"""What the corrected MS is called in pictures."""

STATUS = {
    Status.KEPT: "kept",
    Status.RATIO: "resembles two places",
    Status.DUPLICATE: "claims a place twice",
    Status.COLLINEAR: "in a row with others",
    Status.COCIRCULAR: "on a circle with others",
    Status.TOPOLOGY: "folds the mesh",
    Status.CONSENSUS: "matched, lies elsewhere",
    Status.TEXTURE: "too little texture",
    Status.CONVERGENCE: "found no match",
    Status.CORRELATION: "looks too different",
    Status.STAR: "matched, moves unlike its neighbours",
    Status.RESIDUAL: "matched, far from the fit",
    Status.EXCLUDED: "not enabled",
}


def is_telling(status: Status) -> bool:
    """False of points that merely showed too little to be matched."""
    return status is not Status.TEXTURE


REASONS = {
    "tie_points": ("Tie points that agree", "Places seen in both images that tell the same story."),
    "log_nfa": ("Agreement is no chance", "How often chance alone would make places agree so."),
    "log_chance": (
        "Likeness is no chance",
        "Whether areas resemble each other best just where the correction puts them.",
    ),
    "log_together": ("Both together are no chance", "Positions and likeness at once."),
    "coverage": ("Spread over the overlap", "Share of the common ground that tie points enclose."),
    "sigma_px": ("Uncertainty at the worst corner", "Standard error of the correction there."),
    "disagreement_px": ("Halves agree", "Distance between fits to two halves of the points."),
    "rival": ("No rival place", "Likeness at the best other place over that at the found one."),
    "shading": (
        "Lit alike",
        "Likeness of opposite contrast close beside the place, on one side alone.",
    ),
    "repeated": (
        "True of the ground alone",
        "Positions and likeness without labels, collars and what else is drawn on both images.",
    ),
    "rival_motion": (
        "No rival motion",
        "Patches that agree on another motion, for each that agrees on this one.",
    ),
    "support": ("Areas agree", "Share of the areas that look alike best in place."),
    "bands_apart": (
        "Bands agree",
        "Distance between where two bands of MS put the ground; clouds make them differ.",
    ),
    "bands": ("Bands lie together", "Distance between bands of MS that other bands confirm."),
    "strain": ("The field folds nothing", "Largest strain of the field."),
    "field_points": ("Enough points for a field", "A field on few points bends between them."),
    "field_clouds": (
        "No clouds for a field to follow",
        "Share of the patches that move as clouds do: a field can move as they do.",
    ),
    "keypoints_apart": (
        "No surer keypoints object",
        "Distance from where distinct features, more certain ones, put the ground; 0 without any.",
    ),
    "max_shift": ("Shift within your limit", "As asked with `max_shift_px`."),
    "max_rotation": ("Rotation within your limit", "As asked with `max_rotation_deg`."),
    "max_uncertainty": ("Uncertainty within your limit", "As asked with `max_uncertainty_px`."),
    "max_scale": ("Scale within your limit", "As asked with `max_scale`."),
    "two_motions": (
        "No motion beside the bend",
        "Share of the patches that lie elsewhere together and do not count as the ground's bend.",
    ),
    "local": (
        "One affine is enough",
        "What one affine leaves of the ground's bend: relief, dropped rows, a torn mosaic.",
    ),
}
"""Of each reason of the gate: what it asks, and what it measures."""
FAILED = {
    "tie_points": "Too few places are recognised in both images.",
    "log_nfa": "The places that agree could as well agree by chance.",
    "log_chance": "The areas resemble each other no better in place than elsewhere.",
    "log_together": "Positions and likeness together could still be chance.",
    "coverage": "The places that agree lie together in a small part of the overlap.",
    "sigma_px": "The correction is too uncertain at the far corner.",
    "disagreement_px": "Two halves of the tie points tell different corrections.",
    "rival": "The images fit nearly as well at another place, as over clouds or a "
    "repeating pattern.",
    "shading": "Light falls differently on the two images: one is shaded like relief.",
    "repeated": "Labels, collars or the like on both images fit, and the ground does not.",
    "rival_motion": "Nearly as many patches agree on another motion as on the one followed: a part "
    "that moves by itself, or a bend.",
    "support": "Too many areas look alike better elsewhere than in place.",
    "bands_apart": "The bands of MS do not lie on each other, as over clouds.",
    "bands": "No one correction is right for all bands of MS.",
    "strain": "The field is so steep somewhere that it would fold the ground.",
    "field_points": "Too few points are left to follow a bend.",
    "field_clouds": "A field would follow the clouds.",
    "keypoints_apart": "Distinct features say another place than the patches, which may "
    "have followed clouds.",
    "max_shift": "The shift is larger than you allowed.",
    "max_rotation": "The rotation is larger than you allowed.",
    "max_uncertainty": "The place is less well known than you allowed.",
    "max_scale": "The scale differs by more than you allowed.",
    "two_motions": "A part of the picture lies elsewhere than the rest.",
    "local": "One affine, and so a header, cannot follow all of the ground.",
}
"""Of each reason of the gate: what it means that it failed."""
_OF_THE_WHOLE = ("two_motions", "local")
"""Reasons that are asked only of what passed the others."""
_AT_LEAST = ("tie_points", "coverage", "support", "field_points")
_WORST = 2.0
_WORTH_A_WORD = 0.05
"""Of the patches that matched: fewer lie elsewhere in any good pair."""
_MOSTLY = 0.75
_ALL_OVER = "all over the picture"
_TOGETHER = 0.4
"""Spread over length of displacements that are one motion."""


@dataclass(frozen=True, slots=True)
class Bar:
    """A reason of the gate against its limit.

    Attributes
    ----------
    question, meaning, message : str
    failure : str
        What it means that it failed.
    passed : bool or None
        None of what was not measured.
    used : float
        How much of what is allowed is used up, 0 to 2: the limit is 1, and more has failed.
    """

    question: str
    meaning: str
    message: str
    failure: str
    passed: bool | None
    used: float


def bar(reason: Reason) -> Bar:
    """The bar of a reason."""
    question, meaning = REASONS.get(reason.name, (reason.name.replace("_", " "), ""))
    more_is_better = reason.name in _AT_LEAST or reason.limit < 0
    small, large = (reason.limit, reason.value) if more_is_better else (reason.value, reason.limit)
    ratio = small / large if large else math.inf
    if not math.isfinite(ratio) or ratio < 0:
        ratio = 0.0 if reason.passed else _WORST
    used = min(ratio, 1.0) if reason.passed else min(max(ratio, 1.0), _WORST)
    failure = FAILED.get(reason.name, f"{question}: no.")
    return Bar(question, as_typed(meaning), reason.message, failure, reason.passed, used)


def bars(alignment: Alignment) -> list[Bar]:
    """The bars of a verdict; what was not measured has neither passed nor failed."""
    whole = math.isfinite(alignment.accuracy.residual_interval_px[0])
    return [
        bar(reason)
        if whole or reason.name not in _OF_THE_WHOLE or reason.value
        else replace(bar(reason), passed=None, message="not measured")
        for reason in alignment.verdict.reasons
    ]


def names(paths: Sequence[str]) -> str:
    """Name of a file, or of the first of several and how many there are beside it."""
    more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
    return Path(paths[0]).name + more


def headline(alignment: Alignment, check: Check | None = None) -> str:
    """The outcome in a word or two."""
    return OUTCOMES[(check or alignment.verdict).outcome]


def story(alignment: Alignment, check: Check | None = None) -> list[str]:
    """The verdict, what is left and where, a sentence or two each."""
    if check is not None:
        told = verdict_line(check).removeprefix(f"{check.source_name}: ")
    elif alignment.verdict.outcome is Outcome.REFUSED:
        told = "the images do not support this alignment. Nothing was written"
        if alignment.tie_points.kept.any() or alignment.accuracy.kept:
            told += f". {_candidate(alignment)}"
    else:
        told = found_line(alignment).partition(": ")[2].removesuffix(".")
    points = alignment.tie_points
    nothing = "match nothing near where the others say, though they show something"
    silent = "showed nothing to match, as water does, or were left out"
    texts = [
        _elsewhere(alignment),
        _unheard(alignment, unmatched(points), nothing),
        _unheard(alignment, points.status == Status.TEXTURE, silent),
        _left(alignment),
    ]
    if alignment.verdict.accepted:
        texts.reverse()
    return [f"{_sentence(told)}.", *(text for text in texts if text)]


def advice(alignment: Alignment, check: Check | None = None) -> str:
    """What to do next."""
    if alignment.verdict.outcome is Outcome.REFUSED:
        return as_typed(alignment.verdict.remedy)
    if check is None:
        return as_typed(_sentence(next_line(alignment).removeprefix("Next: ")))
    if check.outcome is CheckOutcome.CANNOT_TELL:
        return as_typed(check.remedy)
    if check.outcome is CheckOutcome.MISALIGNED:
        return "Correct the header with geodelreg align."
    return "Use the raster as it is."


def _candidate(alignment: Alignment) -> str:
    """What was refused: where it would move MS, and by what model."""
    frame = frame_of(alignment)
    middle = np.array([frame.ms_size]) / 2
    (move,) = frame.header.forward(frame.found.forward(middle)) - frame.header.forward(middle)
    return (
        f"The candidate that was refused moves MS at its centre {direction(move)} "
        f"(PAN px, model {alignment.solution.model})"
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _left(alignment: Alignment) -> str:
    """Uncertainty, residual and scatter; of a refusal those of the part that was followed."""
    whose = () if alignment.verdict.accepted else ("Of the part that the candidate follows.",)
    return " ".join((*whose, *accuracy_lines(alignment)))


def _elsewhere(alignment: Alignment) -> str:
    """How many patches matched elsewhere, where they are, how far off, and whether together."""
    points = alignment.tie_points
    some, away = matched(points), elsewhere(points)
    if away.sum() < _WORTH_A_WORD * some.sum() or not away.any():
        return ""
    off = points.residual_px[away]
    length = float(np.median(np.hypot(*off.T)))
    where = _region(alignment, some, away)
    if where == _ALL_OVER:
        fits = _region(alignment, some, some & ~away)
        where += f" (those that fit: {fits})" if fits != _ALL_OVER else ""
    return (
        f"{int(away.sum())} of {int(some.sum())} patches that matched lie elsewhere: "
        f"{where}, {short(length)} PAN px off in the median, {_pattern(points, away, length)}."
        f"{_edge(points.source_px[some], away[some], where)}"
    )


def _edge(xy: FloatArray, away: BoolArray, where: str) -> str:
    """Between which rows or columns of MS a part at one side begins; empty of other parts."""
    side = where.split()[1]
    if not where.startswith("the ") or away.all():
        return ""
    along = np.sort(xy[:, 1 if side in ("upper", "lower") else 0])
    count = int(away.sum())
    last = count if side in ("upper", "left") else len(along) - count
    low, high = along[last - 1], along[last]
    what = "rows" if side in ("upper", "lower") else "columns"
    return f" The edge of that part lies between {what} {low:.0f} and {high:.0f} of MS."


def _pattern(points: TiePoints, away: BoolArray, length_px: float) -> str:
    """How the patches that lie elsewhere move: as one, more and more, or each for itself."""
    off = points.residual_px[away]
    middle = np.median(off, axis=0)
    if np.median(np.hypot(*(off - middle).T)) < _TOGETHER * length_px:
        return f"all alike ({direction(middle)}), as if that part were torn off and moved"
    around, _ = local_residual(points, points.reference_px[away])
    if np.median(np.hypot(*(off - around).T)) < _TOGETHER * length_px:
        return "in directions that change gradually, as if the picture were bent"
    return "each in its own direction, as clouds and changed ground do"


def _unheard(alignment: Alignment, some: BoolArray, told: str) -> str:
    """How many patches have this fate, and where they are; empty of a few."""
    if some.sum() <= WORTH_A_WORD * len(some):
        return ""
    every = np.ones(len(some), dtype=np.bool_)
    return f"{int(some.sum())} of {len(some)} patches {told}: {_region(alignment, every, some)}."


def _region(alignment: Alignment, some: BoolArray, member: BoolArray) -> str:
    """Where some of the patches lie, in words."""
    height, width = alignment.source.grid.shape
    xy = alignment.tie_points.source_px
    sharp = region(xy[some], member[some], (float(width), float(height)))
    if sharp.startswith("the "):
        return f"{sharp} of the patches"
    x, y = (xy[member] / (width, height)).T
    words = [_half(y, "upper", "lower"), _half(x, "left", "right")]
    where = " ".join(dict.fromkeys(word for word in words if word))
    if where in ("upper", "lower", "left", "right"):
        where += " half"
    return f"mostly in the {where} of the picture" if where else _ALL_OVER


def _half(share: FloatArray, low: str, high: str) -> str:
    """Which half of an axis, of its length, most places lie in; empty of none."""
    halves = {low: share < 0.5, high: share > 0.5, "middle": np.abs(share - 0.5) < 0.25}
    best = max(halves, key=lambda name: halves[name].mean())
    return best if halves[best].mean() >= _MOSTLY else ""


def direction(residual_px: Sequence[float] | FloatArray) -> str:
    """A displacement, right and down, in words."""
    right, down = (float(value) for value in residual_px)
    return (
        f"{short(abs(right))} {'right' if right >= 0 else 'left'} and "
        f"{short(abs(down))} {'down' if down >= 0 else 'up'}"
    )


def command(alignment: Alignment) -> str:
    """The command that finds the same again and makes a report of it."""
    defaults, options = AlignOptions(), alignment.options
    words = ["geodelreg", "align", *alignment.source.paths, *alignment.reference.paths, "--dry-run"]
    words += ["--report", "again.html"]
    for field in fields(AlignOptions):
        value = getattr(options, field.name)
        if field.name == "threads" or value == getattr(defaults, field.name):
            continue
        words += arguments(field.name, value)
    return shlex.join(words)
