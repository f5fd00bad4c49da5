"""A pair that was refused is looked at in other ways: without what is drawn, as slopes."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

from geodelreg.align_pair import align_pair
from geodelreg.coarse.slopes import Slopes, as_slopes
from geodelreg.errors import NoDataError
from geodelreg.options import AlignOptions
from geodelreg.pair import Pair, Progress
from geodelreg.raster.reader import RasterReader
from geodelreg.values.raster import WindowReader
from geodelreg.values.result import Solution
from geodelreg.values.timings import Timings

logger = logging.getLogger(__name__)

_UNLIKE = frozenset(
    ("tie_points", "log_nfa", "log_chance", "log_together", "rival", "shading", "rival_motion",
     "support")
)  # fmt: skip
"""Reasons that refuse images which do not resemble each other."""
_WAYS = ("right", "lower right", "bottom", "lower left", "left", "upper left", "top", "upper right")


def align_rasters(
    ms: RasterReader,
    pan: RasterReader,
    options: AlignOptions,
    progress: Progress | None,
    timings: Timings,
) -> tuple[Pair, Solution]:
    """`geodelreg.align_pair.align_pair`, and once more in each other way that may explain it.

    Raises
    ------
    NoOverlapError, NoDataError
        As of the first way.
    """
    first = align_pair(ms, pan, options, progress, timings)
    if first[1].verdict.accepted:
        return first
    for reference, notes in _other_ways(ms, pan, first):
        logger.info("once more: %s", "; ".join(notes))
        with suppress(NoDataError):
            pair, solution = align_pair(ms, reference, options, None, timings)
            if solution.verdict.accepted:
                return pair, replace(solution, warnings=(*solution.warnings, *notes))
    return first


def _other_ways(
    ms: RasterReader, pan: RasterReader, first: tuple[Pair, Solution]
) -> Iterator[tuple[WindowReader, tuple[str, ...]]]:
    """What to take for PAN instead, and why."""
    pair, solution = first
    options = pair.options
    drawn: tuple[str, ...] = ()
    if options.ms_nodata is None and options.pan_nodata is None:
        notes = ms.leave_out_drawn(), pan.leave_out_drawn()
        drawn = tuple(filter(None, notes))  # edges of labels are no slopes of the ground, either
        if all(notes):
            yield pan, drawn
    failed = {reason.name for reason in solution.verdict.reasons if not reason.passed}
    if failed & _UNLIKE and options.method == "delaunay":
        slopes = as_slopes(pair)
        if slopes is not None:
            yield slopes, (*drawn, _words(slopes))


def _words(slopes: Slopes) -> str:
    if slopes.light is None:
        return "MS shows the edges of PAN and not its tones: it was compared with those"
    turn = math.atan2(slopes.light[1], slopes.light[0]) / (2 * math.pi)
    way = _WAYS[round(turn * len(_WAYS)) % len(_WAYS)]
    return (
        f"MS is shaded like relief, bright where PAN rises towards the {way}: it was compared with "
        "PAN shaded like that"
    )
