"""The measured sections of ``docs/paper.md``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.ablation import ALL, MESH, NONE, interval
from benchmarks.paper.methods import GATED, METHODS, OURS, PRINTED, READ, SIFT, STEPS, STEPS_OF
from benchmarks.paper.scenes import CLEAN, CLOUDS, DATES, FIGURES, REAL, SAMPLE, SEASON, Case
from benchmarks.report import replace_section

Row = dict[str, Any]
Results = dict[str, Any]
GROUPS: tuple[tuple[str, float], ...] = (
    (SAMPLE, 4.0), (CLEAN, 1.0), (CLEAN, 4.0), (CLOUDS, 1.0), (CLOUDS, 4.0), (SEASON, 1.0),
    (SEASON, 4.0), (DATES, 1.0), (DATES, 4.0), (REAL, 2.0),
)  # fmt: skip
CONTAMINATION = (CLEAN, CLOUDS, SEASON, DATES, REAL)
ACCURATE_PX = 1.0
SHOWN = (SIFT, PRINTED, READ, OURS)
NOT_GIVEN = ("–", "–")
PRINTED_FIGURES = {
    "Fig 4, 5": {"time, s": ("0.215", "0.2098"), "RMSE": ("0.6808", "0.6524")},
    "Fig 6": {"time, s": ("0.1696", "0.1498"), "RMSE": ("0.8733", "0.7452")},
    "Fig 7": {"time, s": ("0.6935", "0.5863"), "RMSE": ("0.8952", "0.7558")},
}
"""What the paper gives: with traditional SIFT and with its method."""


def group(rows: Iterable[Row], condition: str, ratio: float | None = None) -> list[Row]:
    """Rows of a condition, and of a GSD ratio when one is given."""
    return [r for r in rows if r["condition"] == condition and ratio in (None, r["ratio"])]


def spread_of(rows: Sequence[Row], values: Sequence[float]) -> tuple[float, float, float]:
    """Median over pairs and its interval over sources; see `interval`."""
    return interval(values, [row["source"] for row in rows])


def _cell(triple: tuple[float, float, float], form: str = ".3g") -> str:
    middle, low, high = triple
    if math.isnan(middle):
        return "–"
    if low == middle == high:
        return f"{middle:{form}}"
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


def _table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    body = ["| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *lines)]
    return "\n".join(body)


def correct_rate(row: Row, method: str) -> float:
    """Share of the kept matches that are right, percent; NaN without any."""
    score = row["methods"][method]
    return 100 * score["right"] / score["kept"] if score["kept"] else math.nan


def headline(rows: list[Row]) -> str:
    """Table 1 of the paper, on our pairs."""
    lines = []
    for condition, ratio in GROUPS:
        part = group(rows, condition, ratio)
        for method in METHODS if part else ():
            scores = [row["methods"][method] for row in part]
            right = sum(s["true_rmse_px"] <= ACCURATE_PX for s in scores)
            lines.append([
                f"{condition}, {ratio:g}:1" if method == SIFT else "",
                method,
                _cell(spread_of(part, [r["methods"][method]["kept"] for r in part]), ".0f"),
                _cell(spread_of(part, [correct_rate(r, method) for r in part]), ".1f"),
                _cell(spread_of(part, [r["methods"][method]["control_rmse_px"] for r in part])),
                _cell(spread_of(part, [r["methods"][method]["true_rmse_px"] for r in part])),
                f"{right} of {len(part)}",
                _cell(spread_of(part, [_e1_excess(r, method) for r in part])),
                _cell(spread_of(part, [_relative_time(r, method) for r in part]), ".2f"),
            ])  # fmt: skip
    head = [
        "pairs", "method", "points", "correct rate, %", "RMSE at control points, px",
        "true RMSE, px", "≤ 1 px", "E1 over E1 at the truth", "CPU time over SIFT's",
    ]  # fmt: skip
    return _table(head, lines)


def _e1_excess(row: Row, method: str) -> float:
    return float(row["methods"][method]["e1"] / row["e1_truth"])


def _relative_time(row: Row, method: str) -> float:
    return float(row["methods"][method]["cpu_s"] / row["methods"][SIFT]["cpu_s"])


def steps_table(rows: list[Row]) -> str:
    """Median number of points after each step."""
    names = ("keypoints MS", "keypoints PAN", "2 ratio", *STEPS)
    lines = []
    for condition, ratio in GROUPS:
        part = group(rows, condition, ratio)
        if part:
            counts = [row["methods"][READ]["steps"] for row in part]
            medians = [np.median([count[name] for count in counts]) for name in names]
            wrong = 100 * np.nanmedian([row["wrong_share"] for row in part])
            pairs = f"{condition}, {ratio:g}:1"
            lines.append([pairs, *(f"{m:.0f}" for m in medians), f"{wrong:.0f}"])
    return _table(["pairs", *names, "wrong after step 2, %"], lines)


def figures_table(results: Results) -> str:
    """The numbers of the paper's Figures 4 to 7 beside those of the pairs that stand for them."""
    lines = []
    for name, case in FIGURES.items():
        row = _row_of(case, [*results["pairs"], *results["sweeps"]])
        given = PRINTED_FIGURES[name]
        scores = [row["methods"][method] for method in SHOWN]
        cells: dict[str, tuple[tuple[str, str], list[str]]] = {
            "points after steps 2 → 3 → 5 → 6": (NOT_GIVEN, [_chain(row, m) for m in SHOWN]),
            "correct rate, %": (NOT_GIVEN, [f"{correct_rate(row, m):.1f}" for m in SHOWN]),
            "time, s": (given["time, s"], [f"{s['cpu_s']:.2f}" for s in scores]),
            "RMSE, as the paper has it": (given["RMSE"], [""] * len(SHOWN)),
            "RMSE at control points, px": (
                NOT_GIVEN, [f"{s['control_rmse_px']:.3g}" for s in scores],
            ),
            "E1, DN": (NOT_GIVEN, [f"{s['e1']:.3g}" for s in scores]),
            "true RMSE, px": (NOT_GIVEN, [f"{s['true_rmse_px']:.3g}" for s in scores]),
        }  # fmt: skip
        for quantity, (theirs, mine) in cells.items():
            first = name if quantity.startswith("points") else ""
            lines.append([first, quantity, *theirs, *mine])
    head = ["figure", "", "the paper: SIFT", "the paper: Delaunay", *SHOWN]
    return _table(head, lines)


def _row_of(case: Case, rows: Iterable[Row]) -> Row:
    """The row that was measured of a case."""
    return next(r for r in rows if all(r[k] == v for k, v in asdict(case).items()))


def _chain(row: Row, method: str) -> str:
    """Points left after the ratio test and after each step that a method has."""
    score = row["methods"][method]
    if method not in STEPS_OF:
        return f"{score['kept']} patches"
    last = {name.split()[0]: name for name in ("2 ratio", *STEPS_OF[method])}
    return " → ".join(str(score["steps"][name]) for name in last.values())


def within_table(rows: list[Row]) -> str:
    """The correct rate under other distances."""
    lines = []
    for method in METHODS:
        cells = []
        for key in ("within_half", "right", "within_two"):
            rates = [
                100 * row["methods"][method][key] / row["methods"][method]["kept"]
                for row in rows
                if row["methods"][method]["kept"]
            ]
            cells.append(f"{np.mean(rates):.1f}")
        lines.append([method, *cells])
    return _table(["method, mean of all pairs", "within ½ px, %", "1 px", "2 px"], lines)


def gate_table(rows: list[Row]) -> str:
    """The gate's verdicts on each method, of the pairs it was asked about."""
    lines = []
    for condition in (SAMPLE, *CONTAMINATION):
        cells = [condition]
        for method in GATED:
            scores = [row["methods"][method] for row in group(rows, condition)]
            asked = [s for s in scores if s["outcome"]]
            taken = [s for s in asked if s["outcome"] in ("aligned", "already_aligned")]
            false = sum(not s["accepted_rmse_px"] <= ACCURATE_PX for s in taken)
            cells.append(f"{len(taken)} of {len(asked)} accepted, {false} of them > 1 px")
        lines.append(cells)
    return _table(["pairs", *GATED], lines)


def ablation_table(rows: list[Row], condition: str) -> str:
    """What each composition of steps keeps, and what comes of it."""
    part = group(rows, condition)
    order = [NONE, *(f"only {n}" for n in STEPS), ALL, *(f"without {n}" for n in STEPS), MESH]
    lines = []
    for name in order:
        found = [row["ablation"][name] for row in part]
        good = sum(f["true_rmse_px"] <= ACCURATE_PX for f in found)
        cells = [
            f"{np.median([f['kept'] for f in found]):.0f}",
            *(
                f"{100 * np.nanmean([f[key] for f in found]):.1f}"
                for key in ("precision", "recall")
            ),
            *(
                f"{np.nanmedian([f[key] for f in found]):.3g}"
                for key in ("true_rmse_px", "robust_rmse_px")
            ),
        ]
        # milliseconds over seconds, in percent
        times = [
            f["cpu_ms"] / row["methods"][SIFT]["cpu_s"] / 10
            for f, row in zip(found, part, strict=True)
        ]
        lines.append([name, *cells, f"{good} of {len(part)}", f"{np.median(times):.2f}"])
    head = [
        "steps after the ratio test", "points", "precision, %", "recall, %", "true RMSE, px",
        "with a robust fit, px", "≤ 1 px", "time, % of SIFT's",
    ]  # fmt: skip
    return _table(head, lines)


def effect(row: Row, step: str, measure: str, alone: bool) -> float:
    """What a step changes on one pair: switched on after none, or left out of all.

    Parameters
    ----------
    row : dict
    step : str
    measure : str
        ``precision`` or ``recall``: difference in percentage points; ``true_rmse_px`` or
        ``robust_rmse_px``: ratio.
    alone : bool
        The step alone against no step; else all steps against all but this one.
    """
    found = row["ablation"]
    with_it = found[f"only {step}" if alone else ALL][measure]
    without = found[NONE if alone else f"without {step}"][measure]
    if measure.endswith("_px"):
        return float(with_it / without)
    return float(100 * (with_it - without))


MEASURES = (
    ("precision", "precision, points"),
    ("recall", "recall, points"),
    ("true_rmse_px", "true RMSE, ratio"),
    ("robust_rmse_px", "true RMSE after a robust fit, ratio"),
)


def effects_table(rows: list[Row], alone: bool) -> str:
    """Median effect of each step by condition, with intervals."""
    lines = []
    for step in STEPS:
        for condition in CONTAMINATION:
            part = group(rows, condition)
            cells = [
                _cell(spread_of(part, [effect(r, step, m, alone) for r in part]), ".2f")
                for m, _ in MEASURES
            ]
            lines.append([step if condition == CLEAN else "", condition, *cells])
    return _table(["step", "pairs", *(title for _, title in MEASURES)], lines)


def sweep_table(rows: list[Row]) -> str:
    """How often each method is within a pixel, and the paper's two examples."""
    lines = []
    for kind, example in (("rotation", 36.0), ("translation", 230.0)):
        for ratio in sorted({row["ratio"] for row in rows}):
            part = group(rows, kind, ratio)
            shown = next(row for row in part if row["value"] == example)
            for method in METHODS:
                scores = [row["methods"][method] for row in part]
                good = sum(s["true_rmse_px"] <= ACCURATE_PX for s in scores)
                unit = "°" if kind == "rotation" else " px"
                lines.append([
                    f"{kind}, {ratio:g}:1" if method == SIFT else "", method,
                    f"{good} of {len(part)}",
                    f"{np.nanmedian([s['true_rmse_px'] for s in scores]):.3g}",
                    _example(f"{example:g}{unit}", shown, method),
                ])  # fmt: skip
    head = [
        "sweep", "method", "true RMSE ≤ 1 px", "median true RMSE, px",
        "the paper's example: RMSE at control points / true, time over SIFT's",
    ]  # fmt: skip
    return _table(head, lines)


def _example(title: str, row: Row, method: str) -> str:
    score = row["methods"][method]
    return (
        f"{title}: {score['kept']} points, {correct_rate(row, method):.1f} % right, "
        f"{score['control_rmse_px']:.3g} / {score['true_rmse_px']:.3g} px, "
        f"{_relative_time(row, method):.2f}"
    )


def sections(results: Results) -> dict[str, str]:
    """Name and text of every measured section."""
    pairs = results["pairs"]
    ablation = [
        f"### {condition} ({len(group(pairs, condition))} pairs)\n\n"
        + ablation_table(pairs, condition)
        for condition in CONTAMINATION
    ]
    count = f"{len(pairs)} pairs, {results['cpu_min']:.0f} CPU minutes, {results['machine']}"
    return {
        "table": f"{headline(pairs)}\n\nMeasured on {count}.",
        "figures": figures_table(results),
        "steps": steps_table(pairs),
        "within": within_table(pairs),
        "gate": gate_table(pairs),
        "sweeps": sweep_table(results["sweeps"]),
        "left out": effects_table(pairs, alone=False),
        "alone": effects_table(pairs, alone=True),
        "ablation": "\n\n".join(ablation),
    }


def summary(results: Results) -> str:
    """All sections, for the terminal."""
    return "\n\n".join(f"{name}\n\n{text}" for name, text in sections(results).items())


def write(results: Results, page: Path) -> None:
    """Replace the measured sections of the page."""
    for name, text in sections(results).items():
        replace_section(page, f"paper {name}", text)
