"""Many pairs: throughput, Dask, kills, and a manifest of a hundred thousand."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.batch import cluster as dask
from benchmarks.batch.kills import run_kills
from benchmarks.batch.pairs import write_pairs
from benchmarks.processes import own_environment
from benchmarks.report import machine, replace_section

LEAST_SPEEDUP, MOST_OVERHEAD = 1.8, 0.05
MOST_MB, MOST_PLAN_S, MOST_LEDGER_MS = 500.0, 60.0, 1.0
HEAD = """`python -m benchmarks batch --folder DIR` ({}). A small pair is
PAN 440² and MS 110² × 4, cut from the sample. In the huge manifest the pairs only wait, as long as
recorded ones took, scaled; plan, ledger, driver and Dask's scheduler are real.

| promise | measured | kept |
|---|---|---|"""

PARTS = ("speed", "dask", "kills", "large")


def measure_speed(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One process and two; the overhead is what the processes' time holds beside the pairs'."""
    found: dict[str, Any] = {}
    for workers in (1, 2):
        dask.forget(folder)
        wall, code = dask.batch(folder, "-j", str(workers))
        assert code == 0, code
        pairs = sum(float(row["duration_s"]) for row in dask.table(folder, set()))
        found |= {f"wall_{workers}_s": wall, f"pairs_{workers}_s": pairs}
        found[f"overhead_{workers}"] = workers * wall / pairs - 1
    found["speedup"] = found["wall_1_s"] / found["wall_2_s"]
    _record(folder)
    return found


def measure_dask(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """The same pairs here and on a cluster of two workers."""
    expected, rows = _calm(folder)
    with dask.running_cluster(folder) as cluster:
        dask.forget(folder)
        wall, code = dask.batch(folder, "--dask", cluster.address)
    found = dask.outputs(folder)
    return {
        "wall_s": wall,
        "exit": code,
        "same_bytes": sum(found.get(name) == data for name, data in expected.items()),
        "same_rows": sum(a == b for a, b in zip(rows, dask.table(folder), strict=True)),
        "outputs": len(expected),
    }


def measure_kills(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Kill -9 at random."""
    expected, _ = _calm(folder)
    tally = run_kills(folder, expected, args.kills, args.seed)
    return {
        "kills": dict(tally.kills),
        "rounds": tally.rounds,
        "pairs": tally.pairs,
        "run_again": tally.repeated,
        "wrong": tally.wrong,
    }


def measure_large(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """A manifest of very many pairs."""
    recorded = folder / "recorded.jsonl"
    if not recorded.exists():
        _calm(folder)
    with tempfile.TemporaryDirectory(dir=folder) as name:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.batch.large", name, str(recorded), str(args.many)],
            env=own_environment(), stdout=subprocess.PIPE, text=True, check=True,
        )  # fmt: skip
    return dict(json.loads(done.stdout.splitlines()[-1]))


MEASURES: dict[str, Callable[[Path, argparse.Namespace], dict[str, Any]]] = {
    "speed": measure_speed,
    "dask": measure_dask,
    "kills": measure_kills,
    "large": measure_large,
}


def _calm(folder: Path) -> tuple[dict[str, bytes], list[dict[str, str]]]:
    """Outputs and table of an undisturbed run on this machine."""
    ledger = folder / "pairs.ledger"
    finished = "SELECT count(*) FROM pairs WHERE outcome IS NOT 'aligned'"
    if not ledger.exists() or dask.query(ledger, finished) != [(0,)]:
        dask.forget(folder)
        _, code = dask.batch(folder)
        assert code == 0, code
    _record(folder)
    return dask.outputs(folder), dask.table(folder)


def _record(folder: Path) -> None:
    """Keep what the pairs answered, for `measure_large`."""
    rows = dask.query(folder / "pairs.ledger", "SELECT result FROM outcomes")
    text = "".join(f"{row[0]}\n" for row in rows)
    (folder / "recorded.jsonl").write_text(text, encoding="utf-8")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks batch``."""
    parser.add_argument("--folder", type=Path, required=True, help="where the pairs are made")
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--many", type=int, default=100_000, help="pairs of the huge manifest")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=PARTS, nargs="+", default=list(PARTS))
    parser.add_argument("--out", type=Path, help="JSON that the figures are added to")
    parser.add_argument("--docs", type=Path, help="page whose table is replaced, out of --out")


def run(args: argparse.Namespace) -> int:
    """Measure; 1 when a promise was not kept."""
    found: dict[str, Any] = {}
    if args.out and args.out.exists():
        found = json.loads(args.out.read_text())
    for part in args.only:
        folder = args.folder / f"{args.pairs}"
        if not (folder / "pairs.csv").exists():
            write_pairs(folder, args.pairs)
        on = machine()
        found[part] = MEASURES[part](folder, args) | {"of": args.pairs, "machine": on}
        print(json.dumps({part: found[part]}, indent=2), flush=True)
        if args.out:
            args.out.write_text(json.dumps(found, indent=2) + "\n")
    if args.docs:
        replace_section(args.docs, "batch", page(found))
    return 0 if all(kept for _, _, kept in _promises(found)) else 1


Promise = tuple[str, str, bool]


def _promises(found: dict[str, Any]) -> list[Promise]:
    """What is promised, what was measured, and whether that is enough."""
    texts = {"speed": _of_speed, "dask": _of_dask, "kills": _of_kills, "large": _of_large}
    return [line for part in PARTS if part in found for line in texts[part](found[part])]


def _of_speed(speed: dict[str, Any]) -> list[Promise]:
    label = f"{speed['of']} small pairs"
    walls = f"{speed['wall_1_s']:.0f} s and {speed['wall_2_s']:.0f} s"
    one, two = speed["overhead_1"], speed["overhead_2"]
    overhead = f"{one:.1%} with one process, {two:.1%} with two"
    return [
        (
            f"{label}: two processes ≥ 1.8 × one",
            f"{speed['speedup']:.2f} × ({walls})",
            speed["speedup"] >= LEAST_SPEEDUP,
        ),
        (f"{label}: overhead ≤ 5 % of the pairs' time", overhead, max(one, two) <= MOST_OVERHEAD),
    ]


def _of_dask(same: dict[str, Any]) -> list[Promise]:
    whole = same["same_bytes"] == same["same_rows"] == same["outputs"]
    got = f"{same['same_bytes']} outputs and {same['same_rows']} rows of {same['outputs']}"
    what = "two workers of Dask: the same bytes, the same table but for timings"
    return [(what, got, whole and same["exit"] == 0)]


def _of_kills(kills: dict[str, Any]) -> list[Promise]:
    listed = ", ".join(f"{n} {kind}" for kind, n in sorted(kills["kills"].items()))
    got = f"{kills['pairs']} pairs in {kills['rounds']} rounds, {kills['run_again']} run again"
    what = f"kill -9 at random ({listed}): one outcome each, none lost, no debris"
    return [(what, f"{got}, {len(kills['wrong'])} wrong", not kills["wrong"])]


def _of_large(large: dict[str, Any]) -> list[Promise]:
    label = f"{large['pairs']:,} pairs".replace(",", " ")
    plan_s, peak_mb, ledger_ms = (large[n] for n in ("plan_s", "peak_mb", "ledger_ms_per_pair"))
    rate, cpu_ms = large["pairs"] / large["run_s"], large["run_cpu_ms_per_pair"]
    ledger = f"{ledger_ms:.2f} ms"
    through = f"{rate:.0f} pairs/s, {cpu_ms:.2f} ms of the driver's CPU"
    return [
        (f"{label}: driver ≤ 500 MB", f"{peak_mb:.0f} MB", peak_mb <= MOST_MB),
        (f"{label}: planned in seconds", f"{plan_s:.1f} s", plan_s <= MOST_PLAN_S),
        (f"{label}: ledger ≤ 1 ms a pair", ledger, ledger_ms <= MOST_LEDGER_MS),
        (f"{label}: through driver and scheduler", through, True),
    ]


def page(found: dict[str, Any]) -> str:
    """Section of a page."""
    rows = [
        f"| {what} | {got} | {'yes' if kept else '**no**'} |"
        for what, got, kept in _promises(found)
    ]
    machines = dict.fromkeys(found[part]["machine"] for part in PARTS if part in found)
    return "\n".join(["## Measured", "", HEAD.format("; ".join(machines)), *rows])
