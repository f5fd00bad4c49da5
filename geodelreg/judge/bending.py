"""Which map carries all of the ground: that of the patches that agree, of all, or a field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from geodelreg.fine.fitted import Found, fit_patches, patch_counts
from geodelreg.fine.layers import Claim
from geodelreg.fine.matching import patches_log_nfa, tie_points
from geodelreg.fine.motions import LEAST_SHARE
from geodelreg.fine.passes import Refinement
from geodelreg.fit.choice import Fitted
from geodelreg.fit.field import facets_of, halves_apart, selection_of
from geodelreg.fit.models import Frame, points_that_fix
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.tin import TinMap
from geodelreg.judge.evidence import gather
from geodelreg.judge.verdict import Evidence, clouds_in_the_way, judge, passes, too_few_for_a_field
from geodelreg.judge.whole import Whole, look_at_whole
from geodelreg.options import BEYOND_A_HEADER, FOLLOWING, AlignOptions
from geodelreg.pair import Pair
from geodelreg.values.result import Accuracy, Reason


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """A map with its evidence, and what all patches say about it.

    Attributes
    ----------
    refined : Refinement
    fitted : Fitted
    accuracy : Accuracy
    evidence : Evidence
    whole : Whole or None
        None where the gate refuses what the agreeing patches say; then the rest is not asked.
    """

    refined: Refinement
    fitted: Fitted
    accuracy: Accuracy
    evidence: Evidence
    whole: Whole | None = None

    def known(self, whole: Whole) -> Carried:
        """The same with what all patches say."""
        accuracy, evidence = whole.added_to(self.accuracy, self.evidence)
        return replace(self, accuracy=accuracy, evidence=evidence, whole=whole)

    def warnings(self, options: AlignOptions) -> tuple[str, ...]:
        """What a user should be warned of that only all patches together show."""
        return () if self.whole is None else self.whole.warnings(options)

    def why_no_field(self) -> Reason:
        """The reason against a field that was asked for, and that the patches do not give."""
        clouds = 0.0 if self.whole is None else self.whole.clouds
        if clouds > LEAST_SHARE:
            return clouds_in_the_way(clouds)
        return too_few_for_a_field(self.accuracy.kept)


def carry(pair: Pair, found: Found, heard: Sequence[Claim], bent: bool = False) -> Carried:
    """The simplest map that the evidence supports and that leaves no bend of the ground.

    The first of these that will do:

    1. the map that was found, by the patches that agree;
    2. a map of the affine models, fitted to all of the ground, where that bends;
    3. a field through all of the ground, where it may be written.

    Where none will do it is the first, and the gate refuses it.

    Parameters
    ----------
    pair : Pair
    found : Found
    heard : sequence of Claim
        Of guesses that were refused before.
    bent : bool
        One affine was refused: only a field will do.
    """
    seen = _see_all(pair, found) if pair.may_bend else None
    if seen is not None:
        whole, _, closer = seen
        asked = bent or pair.options.model in FOLLOWING or closer.is_bent(pair.options)
        if asked and _may_follow(pair, whole):
            return _of_a_field(pair, found, whole, heard)  # which alone needs its evidence
    first = _judged(found, heard)
    if not bent and not _is_believed(first, pair):
        return first
    whole, everyone, closer = seen or _see_all(pair, found)
    if everyone is not None:
        second = _judged(found._replace(fitted=everyone), heard)
        if _is_believed(second, pair):
            return second.known(closer.at_best(pair))
        if _may_follow(pair, whole):
            return _of_a_field(pair, found, whole, heard)
    return first.known(whole.at_best(pair))


def _judged(found: Found, heard: Sequence[Claim]) -> Carried:
    guess, refined, fitted = found
    return Carried(refined, fitted, *gather(guess, refined, fitted, heard))


def _is_believed(carried: Carried, pair: Pair) -> bool:
    return passes(judge(carried.evidence, pair.options))


def _of_a_field(pair: Pair, found: Found, whole: Whole, heard: Sequence[Claim]) -> Carried:
    refined, fitted = _follow(pair, found, whole)
    judged = _judged(Found(found.guess, refined, fitted), heard)
    return judged.known(whole.followed(pair, fitted))


def _see_all(pair: Pair, found: Found) -> tuple[Whole, Fitted | None, Whole]:
    """What all patches say about a map; where it bends, a fit to all of them, and of that the same.

    There is no such fit where those that agree spoke for the ground.
    """
    asked, whole = pair.options, look_at_whole(found.guess, found.refined, found.fitted.map)
    if not whole.is_bent(asked) or asked.method != "delaunay" or asked.model in BEYOND_A_HEADER:
        return whole, None, whole
    status = whole.status(found.refined.last.status)
    everyone = fit_patches(pair, found.guess, found.refined, status)
    return whole, everyone, whole if everyone is None else whole.under(pair, everyone.map)


def _may_follow(pair: Pair, whole: Whole) -> bool:
    """True when a field may be written, and clouds leave it enough of the ground."""
    return pair.may_bend and whole.clouds <= LEAST_SHARE


def _follow(pair: Pair, found: Found, whole: Whole) -> tuple[Refinement, Fitted]:
    """The ground's smooth map, matched through itself until it stands still.

    Too few patches leave what was found.
    """
    from geodelreg.fine.settle import settle

    guess, refined, fitted = found
    with pair.timings("field"):
        settled = settle(refined, whole.field or fitted.map)
        if settled is None:
            return refined, fitted
        refined, fit = settled.refined, settled.fit
        field: FieldMap | TinMap = fit.field
        if pair.options.model == "tin":
            field = facets_of(field.source, field.target, field.noise_px2)
        tied = tie_points(refined.part, settled.matched, field, settled.status, settled.weight)
        selection = selection_of(field, fit.distance2[fit.inlier], Frame.of(pair))
        apart_px = pair.pan_px_per_source_px * halves_apart(field)
        # a field follows its points: those that it has not seen say what chance would do
        unseen = tied.residual_px.copy()
        unseen[tied.kept] = pair.pan_px_per_source_px * selection.held_out_px
        log_nfa = patches_log_nfa(
            refined.part, replace(tied, residual_px=unseen), points_that_fix("field")
        )
    counts = guess.counts | patch_counts(settled.matched, tied)
    return refined, Fitted(selection, tied, counts, log_nfa, apart_px)
