"""The paper's experiments on open data: ``python -m benchmarks paper``."""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from time import process_time
from typing import Any

from affine import Affine

from benchmarks.paper import methods
from benchmarks.paper.ablation import ablate
from benchmarks.paper.scenes import FIGURES, Case, cases, make_pair, sweep_cases
from benchmarks.report import machine
from benchmarks.scenes.imagery import ImageryNotFoundError
from benchmarks.scenes.make import write_scene
from benchmarks.scenes.truth import grid_rmse
from geodelreg.raster.reader import open_raster
from geodelreg.values.points import Status

SEEDS, QUICK_SEEDS = 3, 1
Row = dict[str, Any]


@contextmanager
def staged(case: Case, data: Path) -> Iterator[methods.Stage]:
    """The pair of a case, written to files without its truth, opened as the tool opens it."""
    scene = make_pair(case, data)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(scene, folder)
        with open_raster(folder / "ms.tif") as ms, open_raster(folder / "pan.tif") as pan:
            yield methods.set_stage(ms, pan, scene.truth)


def compare(stage: methods.Stage, with_gate: bool) -> tuple[dict[str, Row], methods.Matched]:
    """Scores of all methods on one pair, and the matches they start from.

    Parameters
    ----------
    stage : Stage
    with_gate : bool
        Also ask the gate about the two methods that the library keeps for comparison.
    """
    start = process_time()
    again = methods.set_stage(stage.pair.source, stage.pair.reference, stage.truth)
    matched, keypoints = methods.match_plainly(again)
    shared_s = process_time() - start
    found = {}
    for name, steps in methods.STEPS_OF.items():
        start = process_time()
        status, counts = methods.run_steps(matched, steps)
        spent = shared_s + process_time() - start
        found[name] = methods.score_keypoints(
            stage, matched, status == Status.KEPT, keypoints | counts, spent
        )
    start = process_time()
    kept, counts = methods.run_mesh(matched)
    spent = shared_s + process_time() - start
    found[methods.MESH] = methods.score_keypoints(stage, matched, kept, keypoints | counts, spent)
    found[methods.OURS] = methods.score_ours(stage)
    rows = {name: asdict(score) for name, score in found.items()}
    for name in (methods.SIFT, methods.READ) if with_gate else ():
        rows[name]["outcome"], rows[name]["accepted_rmse_px"] = methods.gate_on(stage, name)
    return rows, matched


def measure(case: Case, data: Path, with_gate: bool, with_ablation: bool) -> Row:
    """Everything about one case, as JSON has it."""
    with staged(case, data) as stage:
        rows, matched = compare(stage, with_gate)
        row: Row = {**asdict(case), "methods": rows}
        truth = stage.truth
        row["header_px"] = grid_rmse(Affine(*truth.ms_header), truth)["rmse_px"]
        row["e1_truth"] = methods.grey_error(stage, stage.true_map)
        row["pan_per_coarser_px"] = max(stage.pair.pan_px_per_source_px, 1.0)
        passed = methods.run_steps(matched, ())[0] == Status.KEPT
        row["wrong_share"] = float(1 - matched.right[passed].mean()) if passed.any() else math.nan
        if with_ablation:
            row["ablation"] = {k: asdict(v) for k, v in ablate(stage, matched).items()}
    return row


def _measured(todo: list[Case], data: Path, sweep: bool) -> list[Row]:
    rows = []
    for case in todo:
        try:
            row = measure(case, data, not sweep and case.seed == 0, not sweep)
        except ImageryNotFoundError as error:
            print(f"{case.name}: skipped, {error}")
            continue
        rows.append(row)
        cells = (f"{s['true_rmse_px']:.3f}" for s in row["methods"].values())
        print(f"{case.name}: " + " / ".join(cells) + " px", flush=True)
    return rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks paper``."""
    parser.add_argument("--data", type=Path, required=True, help="folder of real imagery")
    parser.add_argument("--out", type=Path, required=True, help="JSON file of the results")
    parser.add_argument("--docs", type=Path, help="page whose sections are replaced")
    parser.add_argument("--reuse", action="store_true", help="draw what FILE has, measure nothing")
    parser.add_argument("--quick", action="store_true", help="one seed, coarse sweeps")


def run(args: argparse.Namespace) -> int:
    """Measure, print the tables, write the figures and the page."""
    if not args.reuse:
        started = process_time()
        results: Row = {
            "pairs": _measured(cases(QUICK_SEEDS if args.quick else SEEDS), args.data, False),
            "sweeps": _measured(sweep_cases(args.quick), args.data, True),
            "machine": machine(),
        }
        results["cpu_min"] = (process_time() - started) / 60
        args.out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    results = json.loads(args.out.read_text(encoding="utf-8"))
    from benchmarks.paper import page

    print(page.summary(results))
    if args.docs:
        from benchmarks.paper import figures

        images = args.docs.parent / "images"
        figures.draw_sweeps(results["sweeps"], images)
        figures.draw_ablation(results["pairs"], images / "paper_ablation.png")
        registered = {}
        for title, case in FIGURES.items():
            with staged(case, args.data) as stage:
                name = title.lower().replace(" ", "").replace(",", "_")
                figures.draw_matches(stage, case, images / f"paper_{name}.png")
                registered[title] = figures.registered_images(stage)
        figures.draw_registered(registered, images / "paper_registered.png")
        page.write(results, args.docs)
    return 0
