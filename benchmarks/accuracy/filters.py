"""How well mismatch filters tell right matches from wrong ones.

Matches are drawn with known truth: uniformly spread points under a random similarity, optionally
with a smooth distortion and with noise; a share of them is matched wrongly instead: anywhere, or
(near misses, as a moved cloud or a look-alike beside the right place makes them) 3 to 15 px off.
Precision, recall and time of geodelreg's filters are compared with USAC MAGSAC of OpenCV and with
two graph filters of the literature, written here after their papers (hence "-like").
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.report import machine, replace_section
from geodelreg.fit.consensus import consensus
from geodelreg.fit.delaunay_mesh import filter_matches, star_filter
from geodelreg.paper.zhang2013 import Pairs, initial_status, reject_unshared
from geodelreg.values.points import Status
from geodelreg.values.raster import BoolArray, FloatArray, IntArray

LOOSE_PX = 8.0  # tolerance of the consensus: noise and distortion together
SIZE_PX = 1000.0
PRECISION, RECALL = 0.99, 0.97
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
Filter = Callable[[FloatArray, FloatArray, FloatArray], BoolArray]


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of contaminated matches."""

    count: int
    distortion_px: float
    noise_px: float
    outlier_share: float
    near_share: float


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one filter on one case, mean over the repetitions."""

    case: Case
    filter: str
    precision: float
    recall: float
    time_ms: float


def draw_matches(case: Case, seed: int) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Source and reference positions, descriptor ratios (that tell nothing) and the truth."""
    rng = np.random.default_rng([seed, case.count, round(100 * case.outlier_share)])
    source = rng.uniform(0, SIZE_PX, (case.count, 2))
    turn, scale = rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 1.1)
    linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    reference = (source - SIZE_PX / 2) @ linear.T + SIZE_PX / 2 + rng.uniform(-50, 50, 2)
    phase = 2 * np.pi * source[:, ::-1] / SIZE_PX + rng.uniform(0, 2 * np.pi, 2)
    reference += case.distortion_px * np.sin(phase)
    reference += case.noise_px * rng.standard_normal(source.shape)
    wrong = round(case.outlier_share * case.count)
    near = round(case.near_share * wrong)
    angle, miss = rng.uniform(0, 2 * np.pi, near), rng.uniform(3.0, 15.0, near)
    reference[:near] += miss[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reference[near:wrong] = rng.uniform(0, SIZE_PX, (wrong - near, 2))
    return source, reference, rng.uniform(0.4, 0.8, case.count), np.arange(case.count) >= wrong


def by_delaunay(source: FloatArray, reference: FloatArray, ratio: FloatArray) -> BoolArray:
    """Loose global consensus, then the Delaunay mesh: geodelreg's default."""
    found = consensus(source, reference, LOOSE_PX)
    return np.asarray(filter_matches(source, reference, found) == Status.KEPT)


def by_star(source: FloatArray, reference: FloatArray, ratio: FloatArray) -> BoolArray:
    """The Delaunay mesh alone."""
    return star_filter(source, reference)


def by_shared_edges(source: FloatArray, reference: FloatArray, ratio: FloatArray) -> BoolArray:
    """Edges that both triangulations share: our reading of step 6 of Zhang et al. 2013, once."""
    status = reject_unshared(Pairs(source, reference, ratio), initial_status(ratio), 0.2)
    return np.asarray(status == Status.KEPT)


def by_magsac(
    source: FloatArray, reference: FloatArray, ratio: FloatArray, threshold_px: float
) -> BoolArray:
    """One affine by OpenCV's USAC MAGSAC."""
    _, inlier = cv2.estimateAffine2D(
        source,
        reference,
        method=cv2.USAC_MAGSAC,
        ransacReprojThreshold=threshold_px,
        maxIters=20_000,
        confidence=0.9999,
    )
    return np.asarray(inlier, dtype=np.bool_).ravel()


def nearest_first(xy: FloatArray) -> IntArray:
    """(N, N - 1) intp, the other points in order of their distance."""
    distance = ((xy[:, None, :] - xy[None, :, :]) ** 2).sum(axis=2)
    np.fill_diagonal(distance, -1.0)
    return np.argsort(distance, axis=1, kind="stable")[:, 1:]


def by_gtm(
    source: FloatArray, reference: FloatArray, ratio: FloatArray, size: int = 5
) -> BoolArray:
    """Graph transformation matching (Aguilar et al. 2009, doi:10.1016/j.imavis.2008.05.004).

    The point that most edges of the two median nearest-neighbour graphs disagree about goes, until
    the graphs are equal.
    """
    orders = [nearest_first(source), nearest_first(reference)]
    alive = np.ones(len(source), dtype=np.bool_)
    near = [order[:, :size].copy() for order in orders]
    while alive.sum() > size + 1:
        kept = np.flatnonzero(alive)
        first, second = (
            _median_graph(xy, graph, kept)
            for xy, graph in zip((source, reference), near, strict=True)
        )
        differ = np.setxor1d(first, second, assume_unique=True)
        if len(differ) == 0:
            break
        worst = int(np.bincount(differ % len(source), minlength=len(source)).argmax())
        alive[worst] = False
        for graph, order in zip(near, orders, strict=True):
            for i in np.flatnonzero((graph == worst).any(axis=1) & alive):
                graph[i] = order[i][alive[order[i]]][:size]
    return alive


def _median_graph(xy: FloatArray, near: IntArray, kept: IntArray) -> IntArray:
    """Directed edges, as keys, to the nearest neighbours no farther than the median of all."""
    other = near[kept].reshape(-1)
    owner = np.repeat(kept, near.shape[1])
    length = np.hypot(*(xy[other] - xy[owner]).T)
    short = length <= np.median(length)
    return np.asarray(owner[short] * len(xy) + other[short], dtype=np.intp)


def by_lpm(source: FloatArray, reference: FloatArray, ratio: FloatArray) -> BoolArray:
    """Locality preserving matching (Ma et al. 2019, doi:10.1007/s11263-018-1117-z).

    Points whose neighbours (4, 6 and 8 nearest) are the same in both images and move alike stay;
    a second pass looks for neighbours only among those of the first.
    """
    keep = _local_cost(source, reference, np.arange(len(source))) <= 0.8
    if keep.sum() > 10:
        keep = _local_cost(source, reference, np.flatnonzero(keep)) <= 0.5
    return keep


def _local_cost(source: FloatArray, reference: FloatArray, pool: IntArray) -> FloatArray:
    """Share of the neighbours in `pool` that differ between the images or move otherwise."""
    nearest = []
    for xy in (source, reference):
        distance = ((xy[:, None, :] - xy[pool][None, :, :]) ** 2).sum(axis=2)
        distance[pool, np.arange(len(pool))] = np.inf
        nearest.append(pool[np.argsort(distance, axis=1, kind="stable")[:, :8]])
    motion = reference - source
    length = np.maximum(np.hypot(*motion.T), 1e-9)
    other = nearest[0]
    similar = np.minimum(length[other], length[:, None]) / np.maximum(
        length[other], length[:, None]
    )
    similar *= (motion[other] * motion[:, None]).sum(2) / (length[other] * length[:, None])
    cost = np.zeros(len(source))
    for size in (4, 6, 8):
        common = (nearest[0][:, :size, None] == nearest[1][:, None, :size]).any(axis=2)
        cost += (1.0 - (common & (similar[:, :size] >= 0.2)).mean(axis=1)) / 3
    return cost


FILTERS: dict[str, Filter] = {
    "geodelreg": by_delaunay,
    "star alone": by_star,
    "shared edges (paper)": by_shared_edges,
    "MAGSAC 2 px": partial(by_magsac, threshold_px=2.0),
    "MAGSAC 6 px": partial(by_magsac, threshold_px=6.0),
    "GTM-like": by_gtm,
    "LPM-like": by_lpm,
}


def measure(case: Case, repetitions: int) -> list[Row]:
    """All filters on the same drawings of one case."""
    rows = []
    drawings = [draw_matches(case, seed) for seed in range(repetitions)]
    for name, keep_right in FILTERS.items():
        figures = []
        for source, reference, ratio, right in drawings:
            begin = time.perf_counter()
            keep = keep_right(source, reference, ratio)
            elapsed_ms = 1e3 * (time.perf_counter() - begin)
            both = float((keep & right).sum())
            precision = both / keep.sum() if keep.any() else float(not right.any())
            figures.append((precision, both / max(right.sum(), 1), elapsed_ms))
        precision, recall, time_ms = np.array(figures).T
        rows.append(Row(case, name, precision.mean(), recall.mean(), float(np.median(time_ms))))
    return rows


def markdown(rows: Iterable[Row]) -> str:
    """Table of precision / recall, and the times, one line per case."""
    by_case: dict[Case, dict[str, Row]] = {}
    for row in rows:
        by_case.setdefault(row.case, {})[row.filter] = row
    header = ["points", "distortion px", "noise px", "near misses", "wrong", *FILTERS]
    lines = [_line(header), _line(["--:"] * len(header))]
    for case, found in by_case.items():
        cells = [
            f"{found[f].precision:.3f} / {found[f].recall:.3f} ({found[f].time_ms:.0f} ms)"
            for f in FILTERS
        ]
        key = [str(case.count), f"{case.distortion_px:g}", f"{case.noise_px:g}"]
        key += [f"{100 * share:.0f} %" for share in (case.near_share, case.outlier_share)]
        lines.append(_line([*key, *cells]))
    return "\n".join(lines)


def reach(rows: list[Row]) -> str:
    """Largest share of wrong matches up to which each filter meets the target, by kind of case."""
    kinds: dict[Case, dict[str, list[Row]]] = {}
    for row in rows:
        kind = replace(row.case, outlier_share=0.0)
        kinds.setdefault(kind, {}).setdefault(row.filter, []).append(row)
    header = ["points", "distortion px", "noise px", "near misses", *FILTERS]
    lines = [_line(header), _line(["--:"] * len(header))]
    for kind, found in kinds.items():
        key = [str(kind.count), f"{kind.distortion_px:g}", f"{kind.noise_px:g}"]
        lines.append(
            _line([*key, f"{100 * kind.near_share:.0f} %", *(_reach(found[f]) for f in FILTERS)])
        )
    return "\n".join(lines)


def _reach(rows: list[Row]) -> str:
    """The share before the first at which the target is missed."""
    best = "–"
    for row in sorted(rows, key=lambda row: row.case.outlier_share):
        if row.precision < PRECISION or row.recall < RECALL:
            break
        best = f"{100 * row.case.outlier_share:.0f} %"
    return best


def draw(rows: list[Row], path: Path) -> None:
    """Precision and recall over the share of wrong matches, of the noisiest cases.

    Parameters
    ----------
    rows : list of Row
        Those of the fewest points and near misses are drawn, one column for each distortion.
    path : Path
    """
    from matplotlib.figure import Figure

    few, noise = min(r.case.count for r in rows), max(r.case.noise_px for r in rows)
    near = min(r.case.near_share for r in rows)
    shown = (few, noise, near)
    drawn = [r for r in rows if (r.case.count, r.case.noise_px, r.case.near_share) == shown]
    bends = sorted({r.case.distortion_px for r in drawn})
    figure = Figure(figsize=(9.5, 6.4), layout="constrained")
    grid = figure.subplots(2, len(bends), squeeze=False, sharex=True, sharey=True)
    for column, bend in enumerate(bends):
        for line, (measure, target) in enumerate((("precision", PRECISION), ("recall", RECALL))):
            axes = grid[line, column]
            for name, marker in zip(FILTERS, "*os^vDP", strict=True):
                part = [r for r in drawn if r.filter == name and r.case.distortion_px == bend]
                axes.plot(
                    [100 * r.case.outlier_share for r in part],
                    [getattr(r, measure) for r in part],
                    marker=marker, ms=5, lw=2.0 if name == "geodelreg" else 1.0, label=name,
                )  # fmt: skip
            axes.axhline(target, color="0.5", lw=0.8, ls=":")
            axes.set(ylim=(-0.02, 1.03))
            axes.grid(alpha=0.3)
            grid[line, 0].set_ylabel(measure)
        grid[0, column].set_title(
            f"smooth distortion {bend:g} px, noise {noise:g} px, {few} points"
        )
        grid[1, column].set_xlabel("wrong matches, %")
    grid[1, 0].legend(fontsize=8, loc="lower left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks filters``."""
    parser.add_argument("--count", type=int, nargs="+", default=[300, 1000], help="matches")
    parser.add_argument("--distortion", type=float, nargs="+", default=[0.0, 2.0], help="px")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.3], help="px")
    parser.add_argument(
        "--near", type=float, nargs="+", default=[0.0, 0.3], help="near misses among wrong ones"
    )
    parser.add_argument("--share", type=float, nargs="+", default=SHARES, help="wrong ones")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced, with its plot")


def run(args: argparse.Namespace) -> int:
    """Measure, print the table, write the figures."""
    rows = [
        row
        for count in args.count
        for distortion in args.distortion
        for noise in args.noise
        for near in args.near
        for share in args.share
        for row in measure(Case(count, distortion, noise, share, near), args.repetitions)
    ]
    text = f"{reach(rows)}\n\n{markdown(rows)}"
    print(text)
    if args.docs:
        draw(rows, args.docs.parent / "images" / "filters.png")
        note = f"Mean of {args.repetitions} drawings, median ms. {machine()}."
        replace_section(args.docs, "filters", f"{text}\n\n{note}")
    if args.json:
        args.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    return 0
