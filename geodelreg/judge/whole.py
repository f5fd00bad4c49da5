"""Whether a correction speaks for the whole raster, or only for the patches that agree with it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from geodelreg.fine.clouds import OUTSHINING, HeightParallax, height_parallax
from geodelreg.fine.layers import CALM_PATCHES, MATCHED
from geodelreg.fine.least_squares import MAX_MOVE, Matched, MatchOptions
from geodelreg.fine.matching import match_tiles, observe
from geodelreg.fine.motions import largest_layer
from geodelreg.fine.passes import Refinement, bends_gently
from geodelreg.fine.survey import survey
from geodelreg.fine.tone import single_band
from geodelreg.fit.choice import Fitted
from geodelreg.fit.consensus import fit_plainly
from geodelreg.fit.estimate import Observations
from geodelreg.fit.field import FEWEST_POINTS, determine_field, fit_field, spacing
from geodelreg.fit.residual import Residual, residual_of, shared_by_neighbours
from geodelreg.geo.affine import affine_matrix, apply_affine
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.tin import TinMap
from geodelreg.judge.elsewhere import (
    FEW_PATCHES,
    SURVEY_SIGMA_PX,
    another_motion,
    far_motion,
    ground_of,
    overlaid,
    placed,
    small_motion,
    unit_of,
)  # fmt: skip
from geodelreg.judge.verdict import Evidence
from geodelreg.options import AlignOptions
from geodelreg.pair import Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess, Status
from geodelreg.values.raster import BoolArray, FloatArray, StatusArray
from geodelreg.values.result import Accuracy

_CALM_SHARE = 0.98
"""Of the textured patches that agree, from which no part that matters can lie elsewhere."""
_CALM_RESIDUAL = 0.3
"""Of the largest residual allowed: what neighbours may share where no field need be fitted."""
_MOST_POINTS = 1000  # by hand: ½ to 2 × alike
_PLACES = 200  # by hand: ½ to 2 × alike
_STRAIN_PLACES = 33  # along either axis of the raster
_VISIBLE = 3  # bands, as they are usually ordered


@dataclass(frozen=True, slots=True, eq=False)
class Whole:
    """What all patches say about a correction, and not only those that agree.

    Attributes
    ----------
    residual : Residual
        What the correction leaves of the ground's smooth map, PAN pixels.
    ground : (P,) bool
        Patches of the last pass that are the ground's.
    moved : float
        Share of the textured patches that agree on another motion than the ground's.
    words : str
        Where they lie; empty where there are none.
    clouds : float
        Share of the patches that move and that clouds explain.
    field : FieldMap or None
        The ground's smooth map, where the patches did not all agree.
    strain : float
        Largest of the field, where that is what is written; else 0.
    """

    residual: Residual
    ground: BoolArray
    moved: float = 0.0
    words: str = ""
    clouds: float = 0.0
    field: FieldMap | None = None
    strain: float = 0.0

    def is_bent(self, options: AlignOptions) -> bool:
        """True when those that agree leave more of the ground's bend than is allowed."""
        known = self.field is not None and not self.moved
        return known and self.residual.low_px > options.max_residual_px

    def at_best(self, pair: Pair) -> Whole:
        """The same of the affine that leaves least of the whole, where that is too much as well.

        Those that agree may be a part whose map fits the rest badly; what is refused then is bent
        ground and not that map.
        """
        if not self.is_bent(pair.options) or pair.options.on_local != "refuse":
            return self
        assert self.field is not None
        at = _sample(self.field)
        best = self.under(pair, fit_plainly(at, self.field.forward(at), "affine"))
        return best if best.is_bent(pair.options) else self

    def status(self, last: StatusArray) -> StatusArray:
        """Status of the patches of the last pass when all of the ground is heard."""
        heard = np.where(self.ground, Status.KEPT, last).astype(np.uint8)
        heard[~self.ground & (last == Status.KEPT)] = Status.CONSENSUS
        return heard

    def added_to(self, accuracy: Accuracy, evidence: Evidence) -> tuple[Accuracy, Evidence]:
        """Both with what is known of the whole."""
        left = self.residual
        low_px = 0.0 if np.isnan(left.low_px) else left.low_px
        accuracy = replace(
            accuracy,
            residual_rms_px=left.rms_px,
            residual_p95_px=left.p95_px,
            residual_interval_px=(left.low_px, left.high_px),
        )
        return accuracy, replace(
            evidence,
            residual_low_px=low_px,
            moved=self.moved,
            words=self.words,
            strain=self.strain,
        )

    def warnings(self, options: AlignOptions) -> tuple[str, ...]:
        """What a user should be warned of that only all patches together show."""
        notes: list[str] = []
        left, most = self.residual, options.max_residual_px
        follower = "the field" if self.strain else "one affine"
        if max(left.rms_px, left.high_px) > most:
            notes.append(
                f"{left.rms_px:.2g} PAN px RMS of the ground's bend are left (95 %: "
                f"{left.low_px:.2g} to {left.high_px:.2g}), the limit is {most:g}: relief, a "
                f"moving sensor or dropped rows, which {follower} does not follow"
            )
        if self.strain and self.field is not None and self.field.jumps:
            rows = " and ".join(f"{row:.0f}" for row in self.field.jumps)
            notes.append(f"MS jumps at row {rows}: the field is cut there")
        if self.clouds:
            notes.append(f"{self.clouds:.0%} of the patches move and look like clouds: left out")
        return tuple(notes)

    def followed(self, pair: Pair, fitted: Fitted) -> Whole:
        """The same of a field, which leaves what neighbouring patches still share."""
        points, field = fitted.points, fitted.map
        if not isinstance(field, FieldMap | TinMap):
            return self
        near = shared_by_neighbours(points.source_px[points.kept], points.residual_px[points.kept])
        strain = largest_strain(pair, field)
        known = field if isinstance(field, FieldMap) else None
        return replace(self, residual=near, field=known, strain=strain)

    def under(self, pair: Pair, correction: PixelMap) -> Whole:
        """The same of another correction."""
        assert self.field is not None
        return replace(self, residual=_left(pair, self.field, correction))


def largest_strain(pair: Pair, field: FieldMap | TinMap) -> float:
    """Of what follows a bend, where it may bend most and over MS; infinite where it folds."""
    places = np.concatenate([field.places, pair.source_lattice(_STRAIN_PLACES)])
    strain, growth = field.strain_at(places)
    return float(strain.max()) if (growth > 0).all() else math.inf


def look_at_whole(guess: Guess, refined: Refinement, correction: PixelMap) -> Whole:
    """Ask all patches, near and far, unless nearly all agree and neighbours share no residual.

    Bright objects that were left out are asked too: not all that is bright is cloud.

    Parameters
    ----------
    guess : Guess
    refined : Refinement
    correction : PixelMap
        MS pixels to MS header pixels.
    """
    pair, last = refined.part.pair, refined.last
    kept = last.status == Status.KEPT
    some = last.points.take(kept)
    gap = (correction.forward(some.source) - some.target) @ _in_pan(pair).T
    near = shared_by_neighbours(some.source, gap)
    textured = int((last.status != Status.TEXTURE).sum())
    calm = near.high_px <= _CALM_RESIDUAL * pair.options.max_residual_px
    calm &= not refined.dark_only and kept.sum() >= _CALM_SHARE * textured
    agreed = Whole(near, np.asarray(kept))
    if not calm:
        return _surveyed(guess, refined, correction, agreed)
    if textured >= FEW_PATCHES:
        return agreed
    # few patches leave out a border as wide as a small part
    moved = small_motion(refined, *overlaid(guess, refined, correction))
    return replace(agreed, moved=moved.share, words=moved.words)


def _surveyed(guess: Guess, refined: Refinement, correction: PixelMap, agreed: Whole) -> Whole:
    """Where every patch lies: the ground's, another motion's, or a cloud's."""
    part = refined.part
    images, to_full = overlaid(guess, refined, correction)
    places = survey(images)
    index = np.flatnonzero(placed(places))
    if len(index) < FEWEST_POINTS:
        return _bent(refined, correction, agreed)[0]
    at, move = places.centre[index], places.move[index]
    ground = ground_of(places, index)
    unseen = refined.dark_only | (np.hypot(*move.T) * unit_of(to_full) > MAX_MOVE * part.step)
    far = ground.member & unseen
    linear = affine_matrix(to_full)[:, :2] * SURVEY_SIGMA_PX
    there = part.to_surface(correction)
    position, covariance = there.carry(
        apply_affine(to_full, (at + move)[far]), np.tile(linear @ linear.T, (int(far.sum()), 1, 1))
    )
    none = np.zeros(len(position))
    seen = Matched(
        apply_affine(to_full, at[far]), position, covariance, none, none.astype(np.uint8)
    )
    whole, gentle = _bent(refined, correction, agreed, observe(part, seen, correction))
    moved = another_motion(refined, places, index, ground, to_full)
    # what a smooth field explains is no cloud, however bright and high above the ground
    if ground.look.explains and not (gentle or moved.is_torn or ground.is_torn):
        return replace(agreed, clouds=ground.moving)
    if not moved.share and len(places.centre) < FEW_PATCHES:
        moved = small_motion(refined, images, to_full)
    if not moved.share and ground.look.outshining < OUTSHINING:
        moved = far_motion(refined, images, places, to_full)
    if moved.share or (whole.is_bent(part.pair.options) and not gentle):
        height = _height(refined, correction)
        if height is not None and height.explains:
            return replace(agreed, clouds=height.share)
    return replace(whole, moved=moved.share, words=moved.words)


def _height(refined: Refinement, correction: PixelMap) -> HeightParallax | None:
    """Whether two visible bands contradict each other where patches move; None of one band."""
    part, last = refined.part, refined.last
    count = len(part.pair.source_bands)
    if count < 2:
        return None
    options = MatchOptions(size=refined.size)

    def alone(band: int) -> tuple[FloatArray, Observations]:
        tuning = replace(refined.tuning, tone=single_band(count, band), local_tone=False)
        matched = match_tiles(part, refined.tiles, correction, tuning, options)
        points = observe(part, matched, correction)
        return _moves(matched.status, points, correction), points

    (one, first), (other, second) = alone(0), alone(min(count, _VISIBLE) - 1)
    move, difference = _moves(last.status, last.points, correction), one - other
    known = np.isfinite(difference).all(axis=1)
    if not known.any():
        return None
    difference -= np.median(difference[known], axis=0)
    variance = (first.variances + second.variances).sum(axis=1)
    return height_parallax(move, difference, np.sqrt(variance))


def _moves(status: StatusArray, points: Observations, correction: PixelMap) -> FloatArray:
    """(P, 2) of patches that matched, MS pixels; NaN of the others."""
    matched = np.isin(status, MATCHED)
    matched &= np.isfinite(points.covariance).all(axis=(1, 2))
    return np.where(matched[:, None], points.target - correction.forward(points.source), np.nan)


def _bent(
    refined: Refinement, correction: PixelMap, agreed: Whole, far: Observations | None = None
) -> tuple[Whole, bool]:
    """The ground's smooth map through patches of the last pass, and those out of its reach.

    And whether nearly all of them agree on it, and it bends gently.
    """
    pair, last = refined.part.pair, refined.last
    matched = np.flatnonzero(np.isin(last.status, MATCHED))
    points = last.points.take(matched)
    if far is not None:
        points = Observations(
            np.concatenate([points.source, far.source]),
            np.concatenate([points.target, far.target]),
            np.concatenate([points.covariance, far.covariance]),
        )
    member = largest_layer(points, correction)
    some = np.flatnonzero(member)[:: 1 + int(member.sum()) // _MOST_POINTS]
    ground_points = points.take(some)
    if not determine_field(ground_points):
        return agreed, False
    fit = fit_field(ground_points, refined.bend)
    agree = float(member.mean()) * fit.inlier.mean() > CALM_PATCHES
    gentle = agree and bends_gently(fit, spacing(ground_points))
    ground = np.zeros(len(last.status), dtype=np.bool_)
    ground[matched] = member[: len(matched)]
    whole = Whole(_left(pair, fit.field, correction), ground, field=fit.field)
    return whole, refined.bend is not None or gentle


def _left(pair: Pair, field: FieldMap, correction: PixelMap) -> Residual:
    return residual_of(field, correction, _sample(field), _in_pan(pair))


def _sample(field: FieldMap) -> FloatArray:
    """(N, 2) some 200 places in sight."""
    return field.source[:: 1 + len(field.source) // _PLACES]


def _in_pan(pair: Pair) -> FloatArray:
    """(2, 2) MS header pixels to PAN pixels."""
    return np.asarray(pair.header.linearise(pair.source_centre)[0, :, :2])
