"""What a user should know about a solution beyond its figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from geodelreg.fine.layers import ELSEWHERE, LOCAL_RMS_PX, elsewhere, many_elsewhere
from geodelreg.fine.motions import LEAST_PATCHES, LEAST_SHARE
from geodelreg.fit.choice import spatial_blocks
from geodelreg.geo.footprint import overlap_windows
from geodelreg.judge.verdict import Evidence
from geodelreg.pair import Pair, bands_asked
from geodelreg.values.points import Status, TiePoints
from geodelreg.values.raster import BoolArray, FloatArray
from geodelreg.values.remedies import ROTATES
from geodelreg.values.result import BandMap

_LOCAL_SIGNIFICANCE = 3.0
_MEDIAN_VARIANCE = 1.57  # π / 2: of a median over that of a mean
BANDS_TOLD_PX = 0.5  # of PAN: half of what refuses
_MOSTLY = 0.9  # by hand, untried
_METRES_PER_KM = 1000.0  # by definition
_BLOCKS = 4
_LEAST_PER_BLOCK = 4


def warnings_of(
    pair: Pair, model: str, points: TiePoints, *, without_bright: bool = False, matched: bool = True
) -> tuple[str, ...]:
    """What a user should be warned of, in plain words.

    Parameters
    ----------
    pair : Pair
    model : str
        Of the correction.
    points : TiePoints
        With residuals under the correction.
    without_bright : bool
        Bright objects were left out, because they move differently.
    matched : bool
        False of points that were given: nothing is said of how the images were matched.
    """
    notes = list(_doubts_of_match(pair)) if matched else []
    notes += _doubts_of_place(pair, points)
    if pair.header.operation.warning:
        notes.append(pair.header.operation.warning)
    names, asked = pair.source.band_names, bands_asked(pair.source, pair.options)
    if matched and len(asked) < len(names) and not pair.options.band:
        notes.append(f"{len(asked)} of {len(names)} bands of MS, evenly spread, were looked at")
    notes += _unasked_bands(pair) if matched else ()
    left_out = [names[number - 1] for number in asked if number not in pair.source_bands]
    if matched and left_out:
        notes.append(f"{', '.join(left_out)} of MS showed too little to be matched on")
    if without_bright:
        notes.append("bright objects (clouds?) move differently from the ground and were left out")
    if model in ("similarity", "affine"):
        notes.append(ROTATES)
    local = local_distortion(points)
    if local > LOCAL_RMS_PX:
        notes.append(
            f"one affine is not enough: {local:.2g} PAN px RMS of smooth distortion is left "
            "(terrain, or bands that do not agree); a local warp would be needed"
        )
    notes += filter(None, [unmatched_part(points, pair.source.grid.shape)])
    if many_elsewhere(points):
        share, distance = elsewhere(points)
        notes.append(
            f"{share:.0%} of the patches that matched lie elsewhere, {distance:.2g} PAN px off in "
            "the median (terrain, clouds, or changes): the correction and its standard error are "
            "those of the others; over terrain a local warp would be needed"
        )
    return tuple(notes)


def _doubts_of_match(pair: Pair) -> Iterator[str]:
    """What looks as if something else had been meant: questions, for the answer may be yes."""
    source, reference = pair.source, pair.reference
    ours, theirs = len(source.band_names), len(reference.band_names)
    swapped = not pair.source_is_coarser and ours == 1 < theirs and not pair.options.band
    if not pair.source_is_coarser:
        yield (
            f"MS pixels ({pair.source_gsd_m[0]:.4g} m) are finer than the reference's "
            f"({pair.reference_gsd_m[0]:.4g} m): matched at the reference's resolution"
        )
    if swapped:
        yield (
            f"MS has one band and PAN {theirs}, of larger pixels: are the two swapped? MS, which "
            "is corrected, comes first"
        )
    elif theirs > 1 and pair.options.pan_band == 1:
        yield first_of_many(pair)


def _unasked_bands(pair: Pair) -> Iterator[str]:
    """That bands get a correction that was found without them, where that was asked for."""
    band, asked = pair.options.band, sorted(set(pair.options.agreeing_bands))
    knob, told = "band", f"band {band} of MS was matched on"
    if asked:
        knob = "agreeing_bands"
        told = f"bands {', '.join(map(str, asked))} of MS were asked whether they agree"
    others = len(pair.source.band_names) - (1 if band else len(asked))
    if (band or asked) and others:
        yield (
            f"only {told}; the correction moves {others} more, which may lie elsewhere (without "
            f"`{knob}` all are asked)"
        )


def first_of_many(pair: Pair) -> str:
    """The question whether the first band of PAN is the one that was meant."""
    names = pair.reference.band_names
    return (
        f"PAN has {len(names)} bands, and the first ({names[0]}) was matched on: is it the right "
        "one? `pan_band=N` takes another, `pan_band=0` the one most like the others"
    )


def _doubts_of_place(pair: Pair, points: TiePoints) -> Iterator[str]:
    """Whether the headers are of the same world."""
    source, reference, kept = pair.source, pair.reference, points.kept
    if kept.any() and overlap_windows(source.grid, reference.grid, 0.0) is None:
        moves = pair.header.forward(points.source_px[kept]) - points.reference_px[kept]
        far_km = float(np.median(np.hypot(*(moves * pair.reference_gsd_m).T))) / _METRES_PER_KM
        yield (
            f"the headers put MS {far_km:.3g} km away from PAN, where the two do not overlap: is "
            "the CRS of MS, its UTM zone for instance, the right one?"
        )


def unmatched_part(points: TiePoints, shape: tuple[int, int]) -> str:
    """Which side of a raster of so many rows and columns shows something that matches nothing.

    Empty where no such patches lie together: what matches here and there is usual.
    """
    missing = np.isin(points.status, (Status.CONVERGENCE, Status.CORRELATION))
    asked = missing | points.kept | np.isin(points.status, ELSEWHERE)
    count, every = int(missing.sum()), int(asked.sum())
    if count < LEAST_PATCHES or not LEAST_SHARE <= count / every < _MOSTLY:
        return ""
    where = region(points.source_px[asked], missing[asked], shape[::-1])
    if not where.startswith("the "):
        return ""
    return (
        f"{count} of {every} patches that show something match nothing near where the others say: "
        f"{where} of them, which clouds or changes may hide, or which may lie elsewhere"
    )


def unheard_bands(pair: Pair, bands: Sequence[BandMap]) -> tuple[str, ...]:
    """Which bands show too little by themselves, and what becomes of them."""
    heard = {band.number for band in bands}
    names = [name for n, name in enumerate(pair.source.band_names, 1) if n not in heard]
    if not names:
        return ()
    return (f"too little tells where {', '.join(names)} of MS lies: the common map holds there",)


def local_distortion(points: TiePoints) -> float:
    """RMS of what is left over smoothly, in PAN pixels; 0 when it is within the noise.

    Residuals are averaged over blocks; their variance beyond that of the noise is distortion.
    Of the tie points that agree; NaN when they are too few to tell.
    """
    kept = points.kept
    if kept.sum() < _BLOCKS**2 * _LEAST_PER_BLOCK:
        return float("nan")
    block = spatial_blocks(points.source_px[kept], _BLOCKS)
    residual = points.residual_px[kept]
    means, noise = [], []
    for number in np.unique(block):
        members: FloatArray = residual[block == number]
        if len(members) >= _LEAST_PER_BLOCK:
            means.append(np.median(members, axis=0))
            noise.append(_MEDIAN_VARIANCE * members.var(axis=0, ddof=1) / len(members))
    if len(means) < _BLOCKS:
        return float("nan")
    excess = np.mean(np.square(means), axis=0) - np.mean(noise, axis=0)
    doubt = _LOCAL_SIGNIFICANCE * np.mean(noise, axis=0) * np.sqrt(2 / len(means))
    return float(np.sqrt(np.where(excess > doubt, excess, 0.0).sum()))


def bands_warning(evidence: Evidence, per_band: bool) -> tuple[str, ...]:
    """What to say of MS bands that lie apart; nothing of bands that agree."""
    if not evidence.bands > BANDS_TOLD_PX:
        return ()
    note = (
        f"MS bands do not agree: {evidence.bands_words} (by {evidence.bands:.2g} PAN px at least); "
    )
    if per_band:
        return (note + "`per_band=True` finds a place for each",)
    remedy = "`per_band=True` corrects each by itself, `band=N` matches on one"
    return (f"{note}the correction is not right for both: {remedy}",)


def region(xy: FloatArray, member: BoolArray, size: tuple[float, float]) -> str:
    """Where some of the patches lie, in words: "the lower 45 %", "the right 20 %", "a part at …".

    Parameters
    ----------
    xy : (N, 2) float64
        All patches.
    member : (N,) bool
    size : (float, float)
        Width and height of the raster, in the same pixels.
    """
    share = f"{member.mean():.0%}".replace("%", " %")
    if not member.any():
        return "nowhere"
    best, name = 0.0, ""
    for axis, names in ((0, ("left", "right")), (1, ("upper", "lower"))):
        order = np.argsort(xy[:, axis], kind="stable")
        for ends, word in zip((order, order[::-1]), names, strict=True):
            inside = member[ends[: int(member.sum())]].mean()
            if inside > best:
                best, name = float(inside), word
    if best >= _MOSTLY:
        return f"the {name} {share}"
    x, y = xy[member].mean(axis=0) / size
    across = ("left", "middle", "right")[min(int(3 * x), 2)]
    down = ("upper", "middle", "lower")[min(int(3 * y), 2)]
    where = "middle" if across == down == "middle" else f"{down} {across}".replace("middle ", "")
    return f"{share} in the {where}"


def followed_part(points: TiePoints, pair: Pair, move_px: FloatArray) -> str:
    """Which part a correction follows, and where that lies by others, (2,) PAN pixels off."""
    if not points.kept.any() or not move_px.any():
        return ""
    where = region(points.source_px, points.kept, pair.source.grid.shape[::-1])
    return (
        f"{where}, which this follows, {lies(move_px, 'it')}, as clouds do, or a part that is "
        "displaced"
    )


def _short(size: float) -> str:
    """Two digits, or all before the point."""
    return f"{size:.{max(2, len(str(int(size))))}g}"


def lies(move_px: FloatArray, rest: str = "the rest") -> str:
    """Where a part lies that is (2,) PAN pixels right and down of the rest, in words."""
    right, down = (float(v) for v in move_px)
    across = f"{_short(abs(right))} px {'right' if right >= 0 else 'left'}"
    along = f"{_short(abs(down))} px {'down' if down >= 0 else 'up'}"
    return f"lies {across} and {along} of {rest}"
