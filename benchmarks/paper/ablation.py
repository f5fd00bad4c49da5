"""The paper's steps switched off and on, one at a time, on the same matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from time import process_time
from typing import TypeVar

import numpy as np

from benchmarks.paper.methods import (
    STEPS,
    Matched,
    Stage,
    distinct_right,
    fit_plainly,
    fit_robustly,
    run_mesh,
    run_steps,
    true_rmse,
)
from geodelreg.values.points import Status

T = TypeVar("T")
ALL, NONE, MESH = "all steps", "no step", "our filter"


@dataclass(frozen=True, slots=True)
class Ablated:
    """One composition of steps on one pair.

    Attributes
    ----------
    kept : int
    precision : float
        Right ones among the kept matches.
    recall : float
        Right matches kept, of those that pass the ratio test, each pair of places counted once.
    true_rmse_px : float
        Of plain least squares, over 21 × 21 points, PAN px.
    robust_rmse_px : float
        The same of a robust fit (USAC MAGSAC) to the matches left.
    cpu_ms : float
        Of the steps alone.
    """

    kept: int
    precision: float
    recall: float
    true_rmse_px: float
    robust_rmse_px: float
    cpu_ms: float


def compositions() -> dict[str, tuple[str, ...]]:
    """Names of the compositions, and the steps of each."""
    found = {ALL: tuple(STEPS), NONE: ()}
    for name in STEPS:
        found[f"without {name}"] = tuple(other for other in STEPS if other != name)
        found[f"only {name}"] = (name,)
    return found


def ablate(stage: Stage, matched: Matched) -> dict[str, Ablated]:
    """Every composition of `compositions`, and geodelreg's filter, on the same matches."""
    start = run_steps(matched, ())[0] == Status.KEPT
    findable = distinct_right(matched, start)
    found = {}
    for name, steps in compositions().items():
        (status, _), cpu_ms = _timed(partial(run_steps, matched, steps))
        found[name] = _ablated(stage, matched, status == Status.KEPT, findable, cpu_ms)
    (kept, _), cpu_ms = _timed(partial(run_mesh, matched))
    found[MESH] = _ablated(stage, matched, kept, findable, cpu_ms)
    return found


def _timed(run: Callable[[], T]) -> tuple[T, float]:
    """Result and CPU milliseconds."""
    start = process_time()
    result = run()
    return result, 1e3 * (process_time() - start)


def _ablated(
    stage: Stage, matched: Matched, kept: np.ndarray, findable: int, cpu_ms: float
) -> Ablated:
    right = int((kept & matched.right).sum())
    return Ablated(
        int(kept.sum()),
        right / kept.sum() if kept.any() else np.nan,
        distinct_right(matched, kept) / findable if findable else np.nan,
        true_rmse(stage, fit_plainly(stage, matched, kept)),
        true_rmse(stage, fit_robustly(stage, matched, kept)),
        cpu_ms,
    )


def interval(
    values: Sequence[float], groups: Sequence[str], seed: int = 0, draws: int = 2000
) -> tuple[float, float, float]:
    """Median of values with a 95 % bootstrap interval that draws sources, then their pairs.

    Parameters
    ----------
    values : sequence of float
        NaN is left out.
    groups : sequence of str
        Source of each value.
    seed, draws : int

    Returns
    -------
    median, low, high : float
        NaN without values.
    """
    known = [(g, v) for g, v in zip(groups, values, strict=True) if np.isfinite(v)]
    if not known:
        return np.nan, np.nan, np.nan
    names = sorted({group for group, _ in known})
    members = [[value for group, value in known if group == name] for name in names]
    most = max(map(len, members))
    padded = np.array([[*v, *[np.nan] * (most - len(v))] for v in members], dtype=np.float64)
    counts = np.array([len(values) for values in members])
    rng = np.random.default_rng(seed)
    chosen = rng.integers(len(names), size=(draws, len(names)))
    index = (rng.random((draws, len(names), most)) * counts[chosen][:, :, None]).astype(np.intp)
    drawn = padded[chosen[:, :, None], index]
    drawn[np.arange(most) >= counts[chosen][:, :, None]] = np.nan
    medians = np.nanmedian(drawn.reshape(draws, -1), axis=1)
    low, high = np.percentile(medians, (2.5, 97.5))
    return float(np.median([v for _, v in known])), float(low), float(high)
