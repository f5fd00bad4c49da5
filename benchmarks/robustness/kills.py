"""kill -9 at random times of the real command; afterwards every file is the old or the new one."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import rasterio

from benchmarks.report import replace_section
from benchmarks.robustness.seeds import make_seeds

COMMAND = (sys.executable, "-m", "geodelreg_cli")
PAN_SIDE = 192
_EARLY = 0.4
"""Kills begin at this share of the run: before it, Python and GDAL are being loaded."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One use of the command.

    Attributes
    ----------
    prepare : tuple of tuple of str
        Commands that are run to their end first.
    args : tuple of str
        The command that is killed.
    outputs : tuple of str
        Files that it writes.
    """

    name: str
    args: tuple[str, ...]
    outputs: tuple[str, ...]
    prepare: tuple[tuple[str, ...], ...] = ()


ALIGN = ("align", "ms.tif", "pan.tif", "-q", "-j", "1")
BANDS = ("b1.tif", "b2.tif", "b3.tif")
ALIGN_BANDS = ("align", *BANDS, *ALIGN[2:])
SCENARIOS = (
    Scenario("align -o", (*ALIGN, "-o", "out.tif"), ("out.tif",)),
    Scenario(
        "align -o --overwrite",
        (*ALIGN, "-o", "out.tif", "--overwrite"),
        ("out.tif",),
        ((*ALIGN, "-o", "out.tif", "--co", "COMPRESS=LZW"),),
    ),
    Scenario("align --in-place", (*ALIGN, "--in-place"), ("ms.tif",)),
    Scenario(
        "align --report --gcps",
        (*ALIGN, "--dry-run", "--report", "report.json", "--gcps", "points.geojson"),
        ("report.json", "points.geojson"),
    ),
    Scenario("revert", ("revert", "ms.tif", "-q"), ("ms.tif",), ((*ALIGN, "--in-place"),)),
    Scenario("align B1 B2 B3 --in-place", (*ALIGN_BANDS, "--in-place"), BANDS),
    Scenario(
        "align B1 B2 B3 -o DIR",
        (*ALIGN_BANDS, "-o", "out"),
        tuple(f"out/{band}" for band in BANDS),
    ),
)


@dataclass(slots=True)
class Tally:
    """What came of the kills of one scenario."""

    kills: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    torn: list[str] = field(default_factory=list)


def _run(folder: Path, args: tuple[str, ...]) -> None:
    result = subprocess.run(
        [*COMMAND, *args], cwd=folder, capture_output=True, text=True, check=False
    )
    if result.returncode:
        raise RuntimeError(f"{args}: exit {result.returncode}: {result.stderr}")


def _state(folder: Path) -> dict[str, str]:
    """Name and content of every file, hidden ones too; of a report without its timings."""
    return {
        path.relative_to(folder).as_posix(): _digest(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _digest(path: Path) -> str:
    data = path.read_bytes()
    if path.name == "report.json":
        report = json.loads(data)
        report.pop("timings_s", None)
        data = json.dumps(report, sort_keys=True).encode()
    return hashlib.sha256(data).hexdigest()


def _fresh(folder: Path) -> None:
    folder.mkdir()
    for name, is_pan in (("ms.tif", False), ("pan.tif", True)):
        seeds = make_seeds(is_pan, PAN_SIDE)  # of which one is used
        seed = next(seed for seed in seeds if seed.name == "tiled-deflate")
        (folder / name).write_bytes(seed.files["ms.tif"])
    with rasterio.open(folder / "ms.tif") as dataset:
        profile = dataset.profile | {"count": 1}
        for number, name in enumerate(BANDS, start=1):
            with rasterio.open(folder / name, "w", **profile) as band:
                band.write(dataset.read(number), 1)


def run_scenario(scenario: Scenario, count: int, rng: random.Random, root: Path) -> Tally:
    """Kill one use of the command `count` times."""
    old = root / "old"
    _fresh(old)
    for args in scenario.prepare:
        _run(old, args)
    before, new = _state(old), root / "new"
    shutil.copytree(old, new)
    started = time.monotonic()
    _run(new, scenario.args)
    duration, after = time.monotonic() - started, _state(new)
    tally = Tally()
    while tally.kills < count:
        folder = root / "killed"
        shutil.copytree(old, folder)
        delay = rng.uniform(_EARLY, 1.05) * duration
        # a busy machine makes the first run a poor guess
        duration = _kill_once(folder, scenario, delay, (before, after), tally) or duration
        shutil.rmtree(folder)
    return tally


def _kill_once(
    folder: Path,
    scenario: Scenario,
    delay: float,
    states: tuple[dict[str, str], dict[str, str]],
    tally: Tally,
) -> float | None:
    """Kill one run; seconds that it took when it was faster."""
    started = time.monotonic()
    with subprocess.Popen(
        [*COMMAND, *scenario.args],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        try:
            process.wait(delay)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
    before, after = states
    if process.returncode != -signal.SIGKILL:
        tally.outcomes["ended before"] += 1
        return time.monotonic() - started
    tally.kills += 1
    kinds = {_kind(folder, name, before, after) for name in scenario.outputs}
    unchanged = all(
        _digest(folder / name) == digest
        for name, digest in before.items()
        if name not in scenario.outputs and not name.endswith("undo.json")
    )
    kinds |= set() if unchanged else {"an input was changed"}
    tally.outcomes["old" if kinds == {"old"} else "new" if kinds == {"new"} else "some new"] += 1
    torn = kinds - {"old", "new"}
    if torn:
        tally.torn.append(f"{scenario.name} after {delay:.3f} s: {sorted(torn)}")
    _check_next_run(folder, scenario, after, tally)
    return None


def _kind(folder: Path, name: str, before: dict[str, str], after: dict[str, str]) -> str:
    """Old or new; a raster is also new when only its tail is not yet cut off or added."""
    path = folder / name
    digest = _digest(path) if path.exists() else None
    if digest == before.get(name):
        return "old"
    if digest == after.get(name):
        return "new"
    if path.suffix == ".tif" and digest is not None:
        return _header_kind(folder, name)
    return f"{name} is torn"


def _header_kind(folder: Path, name: str) -> str:
    """Of a raster with unused bytes at its end, as between two steps of an edit in place."""
    with rasterio.open(folder / name) as dataset:
        found = (dataset.transform, dataset.checksum(1))
    for kind in ("old", "new"):
        path = folder.parent / kind / name
        if not path.exists():
            continue
        with rasterio.open(path) as dataset:
            if found == (dataset.transform, dataset.checksum(1)):
                return kind
    return f"{name} is torn"


def _check_next_run(folder: Path, scenario: Scenario, after: dict[str, str], tally: Tally) -> None:
    """The next run of the same command completes the work and leaves nothing else behind.

    Of several files it leaves all new, also when the killed run had replaced but some.
    """
    args = [*scenario.args]
    if args[0] == "align" and "--in-place" not in args and "--overwrite" not in args:
        args.append("--overwrite")
    result = subprocess.run(
        [*COMMAND, *args], cwd=folder, capture_output=True, text=True, check=False
    )
    found = _state(folder)
    done_before = result.returncode and "no record" in result.stderr
    if "--in-place" in args:  # a second edit of an edited file adds to the record
        good = result.returncode == 0 and set(found) == set(after)
        good = good and all(_header_kind(folder, name) == "new" for name in scenario.outputs)
    else:
        good = (result.returncode == 0 or bool(done_before)) and found == after
    if not good:
        extra = sorted(set(found) ^ set(after))
        tally.torn.append(f"{scenario.name}: next run: {result.stderr.strip()} {extra}")


def page(tallies: dict[str, Tally]) -> str:
    """Table in Markdown."""
    lines = ["| command | kills | old files | new files | some new | ended before | torn or lost |"]
    lines.append("|---|---:|---:|---:|---:|---:|---:|")
    for name, tally in tallies.items():
        counts = [tally.outcomes[kind] for kind in ("old", "new", "some new", "ended before")]
        cells = " | ".join(str(count) for count in (tally.kills, *counts, len(tally.torn)))
        lines.append(f"| `{name}` | {cells} |")
    return "\n".join(lines) + "\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks kills``."""
    parser.add_argument("--count", type=int, default=300, help="kills of all commands together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--docs", type=Path, help="page whose table is replaced")


def run(args: argparse.Namespace) -> int:
    """Run all scenarios; 1 when a file was torn or lost."""
    tallies = {}
    for index, scenario in enumerate(SCENARIOS):
        share = args.count // len(SCENARIOS) + (index < args.count % len(SCENARIOS))
        rng = random.Random(f"{args.seed} {scenario.name}")
        with tempfile.TemporaryDirectory() as name:
            tallies[scenario.name] = run_scenario(scenario, share, rng, Path(name))
        done = tallies[scenario.name]
        print(scenario.name, dict(done.outcomes), *done.torn, sep="\n", flush=True)
    text = page(tallies)
    print(text)
    if args.docs:
        replace_section(args.docs, "kills", text)
    return 1 if any(tally.torn for tally in tallies.values()) else 0
