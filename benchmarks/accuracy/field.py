"""Pairs that bend and jump: the field against the known truth, its standard error, its time."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.gate.bent_cases import BentPair
from benchmarks.gate.distortions import Tear, waves
from benchmarks.processes import measured, own_environment
from benchmarks.records import Row
from benchmarks.report import machine, replace_section
from benchmarks.scenes.imagery import Imagery, aerial, sentinel2
from benchmarks.scenes.make import Bend, HeaderError, SceneSpec, make_scene, write_scene
from benchmarks.scenes.truth import check_points

Array = NDArray[np.float64]
PAN_PX, MS_PX, RATIO = 2000, 450, 4.0
ENOUGH = 0.95
"""Of the side of PAN: the rest is mirrored."""
TEXTURES = {"satellite": sentinel2, "aerial": aerial}
AMPLITUDES_PX = (1.0, 2.0, 3.0)
LENGTHS_PX = (600, 800, 1200, 1600, 2400)
MOST_LEFT_PX = 0.05
"""``--max-residual``, what one affine may leave: less than is asked of a field."""
MOST_PX, MOST_OF_SHORT_PX, SHORT_PX = 0.06, 0.1, 1200
"""RMSE asked for: of waves from so long on and of what jumps, and of shorter waves."""
JUMP = "jump"
JUMP_PX, JUMP_SHARE = (2.5, 0.6), 0.45
AWAY_MS_PX = 20.0
"""From a jump: a row of patches."""
_TIMEOUT_S = 300.0


@dataclass(frozen=True, slots=True)
class Case:
    """One pair to make.

    Attributes
    ----------
    texture : str
        One of `TEXTURES`.
    amplitude_px, length_px : float
        Of the waves, PAN pixels; 0 and 0 of a jump along a row.
    """

    texture: str
    amplitude_px: float
    length_px: float

    @property
    def name(self) -> str:
        """Unique, and the seed."""
        what = f"{self.amplitude_px:g} px / {self.length_px:g} px" if self.length_px else JUMP
        return f"{self.texture}, {what}"

    def bend(self, side_px: int) -> Bend:
        """What the pair's header does not express, on a PAN raster of that side."""
        if not self.length_px:
            return Tear(JUMP_PX, JUMP_SHARE, 0.0, (side_px, side_px))
        seed = round(1000 * self.amplitude_px + self.length_px)
        return waves(self.amplitude_px, self.length_px, np.random.default_rng(seed))


def cases() -> Iterator[Case]:
    """Every wave on every texture, and a jump on each."""
    for texture in TEXTURES:
        for amplitude in AMPLITUDES_PX:
            yield from (Case(texture, amplitude, length) for length in LENGTHS_PX)
        yield Case(texture, 0.0, 0.0)


def make(case: Case, imagery: Imagery) -> BentPair:
    """The pair of a case; smaller where the imagery is, for mirrored ground would repeat itself."""
    least = min(imagery.shape)
    side = PAN_PX if least > ENOUGH * PAN_PX else least
    ms = round(MS_PX * side / PAN_PX)
    error, bend = HeaderError((2.3, -1.7)), case.bend(side)
    spec = SceneSpec(case.name, case.name, error, (side, side), (ms, ms), RATIO)
    return BentPair(make_scene(spec, imagery, bend), bend)


def run_case(case: Case, pair: BentPair) -> Row:
    """Align one pair in a process of its own, and compare with the truth.

    Returns
    -------
    dict
        ``rmse_px``, ``median_px``, ``best_affine_px``, ``normalised`` error; ``seconds``,
        ``cpu_s`` and ``peak_mb`` of the command, which writes its report and no raster.
    """
    with tempfile.TemporaryDirectory() as name:
        write_scene(pair.scene, Path(name))
        found, cost = _aligned(Path(name))
    return compared(case, pair, found) | cost


def _small_run(case: Case, data: Path, maker: Executor) -> Row:
    """`run_case`, with the pair in another process: what is made here would count as the peak."""
    with tempfile.TemporaryDirectory() as name:
        maker.submit(_make_in, case, data, Path(name)).result()
        found, cost = _aligned(Path(name))
    return maker.submit(_compared_there, case, found).result() | cost


def _aligned(folder: Path) -> tuple[dict[str, Any], Row]:
    """The report of a pair, and what it cost."""
    command = [
        sys.executable, "-m", "geodelreg_cli", "align", "ms.tif", "pan.tif", "--dry-run",
        "--on-local", "field", "--max-residual", str(MOST_LEFT_PX), "--report", "out.json",
        "--quiet",
    ]  # fmt: skip
    usage = measured(command, own_environment(), _TIMEOUT_S, folder)
    found = json.loads((folder / "out.json").read_text("utf-8"))
    return found, {"seconds": usage.wall_s, "cpu_s": usage.cpu_s, "peak_mb": usage.peak_mb}


_made: list[BentPair] = []


@cache
def _imagery(texture: str, data: Path) -> Imagery:
    return TEXTURES[texture](data)


def _make_in(case: Case, data: Path, folder: Path) -> None:
    """Write the rasters of a pair, and keep what is true of it for `_compared_there`."""
    pair = make(case, _imagery(case.texture, data))
    write_scene(pair.scene, folder)
    _made[:] = [pair]


def _compared_there(case: Case, found: dict[str, Any]) -> Row:
    return compared(case, _made[0], found)


def compared(case: Case, pair: BentPair, found: dict[str, Any]) -> Row:
    """A report against the truth."""
    from geodelreg.geo.maps.field import FieldMap

    at = check_points(pair.scene.truth.ms_shape)
    true = pair.pan_px(at)
    row: Row = {
        "case": case.name,
        "outcome": found["verdict"]["outcome"],
        "failed": [r["name"] for r in found["verdict"]["reasons"] if not r["passed"]],
        "model": found["correction"]["model"],
        "best_affine_px": _rms(pair.errors(pair.best_affine())),
    }
    written = found["correction"].get("pixel_map")
    if written is None or written["kind"] != "field":
        return row
    correction = FieldMap.from_json(written)
    error = _in_pan(pair, correction.forward(at)) - true
    row["jump_rows"] = written.get("jump_rows", [])
    if not case.length_px:
        border = _jump_row(pair)
        row["true_jump_row"] = border
        error = error[np.abs(at[:, 1] - border) > AWAY_MS_PX]
        at = at[np.abs(at[:, 1] - border) > AWAY_MS_PX]
    sigma = np.hypot(RATIO * correction.sigma_at(at), found["accuracy"]["systematic_px"])
    distance = np.hypot(*error.T)
    return row | {
        "rmse_px": _rms(error),
        "median_px": float(np.median(distance)),
        "normalised": float(np.sqrt(((distance / sigma) ** 2).mean())),
    }


def _in_pan(pair: BentPair, header_px: Array) -> Array:
    from affine import Affine

    truth = pair.scene.truth
    return pair.to_pan(truth, Affine(*truth.ms_header), header_px)


def _jump_row(pair: BentPair) -> float:
    """MS row at which the content jumps."""
    height, width = pair.scene.truth.ms_shape
    rows = np.linspace(0, height, 40 * height)
    at = np.stack([np.full(len(rows), width / 2), rows], axis=1)
    step = np.abs(np.diff(pair.pan_px(at), axis=0)).sum(axis=1)
    return float(rows[np.argmax(step)])


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def _pooled(rows: list[Row]) -> float:
    """RMS over all scenes alike."""
    return float(np.sqrt(np.mean([row["normalised"] ** 2 for row in rows])))


def table(rows: list[Row]) -> str:
    """One line a case, as Markdown."""
    heads = (
        "case", "result", "best affine, px", "RMSE, px", "median, px", "normalised", "s", "CPU s",
        "MB",
    )  # fmt: skip
    lines = [_line(*heads), "|---" * len(heads) + "|"]
    for row in rows:
        result = row["model"] if row["outcome"] == "aligned" else ", ".join(row["failed"])
        if row.get("jump_rows"):
            result += f", jump at row {row['jump_rows'][0]:g}"
        numbers = [_short(row.get(key)) for key in ("rmse_px", "median_px", "normalised")]
        cost = [f"{row[key]:.1f}" for key in ("seconds", "cpu_s")]
        cost.append(f"{row['peak_mb']:.0f}")
        lines.append(_line(row["case"], result, _short(row["best_affine_px"]), *numbers, *cost))
    return "\n".join(lines)


def _short(value: Any) -> str:
    return "–" if value is None else f"{value:.3f}"


def _line(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks field``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real imagery")
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def run(args: argparse.Namespace) -> int:
    """Run the cases; 1 when any is not followed, or not closely enough."""
    rows, close = [], True
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as maker:
        for case in cases():
            if args.only not in case.name:
                continue
            rows.append(_small_run(case, args.data.resolve(), maker))
            short = 0 < case.length_px < SHORT_PX
            close &= rows[-1].get("rmse_px", np.inf) <= (MOST_OF_SHORT_PX if short else MOST_PX)
            print(table(rows[-1:]).splitlines()[-1], flush=True)
    followed = [row for row in rows if "rmse_px" in row]
    text = table(rows)
    if args.docs is not None:
        about = (
            f"`python -m benchmarks field` (`--max-residual {MOST_LEFT_PX:g}`): PAN {PAN_PX}², MS "
            f"{MS_PX}² at 4:1 (smaller where the imagery is), waves of so many PAN px and so "
            f"long, and a jump of {JUMP_PX[0]:g} px along a row (RMSE away from "
            f'it), on {machine()}.  "Normalised" is the error over its standard error, '
            "with the systematic part, RMS.  Time and memory are the whole command's, without "
            "writing pixels.  Median scene: "
            f"{np.median([row['rmse_px'] for row in followed]):.3f} px; normalised error of all "
            f"scenes: {_pooled(followed):.2f}."
        )
        replace_section(args.docs, "field", f"## Fields\n\n{about}\n\n{text}")
    return 0 if close else 1
