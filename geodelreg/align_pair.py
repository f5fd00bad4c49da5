"""The whole method: guesses → tie points → map → verdict.  It opens no file and prints nothing."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from threading import Thread
from typing import NamedTuple

import numpy as np

from geodelreg.coarse.guesses import guesses
from geodelreg.coarse.header import ProvenGuess
from geodelreg.coarse.scopes import scopes
from geodelreg.errors import NoOverlapError
from geodelreg.fine.fitted import Found, fit_patches
from geodelreg.fine.ground import ANOTHER_PX
from geodelreg.fine.layers import Claim, on_the_mesh
from geodelreg.fine.passes import refine, refine_proven
from geodelreg.fit.field import form_of
from geodelreg.geo.maps.affine import IDENTITY
from geodelreg.judge.bending import carry
from geodelreg.judge.verdict import (
    OF_THE_WHOLE,
    judge,
    moves_pair,
    nothing_agrees,
    passes,
    verdict,
)
from geodelreg.judge.words import bands_warning, unheard_bands, warnings_of
from geodelreg.options import FOLLOWING, AlignOptions
from geodelreg.pair import Pair, Progress, make_pair, roles
from geodelreg.values.points import NO_TIE_POINTS, Guess
from geodelreg.values.raster import WindowReader
from geodelreg.values.result import Accuracy, BandMap, Solution
from geodelreg.values.timings import Timings

logger = logging.getLogger(__name__)

_BENT_TRIES = 2  # of the guesses that one affine could not make good
_OPENED, _FOUND = 0.02, 0.4  # of the progress bar: a guess at how the time divides
_PARTS = 16  # of it, for the judging of all guesses together


class _Refused(NamedTuple):
    """A guess that one affine could not make good."""

    solution: Solution
    pair: Pair
    found: Found
    heard: Sequence[Claim]

    @property
    def passed(self) -> int:
        return sum(reason.passed for reason in self.solution.verdict.reasons)

    def denies(self, other: Solution) -> bool:
        """True of a map of the same place, where all patches found the ground torn or bent.

        That they were asked once more, of images read otherwise, does not make it whole.
        """
        reasons = self.solution.verdict.reasons
        if other.model in FOLLOWING or any(
            not reason.passed and reason.name not in OF_THE_WHOLE for reason in reasons
        ):
            return False
        corners = self.pair.source_lattice(2)
        here, there = (self.pair.move_px(one.map, corners) for one in (self.solution, other))
        nearest_px = ANOTHER_PX * self.pair.pan_px_per_coarser_px
        return bool(np.hypot(*(here - there).T).max() <= nearest_px)


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
    proven: list[_Refused] = []
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
            tried = _Refused(solution, seen, found, tuple(heard))
            if solution.verdict.accepted:
                if not any(one.denies(solution) for one in (*refused, *proven)):
                    report(1.0, "done")
                    return seen, solution
            else:  # after what was proven keypoints have the last word
                (proven if isinstance(guess, ProvenGuess) else refused).append(tried)
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
    refused = refused or proven
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
    return with_patches(pair, guess)


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


def conclude(pair: Pair, found: Found, heard: Sequence[Claim], bent: bool = False) -> Solution:
    """Judge a map, or a better one for all of the ground, and say all that is known.

    Parameters
    ----------
    pair : Pair
    found : Found
    heard : sequence of Claim
        Of guesses that were refused before.
    bent : bool
        One affine was refused: judge a field.
    """
    options = pair.options
    with pair.timings("evidence"):
        carried = carry(pair, found, heard, bent)
        notes = (*carried.warnings(options), *bands_warning(carried.evidence, options.per_band))
    refined, fitted = carried.refined, carried.fitted
    model, reasons = fitted.selection.estimate.model, judge(carried.evidence, options)
    bands: tuple[BandMap, ...] = ()
    if options.per_band and passes(reasons):
        from geodelreg.fine.per_band import match_each_band

        with pair.timings("bands"):
            if refined.part.ms_is_template:
                bands = match_each_band(refined, fitted.map, model, options.band_model)
        notes += unheard_bands(pair, bands)
    moves = any(moves_pair(pair, one) for one in (fitted.map, *(band.map for band in bands)))
    if options.model in FOLLOWING and model != options.model and passes(reasons):
        reasons = (*reasons, carried.why_no_field())
    names = [pair.source.band_names[band - 1] for band in pair.source_bands]
    return Solution(
        model=model,
        map=fitted.map,
        tie_points=fitted.points,
        accuracy=carried.accuracy,
        verdict=verdict(reasons, moves),
        step_counts=fitted.counts,
        band_weights=dict(zip(names, map(float, refined.tuning.tone.weights), strict=True)),
        warnings=warnings_of(pair, model, fitted.points, without_bright=refined.without_bright)
        + notes,
        search=found.guess.search,
        bands=bands,
        form=None if fitted.points.weight is None else form_of(fitted.selection.estimate),
    )


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
