"""False accepts and false refusals of the gate, with the evidence behind each verdict."""

from __future__ import annotations

import argparse
import json
import logging
import math
import multiprocessing
import tempfile
import time
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine

from benchmarks.gate.attempts import outcome_of
from benchmarks.gate.cases import Case, cases, is_there
from benchmarks.gate.page import false_accept, figure, page
from benchmarks.gate.pairs import make_pair
from benchmarks.records import Row, resume
from benchmarks.report import replace_section
from benchmarks.scenes.make import write_scene
from benchmarks.scenes.truth import Truth, grid_rmse

log = logging.getLogger(__name__)


def run_case(case: Case, data: Path) -> Row:
    """Make one pair, align it, and say what came of it.

    Returns
    -------
    dict
        The case, ``outcome``, ``model``, ``rmse_px`` and ``max_px`` over the MS raster,
        ``centre_px``, predicted sigmas, ``evidence`` by name, ``seconds``.  NaN is None.
    """
    scene = make_pair(case, data)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(scene, folder)
        (folder / "truth.json").unlink()
        row = _align(folder, scene.truth)
    row = asdict(case) | {"name": case.name, "part": case.part} | row
    return {key: _plain(value) for key, value in row.items()}


def _align(folder: Path, truth: Truth) -> Row:
    started = time.perf_counter()
    outcome, alignment = outcome_of(folder / "ms.tif", folder / "pan.tif")
    row: Row = {"outcome": outcome, "seconds": time.perf_counter() - started}
    if alignment is None:
        return row | {"evidence": {}}
    row["evidence"] = {r.name: _plain(r.value) for r in alignment.verdict.reasons}
    row["failed"] = [r.name for r in alignment.verdict.reasons if not r.passed]
    if outcome != "refused":
        row |= _errors(alignment.correction.corrected, truth)
        row["model"] = alignment.correction.model
        row["sigma_centre_px"] = alignment.accuracy.sigma_centre_px
        row["sigma_corner_px"] = alignment.accuracy.sigma_corner_px
    return row


def _errors(corrected: Affine, truth: Truth) -> Row:
    """Errors over the MS raster, and at its centre, in PAN pixels."""
    height, width = truth.ms_shape
    to_centre = Affine.translation(width / 2, height / 2)
    true = tuple(Affine(*truth.ms_true) @ to_centre)[:6]
    spot = replace(truth, ms_true=true, ms_shape=(0, 0))
    whole = grid_rmse(corrected, truth)
    return {
        "rmse_px": whole["rmse_px"],
        "max_px": whole["max_px"],
        "centre_px": grid_rmse(corrected @ to_centre, spot)["rmse_px"],
    }


def _plain(value: Any) -> Any:
    """For JSON: None where a number is not finite."""
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks gate``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real imagery")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines; a run continues it")
    parser.add_argument("--count", type=int, default=1000, help="pairs of each group")
    parser.add_argument("--part", default="", help="'tuning' or 'held out' sources; default: both")
    parser.add_argument("--group", default="", help="'hopeless' or 'alignable'; default: both")
    parser.add_argument("--kind", default="", help="only this kind")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop starting pairs then")
    parser.add_argument("--docs", type=Path, help="page whose table is replaced, e.g. docs/gate.md")
    parser.add_argument("--figure", type=Path, help="PNG of the ROC curves")


def _wanted(args: argparse.Namespace) -> list[Case]:
    groups = {"": (False, True), "hopeless": (False,), "alignable": (True,)}[args.group]
    queues = [cases(group, args.count, args.part) for group in groups]
    mixed = [case for together in zip(*queues, strict=True) for case in together]
    there = [case for case in mixed if is_there(case, args.data)]
    if len(there) < len(mixed):
        print(f"{len(mixed) - len(there)} pairs left out: their imagery is not in {args.data}")
    return [case for case in there if args.kind in ("", case.kind)]


def run(args: argparse.Namespace) -> int:
    """Run what is missing of the pairs; 1 when any false accept is among them."""
    rows = resume(args.out)
    done = {row["name"] for row in rows}
    missing = [case for case in _wanted(args) if case.name not in done]
    stop = time.monotonic() + 60 * args.minutes
    work = partial(run_case, data=args.data)
    context = multiprocessing.get_context("spawn")
    with context.Pool(args.processes) as pool, args.out.open("a", encoding="utf-8") as out:
        for row in pool.imap(work, missing):
            rows.append(row)
            out.write(json.dumps(row) + "\n")
            out.flush()
            if time.monotonic() > stop:
                pool.terminate()
                break
    text = page(rows)
    print(text)
    if args.docs:
        replace_section(args.docs, "gate", text)
    if args.figure:
        figure(rows, args.figure)
    return 1 if any(false_accept(row) for row in rows) else 0
