"""The whole method: guesses → tie points → map → verdict.  It opens no file and prints nothing."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from threading import Thread
from typing import NamedTuple

import numpy as np

from geodelreg.coarse.guesses import guesses
from geodelreg.coarse.header import ProvenGuess
from geodelreg.coarse.scopes import scopes
from geodelreg.errors import NoOverlapError
from geodelreg.fine.layers import Claim, on_the_mesh
from geodelreg.fine.least_squares import Matched
from geodelreg.fine.matching import patches_log_nfa, tie_points
from geodelreg.fine.motions import LEAST_SHARE
from geodelreg.fine.passes import Refinement, refine, refine_proven
from geodelreg.fit.choice import Fitted, half_disagreement, select_for
from geodelreg.fit.estimate import student_weight
from geodelreg.fit.field import facets_of, form_of, halves_apart, selection_of
from geodelreg.fit.models import Frame, points_that_fix
from geodelreg.geo.maps.affine import IDENTITY
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.tin import TinMap
from geodelreg.judge.evidence import gather
from geodelreg.judge.verdict import (
    clouds_in_the_way,
    judge,
    moves_pair,
    nothing_agrees,
    passes,
    too_few_for_a_field,
    verdict,
)
from geodelreg.judge.whole import Whole, look_at_whole
from geodelreg.judge.words import bands_warning, unheard_bands, warnings_of
from geodelreg.options import BEYOND_A_HEADER, FOLLOWING, AlignOptions
from geodelreg.pair import Pair, Progress, make_pair, overlap_corners, roles
from geodelreg.values.points import NO_TIE_POINTS, Guess, Status, TiePoints
from geodelreg.values.raster import StatusArray, WindowReader
from geodelreg.values.result import Accuracy, BandMap, Solution
from geodelreg.values.timings import Timings

logger = logging.getLogger(__name__)

_FEWEST_POINTS = 4
_BENT_TRIES = 2  # of the guesses that one affine could not make good
_OPENED, _FOUND = 0.02, 0.4  # of the progress bar: a guess at how the time divides
_PARTS = 16  # of it, for the judging of all guesses together


class Found(NamedTuple):
    """What a guess led to: patches around a fitted map."""

    guess: Guess
    refined: Refinement
    fitted: Fitted


class _Refused(NamedTuple):
    """A guess that one affine could not make good."""

    solution: Solution
    pair: Pair
    found: Found
    heard: Sequence[Claim]

    @property
    def passed(self) -> int:
        return sum(reason.passed for reason in self.solution.verdict.reasons)


def align_pair(
    source: WindowReader,
    reference: WindowReader,
    options: AlignOptions,
    progress: Progress | None = None,
    timings: Timings | None = None,
) -> tuple[Pair, Solution]:
    """Find the correction of the source's header, with its evidence.

    Guesses come from the header's place where that leaves no doubt, from keypoints, coarse first,
    then from edges around the header; each is refined and judged, and the first that the evidence
    supports is taken.

    Parameters
    ----------
    source, reference : WindowReader
        MS and PAN.
    options : AlignOptions
    progress : callable, optional
        Called with a fraction 0 to 1 and the name of the step.
    timings : Timings, optional
        The steps add their seconds to it.

    Returns
    -------
    pair : Pair
    solution : Solution
        Its verdict may be a refusal; then it is that of the guess that passed most of the gate.

    Raises
    ------
    NoOverlapError
        When headers and contents share no ground.
    NoDataError
        When a band has no texture where it matters.
    """
    report = progress or (lambda fraction, step: None)
    pair = make_pair(source, reference, options, timings)
    refused: list[_Refused] = []
    heard: list[Claim] = []
    looked = 0.0
    report(_OPENED, "reading")
    Thread(target=import_module, args=("numpy.random",)).start()  # the evidence draws samples
    for seen, guess in pair.timings.each("search", _guesses(pair)):
        report(_FOUND + looked / 4, "refining")
        logger.info("guess from %s: %s", guess.images.scope.name, _listed(guess.counts))
        if is_degenerate(guess):
            continue  # of headers that squeeze the ground to a line
        found = find(seen, guess)
        if found is not None:
            model, counts = found.fitted.selection.estimate.model, found.fitted.counts
            more = {step: counts[step] for step in counts if step not in guess.counts}
            logger.info("refined: %s, model %s", _listed(more), model)
            report(_FOUND + (1 + 3 * looked) / _PARTS, "judging")
            solution = conclude(seen, found, heard)
            for reason in solution.verdict.reasons:
                if not reason.passed:
                    logger.info("not believed: %s", reason.message)
            if solution.verdict.accepted:
                report(1.0, "done")
                return seen, solution
            if not isinstance(guess, ProvenGuess):  # keypoints will have the last word
                refused.append(_Refused(solution, seen, found, tuple(heard)))
        heard.append(Claim(guess.map, guess.log_nfa))
        looked = (1.0 + looked) / 2
    refused.sort(key=lambda one: one.passed, reverse=True)
    if pair.may_bend:
        for one in [one for one in refused if one.solution.model not in FOLLOWING][:_BENT_TRIES]:
            solution = conclude(one.pair, one.found, one.heard, bent=True)
            if solution.verdict.accepted:
                report(1.0, "done")
                return one.pair, solution
    report(1.0, "refused")
    return pair, refused[0].solution if refused else _nothing_found(pair)


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {step}" for step, count in counts.items())


def _guesses(pair: Pair) -> Iterator[tuple[Pair, Guess]]:
    """First guesses; the paper's methods make none, theirs are finished fits."""
    if pair.options.method == "delaunay":
        return guesses(pair)
    from geodelreg.paper.baseline import paper_fits

    return paper_fits(pair)


def find(pair: Pair, guess: Guess) -> Found | None:
    """Tie points and a map from one guess, by the method asked for; None of too few matches."""
    if pair.options.method == "delaunay":
        return find_by_patches(pair, guess)
    from geodelreg.paper.baseline import PaperFit, with_patches

    assert isinstance(guess, PaperFit)
    found = with_patches(pair, guess)
    return None if found is None else Found(*found)


def find_by_patches(pair: Pair, guess: Guess) -> Found | None:
    """Patches that agree, without those that the mesh finds out, and the map they choose."""
    with pair.timings("refine"):
        if isinstance(guess, ProvenGuess):
            refined = refine_proven(roles(pair), guess.images, guess.tuning, guess.proof)
        else:
            refined = refine(roles(pair), guess)
    if refined is None:
        return None
    if not refined.last.is_calm:
        Thread(target=_load_scipy).start()
    with pair.timings("fit"):
        fitted = fit_patches(pair, guess, refined, on_the_mesh(refined.last))
    return None if fitted is None else Found(guess, refined, fitted)


def fit_patches(
    pair: Pair, guess: Guess, refined: Refinement, status: StatusArray
) -> Fitted | None:
    """The map that the kept patches choose; None of too few."""
    part, last = refined.part, refined.last
    kept = np.flatnonzero(status == Status.KEPT)
    points = last.points.take(kept)
    if len(points) < _FEWEST_POINTS:
        return None
    selection = select_for(pair, points)
    estimate = selection.estimate
    status[kept[~estimate.inlier]] = Status.RESIDUAL
    weight = np.full(len(status), np.nan)
    weight[kept] = student_weight(estimate.distance2)
    tied = tie_points(part, last.matched, estimate.map, status, weight)
    halves = points.take(estimate.inlier)
    apart = half_disagreement(halves, estimate, overlap_corners(part, estimate.map))
    return Fitted(
        selection,
        tied,
        guess.counts | _patch_counts(last.matched, tied),
        patches_log_nfa(part, tied, points_that_fix(estimate.model)),
        pair.pan_px_per_source_px * apart,
    )


def _patch_counts(matched: Matched, tied: TiePoints) -> dict[str, int]:
    return {
        "patches": len(tied),
        "patches matched": int((matched.status == Status.KEPT).sum()),
        "patches kept": int(tied.kept.sum()),
    }


def conclude(pair: Pair, found: Found, heard: Sequence[Claim], bent: bool = False) -> Solution:
    """Gather the evidence for a map, judge it, and say all that is known.

    Parameters
    ----------
    pair : Pair
    found : Found
    heard : sequence of Claim
        Of guesses that were refused before.
    bent : bool
        One affine was refused: judge a field.
    """
    guess, refined, fitted = found
    options = pair.options
    notes: tuple[str, ...] = ()
    clouds = 0.0
    with pair.timings("evidence"):
        # what will be followed is judged once, when it has been
        seen = see_whole(pair, found) if pair.may_bend else None
        follows = seen is not None and seen.must_follow(pair, bent)
        if not follows:
            accuracy, evidence = gather(guess, refined, fitted, heard)
        if follows or bent or passes(judge(evidence, options)):
            whole, everyone, closer = seen or see_whole(pair, found)
            clouds = whole.clouds
            if everyone is not None and not follows:
                again = gather(guess, refined, everyone, heard)
                if passes(judge(again[1], options)):
                    fitted, (accuracy, evidence), whole = everyone, again, closer
            follows = follows or (may_follow(pair, whole) and whole.is_bent(options))
            if follows:
                refined, fitted = follow(pair, Found(guess, refined, fitted), whole)
                accuracy, evidence = gather(guess, refined, fitted, heard)
                whole = whole.followed(pair, fitted)
            else:
                whole = whole.at_best(pair)
            accuracy, evidence = whole.added_to(accuracy, evidence)
            notes = whole.warnings(options)
        notes += bands_warning(evidence)
    model, reasons = fitted.selection.estimate.model, judge(evidence, options)
    bands: tuple[BandMap, ...] = ()
    if options.per_band and passes(reasons):
        from geodelreg.fine.per_band import match_each_band

        with pair.timings("bands"):
            if refined.part.ms_is_template:
                bands = match_each_band(refined, fitted.map, model, options.band_model)
        notes += unheard_bands(pair, bands)
    moves = any(moves_pair(pair, one) for one in (fitted.map, *(band.map for band in bands)))
    if options.model in FOLLOWING and model != options.model and passes(reasons):
        in_the_way = clouds > LEAST_SHARE
        why = clouds_in_the_way(clouds) if in_the_way else too_few_for_a_field(accuracy.kept)
        reasons = (*reasons, why)
    names = [pair.source.band_names[band - 1] for band in pair.source_bands]
    return Solution(
        model=model,
        map=fitted.map,
        tie_points=fitted.points,
        accuracy=accuracy,
        verdict=verdict(reasons, moves),
        step_counts=fitted.counts,
        band_weights=dict(zip(names, map(float, refined.tuning.tone.weights), strict=True)),
        warnings=warnings_of(pair, model, fitted.points, without_bright=refined.without_bright)
        + notes,
        search=guess.search,
        bands=bands,
        form=None if fitted.points.weight is None else form_of(fitted.selection.estimate),
    )


class Seen(NamedTuple):
    """What all patches say about a map.

    Attributes
    ----------
    whole : Whole
    everyone : Fitted or None
        The fit to all of the ground, where it is bent; None where those that agree spoke for it.
    closer : Whole
        Under that.
    """

    whole: Whole
    everyone: Fitted | None
    closer: Whole

    def must_follow(self, pair: Pair, bent: bool) -> bool:
        """True when no affine will do, or none was asked for."""
        options = pair.options
        asked = bent or options.model in FOLLOWING or self.closer.is_bent(options)
        return asked and may_follow(pair, self.whole)


def see_whole(pair: Pair, found: Found) -> Seen:
    """Ask all patches about a map, and where they say that it bends, fit one to them."""
    whole = look_at_whole(found.guess, found.refined, found.fitted.map)
    everyone = hear_everyone(pair, found, whole)
    return Seen(whole, everyone, whole if everyone is None else whole.under(pair, everyone.map))


def hear_everyone(pair: Pair, found: Found, whole: Whole) -> Fitted | None:
    """The fit to all of the ground, where it is bent; None where those that agree spoke for it."""
    asked = pair.options
    if not whole.is_bent(asked) or asked.method != "delaunay" or asked.model in BEYOND_A_HEADER:
        return None
    status = whole.status(found.refined.last.status)
    return fit_patches(pair, found.guess, found.refined, status)


def may_follow(pair: Pair, whole: Whole) -> bool:
    """True when a field may be written, and clouds leave it enough of the ground."""
    return pair.may_bend and whole.clouds <= LEAST_SHARE


def follow(pair: Pair, found: Found, whole: Whole) -> tuple[Refinement, Fitted]:
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
        unseen[tied.kept] = pair.pan_px_per_source_px * selection.check.residual_px
        log_nfa = patches_log_nfa(
            refined.part, replace(tied, residual_px=unseen), points_that_fix("field")
        )
    counts = guess.counts | _patch_counts(settled.matched, tied)
    return refined, Fitted(selection, tied, counts, log_nfa, apart_px)


def _load_scipy() -> None:
    """Load what a look at the whole raster will need, half hidden behind the evidence."""
    for name in ("scipy.spatial", "scipy.optimize", "scipy.special", "scipy.sparse.csgraph"):
        import_module(name)


def is_degenerate(guess: Guess) -> bool:
    """True when a guess squeezes the ground to a line."""
    affine = guess.map.as_affine()
    return affine is not None and affine.is_degenerate


def _nothing_found(pair: Pair) -> Solution:
    """The refusal when not even a guess could be refined.

    Raises
    ------
    NoOverlapError
        When the headers do not overlap either.
    """
    if next(scopes(pair)).is_whole:
        raise NoOverlapError(
            f"{pair.source.name} and {pair.reference.name} do not overlap by their headers, and "
            "their contents do not match",
            "Check that both show the same ground and that CRSs and geotransforms are right.",
        )
    none = verdict((nothing_agrees(),), moves=False)
    return Solution("none", IDENTITY, NO_TIE_POINTS, Accuracy(), none, {"tie points": 0})
