"""Rules of the method switched off one at a time: what changes, and where."""

from __future__ import annotations

import argparse
import logging
import warnings
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from affine import Affine

from benchmarks.gate.attempts import outcome_of
from benchmarks.gate.bent_cases import FRAMED, BentCase, bent_cases, make_bent
from benchmarks.gate.cases import NEGATIVE, POSITIVE, TUNING, cases, is_there
from benchmarks.gate.pairs import make_pair
from benchmarks.gate.rules import GATE, RULES, Rule, switched_off, watched
from benchmarks.records import Row, keep, resume
from benchmarks.report import replace_section
from benchmarks.scenes.make import Scene, write_scene
from benchmarks.scenes.truth import FloatArray, Truth, check_points, to_pan_px

log = logging.getLogger(__name__)
TruePlace = Callable[[FloatArray], FloatArray]
"""(N, 2) PAN pixels of (N, 2) MS pixels."""
WRONG_PX = 1.0
SAME_PX, SAME_SHARE = 0.0003, 0.1
"""Less than both is no change of accuracy."""
_BENT_PAIRS = 48
_KNOWN_THERE = ("repeated", "all cloud")
_SLOW = {("waves", "sentinel2"), ("tear", "sentinel2")}
_SCENES = ("A", "B", "C", "D", "E", "G", "K", "aerial")
_REAL = {
    **{
        name: (f"{name}/ms.tif", f"{name}/pan.tif")
        for name in (
            "landsat8_momotombo", "landsat8_oman", "landsat8_clouds", "cbers4a",
            "worldview2_city", "aerial_on_sentinel2",
        )
    },
    "landsat8_twodates": ("landsat8_twodates/20190809.tif", "landsat8_twodates/20190825.tif"),
    "landsat_geographic": ("landsat_geographic/1990.tif", "landsat_geographic/2000.tif"),
}  # fmt: skip


class Work(NamedTuple):
    """A pair to align: whether that is possible, its files, and the truth, if known."""

    name: str
    alignable: bool
    ms: Path
    pan: Path
    true: Callable[[], TruePlace | None]


def works(data: Path, scenes: Path, made: Path, count: int) -> Iterator[Work]:
    """All pairs, those of the gate and the bent ones made in a folder when they are missing."""
    for bent in bent_cases(_BENT_PAIRS, TUNING):
        if (bent.kind, bent.source) not in _SLOW:
            there = partial(_bent, bent, data)
            files = _files(made, bent.name, partial(_scene, there))
            yield Work(bent.name, bent.kind not in FRAMED, *files, partial(_place_of, there))
    for name in _SCENES:
        folder = scenes / name
        true = partial(_true, folder / "truth.json")
        yield Work(f"scene {name}", True, folder / "ms.tif", folder / "pan.tif", true)
    for name, of in _REAL.items():
        yield Work(f"real {name}", True, data / of[0], data / of[1], _unknown)
    hopeless = count * len(NEGATIVE) // len(POSITIVE)  # as many of each kind
    for alignable, many in ((True, count), (False, hopeless)):
        for case in cases(alignable, many, TUNING):
            if is_there(case, data):
                ms, pan = _files(made, case.name, partial(make_pair, case, data))
                known = alignable or case.kind in _KNOWN_THERE
                place = partial(_true, ms.parent / "truth.json") if known else _unknown
                yield Work(case.name, alignable, ms, pan, place)


def _files(made: Path, name: str, make: Callable[[], Scene]) -> tuple[Path, Path]:
    folder = made / name.replace("/", "_").replace(" ", "_")
    if not (folder / "truth.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_scene(make(), folder)
    return folder / "ms.tif", folder / "pan.tif"


@lru_cache(maxsize=1)
def _bent(case: BentCase, data: Path) -> tuple[Scene, TruePlace | None]:
    pair = make_bent(case, data)
    return pair.scene, pair.pan_px if pair.same_ground else None


def _scene(there: Callable[[], tuple[Scene, TruePlace | None]]) -> Scene:
    return there()[0]


def _place_of(there: Callable[[], tuple[Scene, TruePlace | None]]) -> TruePlace | None:
    return there()[1]


def _true(file: Path) -> TruePlace:
    truth = Truth.load(file)
    return lambda source_px: to_pan_px(Affine(*truth.ms_true), source_px, truth)


def _unknown() -> None:
    return None


def attempt(work: Work, rule: Rule | None = None) -> Row:
    """Align a pair without a rule, or with all of them, watched.

    Returns
    -------
    dict
        ``outcome``, ``failed`` reasons, ``error_px`` over the overlap, CPU seconds, ``warned``;
        with all rules also those that decided something (``fired``), and the ``candidates``: the
        reasons that failed for each, its error, and where it was looked for.
    """
    from geodelreg import align_pair as method

    fired: set[str] = set()
    candidates: list[tuple[list[str], float | None, str]] = []

    def error_px(pair: Any, there: Any) -> float | None:
        place = work.true()
        if place is None:
            return None
        spots = check_points(pair.source.grid.shape)
        true = place(spots)
        inside = (true >= 0).all(axis=1) & (true <= pair.reference.grid.shape[::-1]).all(axis=1)
        off = (pair.to_reference(there).forward(spots) - true)[inside]
        return float(np.sqrt((off**2).sum(axis=1).mean())) if len(off) else None

    def conclude(pair: Any, found: Any, *args: Any, **options: Any) -> Any:
        solution = original(pair, found, *args, **options)
        failed = [r.name for r in solution.verdict.reasons if not r.passed]
        where = f"{found.guess.images.scope.name}, {found.guess.search}"
        candidates.append((failed, error_px(pair, solution.map), where))
        return solution

    original, started = method.conclude, process_time()
    switched = watched(fired) if rule is None else switched_off(rule)
    with switched, mock.patch.object(method, "conclude", conclude):
        outcome, alignment = outcome_of(work.ms, work.pan)
    row: Row = {
        "pair": work.name, "alignable": work.alignable, "rule": rule.name if rule else "",
        "outcome": outcome, "cpu_s": process_time() - started,
        "error_px": candidates[-1][1] if candidates else None,
    }  # fmt: skip
    if alignment is not None:
        row["failed"] = [r.name for r in alignment.verdict.reasons if not r.passed]
        row["warned"] = list(alignment.warnings)
        row["sigma_px"] = alignment.accuracy.sigma_corner_px
    if rule is None:
        row |= {"fired": sorted(fired), "candidates": candidates}
    return row


def accepted(row: Row) -> bool:
    """True when a correction came out, or the header was confirmed."""
    return row["outcome"] in ("aligned", "already_aligned")


def wrong(row: Row) -> bool:
    """True of a correction that is off, or of what has no common ground."""
    error_px = row["error_px"]
    if error_px is None:
        error_px = 0.0 if row["alignable"] else np.inf
    return accepted(row) and bool(error_px > WRONG_PX)


def decided(rule: Rule, row: Row) -> bool:
    """True when a rule decided something; of the gate, when nothing else refused a candidate."""
    if rule in GATE:
        return any(failed and GATE[rule] >= set(failed) for failed, _, _ in row["candidates"])
    return rule.name in row["fired"]


def changed(before: Row, after: Row) -> str:
    """How a rule changes a pair: "wrong", "refused", "aligned", "worse", "better", or not."""
    if wrong(after) and not wrong(before):
        return "wrong"
    if accepted(before) != accepted(after):
        return "aligned" if accepted(after) else "refused"
    here, there = (row["error_px"] if accepted(row) else None for row in (before, after))
    if here is None or there is None or abs(there - here) <= max(SAME_PX, SAME_SHARE * here):
        return ""
    return "worse" if there > here else "better"


def run(args: argparse.Namespace) -> int:
    """Run what is missing: all pairs with all rules, then each rule off where it decided."""
    warnings.simplefilter("ignore")
    rows = resume(args.out)
    done = {(row["pair"], row["rule"]) for row in rows}
    pairs = []
    for work in works(args.data, args.scenes, args.out.parent / "pairs", args.count):
        pairs.append(work)
        if (work.name, "") not in done:
            keep(rows, attempt(work), args.out)
    base = {row["pair"]: row for row in rows if not row["rule"]}
    for rule in (*RULES, *GATE):
        where = [work for work in pairs if decided(rule, base[work.name])]
        for work in where[:: max(len(where) // args.most, 1)] if args.rule in rule.name else ():
            if (work.name, rule.name) not in done:
                keep(rows, attempt(work, rule), args.out)
    text = table(rows)
    print(text)
    if args.docs:
        replace_section(args.docs, "ablation", text)
    return 0


def table(rows: list[Row]) -> str:
    """What becomes of pairs without each rule, as a Markdown table."""
    base = {row["pair"]: row for row in rows if not row["rule"]}
    kinds = ("wrong", "refused", "aligned", "worse", "better")
    lines = [f"| rule | decided in | run without | {' | '.join(kinds)} |", "|---" * 8 + "|"]
    for rule in (*RULES, *GATE):
        mine = [row for row in rows if row["rule"] == rule.name]
        found = [changed(base[row["pair"]], row) for row in mine]
        count = sum(decided(rule, row) for row in base.values())
        cells = [rule.name, count, len(mine), *(found.count(kind) for kind in kinds)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks ablate``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real imagery")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of `benchmarks scenes`")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines; a run continues it")
    parser.add_argument("--count", type=int, default=96, help="alignable pairs of the gate")
    parser.add_argument("--rule", default="", help="only rules with this in their names")
    parser.add_argument("--most", type=int, default=60, help="pairs a rule, about")
    parser.add_argument("--docs", type=Path, help="page whose table is replaced: docs/method.md")
