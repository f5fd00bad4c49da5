"""Tables and curves from the rows of the gate's benchmark."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]
LIMIT_PX = 1.0
Z = 1.959964
LEAST_IS_GOOD = ("log_nfa", "log_chance", "sigma_px", "disagreement_px", "rival")
CURVES = ("log_chance", "log_nfa", "disagreement_px", "sigma_px", "rival", "tie_points", "coverage")
SYSTEMATIC_PX = 0.005


def accepted(row: Row) -> bool:
    """An output would have been written."""
    return row["outcome"] in ("aligned", "already_aligned")


def false_accept(row: Row) -> bool:
    """Accepted with an error beyond the limit; a pair without common ground has no right answer."""
    if not accepted(row):
        return False
    known = row["alignable"] or row["kind"] in ("repeated", "all cloud")
    return not known or not row["rmse_px"] <= LIMIT_PX


def false_refusal(row: Row) -> bool:
    """A pair that can be aligned was not."""
    return bool(row["alignable"]) and not accepted(row)


def wilson(events: int, trials: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    if trials == 0:
        return 0.0, 1.0
    p, z2 = events / trials, Z * Z
    middle = (p + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z * math.sqrt(p * (1 - p) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def clustered(rows: list[Row], event: Callable[[Row], bool]) -> tuple[float, float]:
    """95 % interval of a share, sources being drawn, not pairs.

    The variance is that of a ratio over clusters; it gives the number of independent pairs that
    ours are worth, and Wilson's interval is taken with that.  Without any event in any cluster
    the variance says nothing, and the pairs are taken as independent.
    """
    clusters: dict[str, list[bool]] = {}
    for row in rows:
        clusters.setdefault(f"{row['source']}/{row['other']}", []).append(event(row))
    total = sum(map(len, clusters.values()))
    share = sum(map(sum, clusters.values())) / max(total, 1)
    if len(clusters) < 2 or share in (0.0, 1.0):
        return wilson(round(share * total), total)
    spread = sum((sum(c) - share * len(c)) ** 2 for c in clusters.values())
    variance = spread * len(clusters) / (len(clusters) - 1) / total**2
    worth = min(share * (1 - share) / max(variance, 1e-12), total)
    p, z2 = share, Z * Z
    middle = (p + z2 / (2 * worth)) / (1 + z2 / worth)
    half = Z * math.sqrt(p * (1 - p) / worth + z2 / (4 * worth**2)) / (1 + z2 / worth)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def _line(name: str, rows: list[Row], event: Callable[[Row], bool]) -> str:
    count = sum(map(event, rows))
    low, high = wilson(count, len(rows))
    wide = clustered(rows, event)
    return (
        f"| {name} | {len(rows)} | {count} | {100 * low:.2f}–{100 * high:.2f} % "
        f"| {100 * wide[0]:.2f}–{100 * wide[1]:.2f} % |"
    )


def _table(rows: list[Row], event: Callable[[Row], bool], what: str, by: str) -> str:
    head = f"| {by} | pairs | {what} | 95 %, pairs independent | 95 %, clustered by source |"
    lines = [head, "|---|---|---|---|---|"]
    lines += [
        _line(str(value), [row for row in rows if row[by] == value], event)
        for value in sorted({row[by] for row in rows})
    ]
    lines.append(_line("**all**", rows, event))
    return "\n".join(lines)


def page(rows: list[Row]) -> str:
    """The section of ``docs/gate.md`` that is measured."""
    hopeless = [row for row in rows if not row["alignable"]]
    alignable = [row for row in rows if row["alignable"]]
    parts = ["## Measured", ""]
    for title, group, event, what in (
        ("Pairs that cannot be aligned", hopeless, false_accept, "false accepts"),
        ("Pairs that can: refused", alignable, false_refusal, "false refusals"),
        ("Pairs that can: accepted, off by more than 1 PAN px", alignable, false_accept,
         "false accepts"),
    ):  # fmt: skip
        parts += [f"### {title}", ""]
        for by in ("kind", "source", "part"):
            parts += [_table(group, event, what, by), ""]
    parts += ["### Predicted against true error", "", _calibration(alignable)]
    crashed = [row["name"] for row in rows if str(row["outcome"]).startswith("crash")]
    parts += ["", f"Crashes: {len(crashed)}. Seconds per pair, median: {_median_s(rows):.2f}."]
    return "\n".join(parts)


def _median_s(rows: list[Row]) -> float:
    return float(np.median([row["seconds"] for row in rows])) if rows else math.nan


def normalised_errors(rows: Iterable[Row]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """True error at the centre of MS over its predicted standard error, of simulated pairs."""
    return np.array(
        [
            row["centre_px"] / row["sigma_centre_px"]
            for row in rows
            if row["outcome"] == "aligned"
            and row["kind"] not in ("real pair", "two dates")
            and row["rmse_px"] <= LIMIT_PX
            and row.get("sigma_centre_px")
        ]
    )


def _calibration(rows: list[Row]) -> str:
    lines = ["| kind | runs | RMS of error / sigma | median error, PAN px |", "|---|---|---|---|"]
    for kind in [*sorted({row["kind"] for row in rows}), ""]:
        part = [row for row in rows if kind in ("", row["kind"])]
        ratio = normalised_errors(part)
        if not len(ratio):
            continue
        error = np.median([row["centre_px"] for row in part if row["outcome"] == "aligned"])
        rms = float(np.sqrt(np.mean(ratio**2)))
        lines.append(f"| {kind or '**all**'} | {len(ratio)} | {rms:.2f} | {error:.4f} |")
    return "\n".join(lines)


def roc(rows: list[Row], reason: str) -> tuple[list[float], list[float]]:
    """Shares of hopeless and of alignable pairs that pass, as one reason's limit is relaxed.

    A pair without a measured value never passes: nothing was found that could be written.
    """
    sign = -1.0 if reason in LEAST_IS_GOOD else 1.0
    scores: dict[bool, list[float]] = {True: [], False: []}
    for row in rows:
        value = row["evidence"].get(reason)
        scores[row["alignable"]].append(-math.inf if value is None else sign * value)
    levels = sorted({s for group in scores.values() for s in group if s > -math.inf}, reverse=True)
    good, bad = (np.sort(scores[group]) for group in (True, False))
    x = [1.0 - np.searchsorted(bad, level) / max(len(bad), 1) for level in levels]
    y = [1.0 - np.searchsorted(good, level) / max(len(good), 1) for level in levels]
    return [0.0, *map(float, x)], [0.0, *map(float, y)]


def figure(rows: list[Row], path: Path) -> None:
    """Draw the ROC curves of the gate's reasons, and the gate's own point."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    canvas, axes = plt.subplots(figsize=(6.4, 4.8), layout="constrained")
    for reason in CURVES:
        axes.plot(*roc(rows, reason), label=reason, drawstyle="steps-post")
    groups = [[row for row in rows if row["alignable"] is group] for group in (False, True)]
    share = [sum(map(accepted, group)) / max(len(group), 1) for group in groups]
    axes.plot(*share, "k*", markersize=12, label="all reasons together")
    axes.set_xscale("symlog", linthresh=1e-3)
    axes.set(xlim=(-1e-4, 1), ylim=(0, 1.01))
    axes.set_xlabel("share of pairs that cannot be aligned and pass")
    axes.set_ylabel("share of alignable pairs that pass")
    axes.legend(loc="lower right", fontsize=8)
    axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.savefig(path, dpi=110)
    plt.close(canvas)
