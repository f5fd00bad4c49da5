"""The result of a check, for machines (a block of the report) and for people (a few lines)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from geodelreg.errors import shown
from geodelreg.product.motion import header_motion
from geodelreg.product.report import (
    accuracy_lines,
    json_text,
    masks_line,
    moved,
    plain,
    report_dict,
    short,
)
from geodelreg.values.result import Alignment, BandMap, CheckOutcome, Misalignment

_UNKNOWN = float("nan")
_NOTHING_KNOWN = Misalignment()
_UNSURE = (
    "The place was found, but not surely enough: allow a larger tolerance (`limit_px`), or show a "
    "larger part of the scene."
)


@dataclass(frozen=True, slots=True)
class BandCheck:
    """What one MS band says, found beside the others.  NaN = not known.

    Attributes
    ----------
    number : int
        From 1.
    name : str
    outcome : CheckOutcome
    misalignment : Misalignment
    shift_px : (float, float)
        How the band would have to move at its centre, along PAN columns and rows, PAN pixels.
    sigma_px : float
        Standard error of that shift.
    correlation : float
        With PAN, once moved.
    reason : str
        Why nothing can be told, or that it is misaligned locally; else empty.
    """

    number: int
    name: str
    outcome: CheckOutcome
    misalignment: Misalignment = _NOTHING_KNOWN
    shift_px: tuple[float, float] = (_UNKNOWN, _UNKNOWN)
    sigma_px: float = _UNKNOWN
    correlation: float = _UNKNOWN
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """Whether MS lies where PAN says.

    Attributes
    ----------
    raster_outcome : CheckOutcome
        Of the raster as a whole.
    limit_px : float
        Largest misalignment that counts as aligned, PAN pixels.
    misalignment : Misalignment
    affine_enough : bool or None
        False when a local warp is needed; None when nothing can be told.
    alignment : Alignment
        The evidence; its correction is the measured one, however small.
    bands : tuple of BandCheck or None
        None when bands were not checked one by one.
    """

    raster_outcome: CheckOutcome
    limit_px: float
    misalignment: Misalignment
    affine_enough: bool | None
    alignment: Alignment
    bands: tuple[BandCheck, ...] | None = None

    @property
    def source_name(self) -> str:
        """File name of MS, and the number of further files."""
        first, *others = self.alignment.source.paths
        return Path(first).name + (f" and {len(others)} more" if others else "")

    @property
    def outcome(self) -> CheckOutcome:
        """Misaligned when the raster or any of the checked bands is, else the raster's outcome."""
        if any(band.outcome is CheckOutcome.MISALIGNED for band in self.bands or ()):
            return CheckOutcome.MISALIGNED
        return self.raster_outcome

    @property
    def reason(self) -> str:
        """Why nothing can be told, or that the raster is misaligned locally; else empty."""
        return explanation(self.raster_outcome, self.misalignment, self.alignment, self.limit_px)

    @property
    def remedy(self) -> str:
        """What can be done when nothing can be told."""
        verdict = self.alignment.verdict
        return _UNSURE if verdict.accepted else verdict.remedy


def explanation(
    outcome: CheckOutcome, misalignment: Misalignment, alignment: Alignment, limit_px: float
) -> str:
    """What the figures do not show: why nothing can be told, or that the misalignment is local."""
    low, high = misalignment.residual_interval_px
    if outcome is CheckOutcome.MISALIGNED:
        if misalignment.moved:
            return misalignment.moved
        if misalignment.local_px > limit_px or low > limit_px:
            local = max(misalignment.local_px, low) if low > limit_px else misalignment.local_px
            return f"{short(local)} PAN px RMS of local distortion"
    if outcome is not CheckOutcome.CANNOT_TELL:
        return ""
    failed = [reason.message for reason in alignment.verdict.reasons if not reason.passed]
    doubt = f"the standard error of {short(misalignment.sigma_px)} PAN px is"
    if high > limit_px:
        doubt = (
            f"{short(high)} PAN px RMS, which one affine may leave, or the standard error of "
            f"{short(misalignment.sigma_px)} PAN px are"
        )
    return "; ".join(failed) or f"{doubt} too large for a tolerance of {limit_px:g} PAN px"


def band_check(
    band: BandMap,
    alignment: Alignment,
    misalignment: Misalignment,
    limit_px: float,
    outcome: CheckOutcome,
) -> BandCheck:
    """Row of one band that was found beside the others of an alignment."""
    solution = replace(alignment.solution, map=band.map)
    shift_px = header_motion(replace(alignment, solution=solution)).shift_px
    reason = explanation(outcome, misalignment, alignment, limit_px)
    return BandCheck(
        band.number, band.name, outcome, misalignment, shift_px, band.sigma_px,
        band.correlation, reason,
    )  # fmt: skip


def check_json(check: Check) -> str:
    """The report of the alignment as text, with the block ``check`` in it."""
    return json_text(check_dict(check))


def check_dict(check: Check) -> dict[str, Any]:
    """`report_dict` of the alignment, with the block ``check`` in it."""
    bands = check.bands
    block = {
        "outcome": check.outcome.value,
        "raster_outcome": check.raster_outcome.value,
        "limit_px": check.limit_px,
        "reason": check.reason,
        "misalignment": asdict(check.misalignment),
        "affine_enough": check.affine_enough,
        "bands": None if bands is None else [_band_dict(band) for band in bands],
    }
    return report_dict(check.alignment) | {"check": plain(block)}


def _band_dict(band: BandCheck) -> dict[str, Any]:
    return asdict(band) | {"outcome": band.outcome.value}


def check_text(check: Check) -> str:
    """A few lines for people: the verdict, what it rests on, and a table of the bands."""
    lines = [verdict_line(check)]
    if check.alignment.verdict.accepted:
        if check.raster_outcome is not CheckOutcome.CANNOT_TELL:
            lines.append(_motion_line(check))
        lines += [_local_line(check), *accuracy_lines(check.alignment)]
    if check.alignment.masks:
        lines.append(masks_line(check.alignment))
    if check.bands is not None:
        lines += ["", *_band_lines(check.bands)]
    return "\n".join(map(shown, lines))


def verdict_line(check: Check) -> str:
    """File, verdict and misalignment in one line."""
    name = check.source_name
    limit = f"tolerance {check.limit_px:g} PAN px"
    if check.raster_outcome is CheckOutcome.CANNOT_TELL:
        return f"{name}: cannot tell ({limit})"
    off = check.misalignment
    distance = f"{_with_sigma(off.distance_px, off.sigma_px)} PAN px"
    metres = f" ({short(off.distance_m)} m)" if math.isfinite(off.distance_m) else ""
    if check.raster_outcome is CheckOutcome.MISALIGNED:
        local = f", {check.reason}" if check.reason else ""
        return f"{name}: misaligned by up to {distance}{metres}{local} ({limit})"
    more = ", not significantly more" if off.distance_px > check.limit_px else ""
    return f"{name}: aligned, off by at most {distance}{metres} ({limit}{more})"


def _with_sigma(value: float, sigma: float) -> str:
    """``0.71 ± 0.05``: both with the decimals of the two leading digits of `sigma`."""
    digits = min(max(1 - math.floor(math.log10(sigma)), 0), 4) if sigma > 0 else 4
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _motion_line(check: Check) -> str:
    motion = header_motion(check.alignment)
    width, height = motion.scale
    return (
        f"To fit PAN, its centre would move {moved(motion.shift_px)}; rotation "
        f"{motion.rotation_deg:.4f}°, scale × {width:.6f}, × {height:.6f} "
        f"(model {check.alignment.correction.model})."
    )


def _local_line(check: Check) -> str:
    if check.affine_enough is None:
        return (
            "Too few tie points agree, or too many lie elsewhere, to tell if one affine is enough."
        )
    if check.affine_enough:
        return "One affine is enough."
    left = max(check.misalignment.local_px, check.misalignment.residual_interval_px[0])
    return (
        f"One affine is not enough: it leaves {short(left)} PAN px RMS of smooth distortion, a "
        "local warp is needed."
    )


def _band_lines(bands: tuple[BandCheck, ...]) -> list[str]:
    """Table of the bands; dx and dy are the move of the centre in PAN pixels, as in the report."""
    width = max(4, *(len(band.name) for band in bands))
    lines = [
        f"{'band':<{width}}  {'dx':>9}  {'dy':>9}  {'±':>7}  {'most':>9}  {'corr':>5}  verdict"
    ]
    for band in bands:
        dx, dy = (_cell(value, "+.3f") for value in band.shift_px)
        verdict = band.outcome.value.replace("_", " ")
        row = (
            f"{band.name:<{width}}  {dx:>9}  {dy:>9}  {_cell(band.sigma_px, '.3f'):>7}  "
            f"{_cell(band.misalignment.distance_px, '.3f'):>9}  "
            f"{_cell(band.correlation, '.2f'):>5}  {verdict}"
        )
        lines.append(row + (f": {band.reason}" if band.reason else ""))
    return lines


def _cell(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"
