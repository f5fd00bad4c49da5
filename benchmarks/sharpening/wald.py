"""What misalignment costs a sharpened image, and what alignment gives back: Wald's protocol."""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

import geodelreg
from benchmarks.records import resume
from benchmarks.report import machine, replace_section
from benchmarks.sharpening.pairs import Known, known_pairs
from benchmarks.sharpening.quality import Quality, quality_of
from geodelreg.errors import AlignmentRefusedError

ERRORS_PX = (0.0, 0.25, 0.5, 1.0, 2.0, 3.0)
_DIRECTION = (0.8, -0.6)
"""Columns and rows of a misalignment by one PAN pixel."""
_MARGIN_PX = 16
_MATTERS = 0.05
"""Share by which ERGAS may rise before a misalignment is said to matter."""

_HEADING = """## What alignment is worth to pansharpening

`python -m benchmarks wald --data DIR --docs docs/benchmarks.md` ({machine}).
Wald's protocol: MS and PAN are averaged down by their ratio and sharpened with
`geodelreg pansharpen`; the result is compared with MS itself. Real pairs have a PAN of its own
sensor. `sample_tiles` lies where its `truth.json` says. Of the others PAN is a sum of the bands of
a real image, with 0.3 % of noise. The header of MS is then wrong by so many PAN pixels. ERGAS, SAM,
SCC and QNR are those of sewar. No kept package has Q2n, so it is the benchmark's own, tested
against quaternions. ERGAS and SAM are best at 0, the others at 1."""
_IMAGES = """![ERGAS and SAM against the misalignment](images/wald.png)

Crops of a real pair at 2:1 and of a simulated one at 4:1, 3 PAN px off:

![A volcano, 2:1](images/wald_volcano.png)
![A coast, 4:1](images/wald_coast.png)"""


@dataclass(frozen=True, slots=True)
class Row:
    """A pair at one misalignment: without alignment, and after `align`.

    `found_px` is what alignment left of the misalignment, NaN where it refused.
    """

    pair: str
    is_real: bool
    ratio: int
    error_px: float
    verdict: str
    left_px: float
    before: Quality
    after: Quality


def rows_of(known: Known, folder: Path, errors_px: tuple[float, ...] = ERRORS_PX) -> list[Row]:
    """Sharpen a pair at every misalignment, as it is and aligned."""
    pan = folder / "pan.tif"
    _write(pan, known.pan[None], known.transform, known)
    rows = []
    for error_px in errors_px:
        off = Affine.translation(*(error_px * part for part in _DIRECTION))
        header = known.transform @ off @ Affine.scale(known.ratio)
        ms = folder / "ms.tif"
        _write(ms, known.ms, header, known)
        before = _sharpened_quality(known, folder, None)
        try:
            alignment = geodelreg.align(ms, pan)
            after = _sharpened_quality(known, folder, alignment)
            centre = np.array(known.ms.shape[:0:-1]) / 2
            true = ~known.transform @ (known.transform @ Affine.scale(known.ratio) @ tuple(centre))
            there = ~known.transform @ (alignment.correction.corrected @ tuple(centre))
            verdict = alignment.verdict.outcome.value
            left_px = float(np.hypot(*np.subtract(there, true)))
        except AlignmentRefusedError:
            verdict, after, left_px = "refused", before, float("nan")
        rows.append(
            Row(known.name, known.is_real, known.ratio, error_px, verdict, left_px, before, after)
        )
    return rows


def _write(path: Path, data: NDArray[np.float32], transform: Affine, known: Known) -> None:
    count, height, width = data.shape
    with rasterio.open(
        path, "w", driver="GTiff", count=count, height=height, width=width, dtype="uint16",
        crs=known.crs_wkt, transform=transform,
    ) as dataset:  # fmt: skip
        dataset.write(np.clip(np.rint(data), 0, 65535).astype("uint16"))


def _sharpened_quality(
    known: Known, folder: Path, alignment: geodelreg.Alignment | None
) -> Quality:
    image = sharpened(known, folder, alignment)
    inner = slice(_MARGIN_PX * known.ratio, -_MARGIN_PX * known.ratio)
    truth = np.moveaxis(known.reference, 0, -1).astype(np.float64)[inner, inner]
    low = np.moveaxis(known.ms, 0, -1).astype(np.float64)[_MARGIN_PX:-_MARGIN_PX][
        :, _MARGIN_PX:-_MARGIN_PX
    ]
    wide = np.moveaxis(image, 0, -1).astype(np.float64)[inner, inner]
    return quality_of(wide, truth, low, known.pan.astype(np.float64)[inner, inner], known.ratio)


def sharpened(known: Known, folder: Path, alignment: geodelreg.Alignment | None) -> NDArray[Any]:
    """(B, H, W) image sharpened from the files in a folder, on the grid of PAN."""
    out = folder / "sharp.tif"
    geodelreg.pansharpen(
        folder / "ms.tif", folder / "pan.tif", out,
        alignment=alignment, overwrite=True, bit_depth=known.bit_depth,
    )  # fmt: skip
    with rasterio.open(out) as dataset:
        return np.asarray(dataset.read())


def _row(fields: dict[str, Any]) -> Row:
    kept = {name: Quality(**fields[name]) for name in ("before", "after")}
    return Row(**(fields | kept))


def matters_px(rows: list[Row]) -> float:
    """Misalignment at which ERGAS is 5 % above that without one, between the ones measured."""
    errors = [row.error_px for row in rows]
    rise = [row.before.ergas / rows[0].before.ergas - 1 for row in rows]
    for number in range(1, len(rows)):
        if rise[number] >= _MATTERS:
            low, high = rise[number - 1], rise[number]
            share = (_MATTERS - low) / (high - low)
            return errors[number - 1] + share * (errors[number] - errors[number - 1])
    return float("inf")


def page(rows: list[Row]) -> str:
    """Markdown of all pairs, and at which misalignment it begins to matter."""
    pairs: dict[str, list[Row]] = {}
    for row in rows:
        pairs.setdefault(row.pair, []).append(row)
    lines = [
        "| pair | ratio | off, px | ERGAS as is → aligned | SAM, ° | SCC | Q2n | QNR | left, px |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [
            f"{getattr(row.before, name):.{digits}f} → {getattr(row.after, name):.{digits}f}"
            for name, digits in (("ergas", 2), ("sam_deg", 2), ("scc", 3), ("q2n", 3), ("qnr", 3))
        ]
        left = "refused" if row.verdict == "refused" else f"{row.left_px:.3f}"
        kind = "real" if row.is_real else "simulated"
        lines.append(
            f"| {row.pair} ({kind}) | {row.ratio} | {row.error_px:g} | {' | '.join(cells)} "
            f"| {left} |"
        )
    worst, worst_sam = (
        100 * max((_loss(row, pairs[row.pair][0], name) for row in rows), default=float("nan"))
        for name in ("ergas", "sam_deg")
    )
    lines += [
        "",
        (
            f"Aligned, ERGAS is at worst {worst:+.1f} % off that of the true header, SAM "
            f"{worst_sam:+.1f} %, where `align` does not refuse."
        ),
        "",
        "Misalignment that raises ERGAS by 5 %, and what 1 and 3 PAN px cost in ERGAS:",
        "",
        "| pair | ratio | 5 % worse from, PAN px | the same, MS px | at 1 PAN px | at 3 PAN px |",
        "|---|---|---|---|---|---|",
    ]
    for name, mine in pairs.items():
        limit = matters_px(mine)
        costs = [
            f"{100 * (row.before.ergas / mine[0].before.ergas - 1):+.0f} %"
            for row in mine
            if row.error_px in (1.0, 3.0)
        ]
        lines.append(
            f"| {name} | {mine[0].ratio} | {limit:.2f} | {limit / mine[0].ratio:.2f} "
            f"| {' | '.join(costs)} |"
        )
    return "\n".join(lines)


def _loss(row: Row, best: Row, name: str) -> float:
    """Share by which an aligned pair is worse than one whose header is right."""
    if row.verdict == "refused":
        return float("-inf")
    return float(getattr(row.after, name) / getattr(best.before, name) - 1)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks wald``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real rasters")
    parser.add_argument("--only", default="", help="beginnings of names, comma-separated")
    parser.add_argument("--out", type=Path, help="file of JSON lines; pairs in it are done")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")
    parser.add_argument("--images", type=Path, help="folder for the plot and the crops")


def run(args: argparse.Namespace) -> int:
    """Sharpen every pair at every misalignment; print the tables."""
    wanted = tuple(name for name in args.only.split(",") if name)
    rows = [] if args.out is None else [_row(row) for row in resume(args.out)]
    done = {row.pair for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        for known in known_pairs(args.data):
            if known.name in done or (wanted and not known.name.startswith(wanted)):
                continue
            found = rows_of(known, Path(folder))
            rows += found
            if args.out is not None:
                with args.out.open("a", encoding="utf-8") as lines:
                    lines.writelines(json.dumps(asdict(row)) + "\n" for row in found)
            print(f"{known.name}: from {matters_px(found):.2f} PAN px", flush=True)
            if args.images:
                from benchmarks.sharpening.figures import draw_crops

                draw_crops(known, Path(folder), args.images)
    text = page(rows)
    print(text)
    if args.images:
        from benchmarks.sharpening.figures import draw_curves

        draw_curves(rows, args.images / "wald.png")
    if args.docs:
        heading = _HEADING.format(machine=machine())
        replace_section(args.docs, "wald", f"{heading}\n\n{text}\n\n{_IMAGES}")
    return 0
