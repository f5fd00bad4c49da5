"""What is said of pairs that are bent, torn, coloured, filled or framed, against what is true."""

from __future__ import annotations

import argparse
import json
import logging
import math
import multiprocessing
import tempfile
import time
from collections import defaultdict
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine

from benchmarks.gate.attempts import outcome_of
from benchmarks.gate.bent_cases import BENT, BentCase, BentPair, bent_cases, make_bent
from benchmarks.records import Row, resume
from benchmarks.scenes.make import write_scene

log = logging.getLogger(__name__)
WRONG_PX = 1.0
"""Root mean square over the overlap from which a written file is wrong, warned of or not."""
DOUBTFUL_PX = 0.5
CHECKED_PX = 0.6
_TOLD_FACTOR = 1.5
FAULTS = (
    "silently wrong", "not warned of", "residual wrong", "refused for nothing", "checked wrongly",
    "crashed",
)  # fmt: skip


def run_case(case: BentCase, data: Path) -> Row:
    """Make one pair, align and check it, and say what came of it.

    Returns
    -------
    dict
        The case; ``best_px``, what the best affine leaves, and ``before_px``, what the header does;
        ``outcome``, ``failed`` reasons, ``warned``, ``written_px``, ``said_px`` and its interval;
        ``checked``.  Distances are root mean squares over the overlap in PAN pixels.
    """
    pair = make_bent(case, data)
    truth = pair.scene.truth
    row: Row = {
        "before_px": _rms(pair, Affine(*truth.ms_header)),
        "best_px": _rms(pair, pair.best_affine()),
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(pair.scene, folder)
        (folder / "truth.json").unlink()
        row |= _aligned(folder, pair)
        row |= _checked(folder)
    row = asdict(case) | {"name": case.name, "part": case.part} | row
    return {key: _plain(value) for key, value in row.items()}


def _rms(pair: BentPair, transform: Affine) -> float:
    if not pair.same_ground:
        return math.inf
    return float(np.sqrt((pair.errors(transform) ** 2).sum(axis=1).mean()))


def _aligned(folder: Path, pair: BentPair) -> Row:
    started = time.perf_counter()
    outcome, alignment = outcome_of(folder / "ms.tif", folder / "pan.tif")
    row: Row = {"outcome": outcome, "seconds": time.perf_counter() - started}
    if outcome == "refused":
        reasons = () if alignment is None else alignment.verdict.reasons
        return row | {"failed": [reason.name for reason in reasons if not reason.passed]}
    if alignment is None:
        return row
    said = alignment.accuracy
    low, high = getattr(said, "residual_interval_px", (math.nan, math.nan))
    return row | {
        "model": alignment.correction.model,
        "warned": list(alignment.warnings),
        "written_px": _rms(pair, alignment.correction.corrected),
        "said_px": getattr(said, "residual_rms_px", math.nan),
        "said_low_px": low,
        "said_high_px": high,
        "sigma_corner_px": said.sigma_corner_px,
    }


def _checked(folder: Path) -> Row:
    from geodelreg import check
    from geodelreg.errors import GeodelregError

    try:
        return {"checked": check(folder / "ms.tif", folder / "pan.tif").outcome.value}
    except GeodelregError as error:
        return {"checked": type(error).__name__}


def _plain(value: Any) -> Any:
    """For JSON: None where a number is not finite."""
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def is_written(row: Row) -> bool:
    """True when a correction came out, or the header was confirmed."""
    return row["outcome"] in ("aligned", "already_aligned")


def faults(row: Row) -> list[str]:
    """What is wrong with what was said of one pair; empty when nothing is."""
    found = []
    off = row.get("written_px")
    one_affine = row["best_px"] is not None and row["kind"] not in BENT
    if is_written(row):
        if off is None or off > WRONG_PX:
            found.append("silently wrong")
        elif off > DOUBTFUL_PX and not row["warned"]:
            found.append("not warned of")
        if off is not None and DOUBTFUL_PX >= off > 0.3 and not _told(row, off):
            found.append("residual wrong")
    elif one_affine:
        found.append("refused for nothing")
    if row.get("checked") == "aligned" and not (row["before_px"] or math.inf) <= CHECKED_PX:
        found.append("checked wrongly")
    if row["outcome"].startswith("crash"):
        found.append("crashed")
    return found


def _told(row: Row, off: float) -> bool:
    """True when the residual that was said is right, or its interval holds it."""
    said, low, high = (row.get(key) for key in ("said_px", "said_low_px", "said_high_px"))
    if said and max(said / off, off / said) <= _TOLD_FACTOR:
        return True
    return low is not None and high is not None and low <= off <= high


def table(rows: list[Row]) -> str:
    """Faults by kind of pair, as a Markdown table."""
    kinds: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        kinds[row["kind"]].append(row)
    lines = [_line("kind", "pairs", "written", *FAULTS), "|---" * (3 + len(FAULTS)) + "|"]
    for kind, members in [*kinds.items(), ("all", rows)]:
        found = [faults(row) for row in members]
        counts = [sum(name in of_one for of_one in found) for name in FAULTS]
        lines.append(_line(kind, len(members), sum(map(is_written, members)), *counts))
    return "\n".join(lines)


def _line(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks bent``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real imagery")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines; a run continues it")
    parser.add_argument("--count", type=int, default=600, help="pairs")
    parser.add_argument("--part", default="tuning", help="'tuning', 'held out', or '' for both")
    parser.add_argument("--kind", default="", help="only this kind")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop starting pairs then")


def run(args: argparse.Namespace) -> int:
    """Run what is missing of the pairs; 1 when any is silently wrong."""
    rows = resume(args.out)
    done = {row["name"] for row in rows}
    wanted = [case for case in bent_cases(args.count, args.part) if args.kind in ("", case.kind)]
    missing = [case for case in wanted if case.name not in done]
    stop = time.monotonic() + 60 * args.minutes
    context = multiprocessing.get_context("spawn")
    with context.Pool(args.processes) as pool, args.out.open("a", encoding="utf-8") as out:
        for row in pool.imap(partial(run_case, data=args.data), missing):
            rows.append(row)
            out.write(json.dumps(row) + "\n")
            out.flush()
            if time.monotonic() > stop:
                pool.terminate()
                break
    print(table(rows))
    return 1 if any("silently wrong" in faults(row) for row in rows) else 0
