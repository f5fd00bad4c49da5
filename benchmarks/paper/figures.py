"""The paper's figures on our pairs: matches with their triangulations, sweeps, ablation."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy import ndimage

from benchmarks.paper.methods import (
    METHODS,
    STEPS,
    STEPS_OF,
    Matched,
    Stage,
    corrections,
    match_plainly,
    run_steps,
    true_rmse,
)
from benchmarks.paper.page import CONTAMINATION, MEASURES, effect, group, spread_of
from benchmarks.paper.scenes import Case
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.geo.triangulation import delaunay
from geodelreg.values.points import Status
from geodelreg.values.raster import Band, BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = dict[str, Any]
COLOURS = dict(zip(METHODS, ("#d1495b", "#e07a3f", "#edae49", "#66a182", "#1f4e79"), strict=True))
MARKERS = dict(zip(METHODS, "oDs^*", strict=True))
RIGHT, WRONG, MESH = "#ffcf33", "#ff3b3b", "#35d0ff"
LINES_AT_MOST = 60
FINE_MESH = 600
PALETTE = 128
WORST_PX = 1000.0
BOARD_CELLS = 8
MS_TINT = np.array([0.75, 0.88, 1.0])
Registered = list[tuple[str, FloatArray]]


def save(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a PNG with a small palette: grey images need no more, and pages load faster."""
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=dpi, metadata={"Software": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.open(buffer).convert("RGB")
    # this method keeps rare colours, as those of a few wrong matches
    few = image.quantize(PALETTE, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def draw_matches(stage: Stage, case: Case, path: Path) -> None:
    """Figs. 4 to 7 of the paper: the matches that each of its methods keeps, on both images.

    Parameters
    ----------
    stage : Stage
    case : Case
        For the title.
    path : Path
    """
    matched, _ = match_plainly(stage)
    figure = Figure(figsize=(6.6, 10.4), layout="constrained")
    for axes, (title, steps) in zip(figure.subplots(3, 1), STEPS_OF.items(), strict=True):
        kept = run_steps(matched, steps)[0] == Status.KEPT
        _draw_pair(axes, stage, matched, kept)
        wrong = int((kept & ~matched.right).sum())
        axes.set_title(f"{title}: {int(kept.sum())} matches, {wrong} of them wrong", fontsize=10)
    what = {"rotation": f", {case.value:g}°", "translation": f", {case.value:g} px"}
    figure.suptitle(
        f"{case.condition}{what.get(case.condition, '')} ({case.source}, {case.ratio:g}:1): "
        "MS left, PAN right;\nright matches yellow, wrong ones red",
        fontsize=10,
    )
    save(figure, path, 80)


def _draw_pair(axes: Axes, stage: Stage, matched: Matched, kept: BoolArray) -> None:
    bands = [stage.images.source[1 % len(stage.images.source)], stage.images.reference]
    places = [matched.source_xy[kept], matched.reference_xy[kept]]
    right, left = matched.right[kept], 0.0
    shown = []
    for band, xy in zip(bands, places, strict=True):
        height, width = band.data.shape
        axes.imshow(
            _grey(band), cmap="gray", vmin=0, vmax=1, extent=(left, left + width, height, 0)
        )
        shown.append(xy + np.array([left, 0.0]))
        triangles = delaunay(xy)
        if len(triangles):
            width_pt = 0.4 if len(triangles) > FINE_MESH else 0.9
            axes.triplot(
                shown[-1][:, 0], shown[-1][:, 1], triangles, color=MESH, lw=width_pt, alpha=0.7
            )
        left += 1.05 * width
    for mask, colour, width in ((right, RIGHT, 0.5), (~right, WRONG, 0.7)):
        chosen = np.flatnonzero(mask)
        chosen = chosen[:: max(1, len(chosen) // LINES_AT_MOST)]
        lines = np.stack([shown[0][chosen], shown[1][chosen]], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=colour, lw=width, alpha=0.8))
        for xy in shown:
            axes.scatter(xy[mask, 0], xy[mask, 1], s=4, c=colour, lw=0, zorder=4)
    axes.set_axis_off()


def _grey(band: Band) -> FloatArray:
    low, high = np.percentile(band.data[band.valid], (1, 99))
    image = np.clip((band.data - low) / max(high - low, 1e-9), 0, 1) ** 0.7
    # few grey levels: colour is for the matches, and the file stays small
    return np.asarray(np.round(image * 14) / 14, dtype=np.float64)


def registered_images(stage: Stage) -> Registered:
    """Figs. 4 to 7 (i) of the paper: MS as each method registers it, on a board with PAN.

    Returns
    -------
    list of (str, (H, W, 3) float64)
        A title, and squares of MS (blue) and of PAN (grey) by turns, on PAN's grid.
    """
    pair, pan = stage.pair, stage.images.reference
    ms = stage.images.source[1 % len(stage.images.source)]
    to_pan = ~pair.reference.grid.transform @ pan.grid.transform
    to_ms = ~ms.grid.transform @ pair.source.grid.transform
    rows, columns = np.indices(pan.data.shape)
    places = np.stack(to_pan @ (columns + 0.5, rows + 0.5), axis=-1)
    square = max(pan.data.shape) / BOARD_CELLS
    odd = ((rows // square + columns // square) % 2).astype(bool)
    found: Registered = []
    for method, correction in corrections(stage).items():
        board = np.repeat(_grey(pan)[:, :, None], 3, axis=2)
        if correction is not None:
            there = Inverse(pair.to_reference(correction)).forward(places)
            x, y = to_ms @ tuple(np.moveaxis(there, -1, 0))
            index = [y - 0.5, x - 0.5]
            grey = ndimage.map_coordinates(_grey(ms), index, order=1, cval=np.nan)
            board[odd] = grey[odd, None] * MS_TINT
        title = f"{method}: {true_rmse(stage, correction):.2g} px off"
        found.append((title, np.nan_to_num(board, nan=1.0)))
    return found


def draw_registered(rows: dict[str, Registered], path: Path) -> None:
    """The registered images of all figures, a line for each."""
    figure = Figure(figsize=(9.6, 7.6), layout="constrained")
    grid = figure.subplots(len(rows), len(next(iter(rows.values()))), squeeze=False)
    for line, (name, images) in zip(grid, rows.items(), strict=True):
        for axes, (title, board) in zip(line, images, strict=True):
            axes.imshow(board, vmin=0, vmax=1)
            axes.set_title(title, fontsize=7)
            axes.set_xticks([])
            axes.set_yticks([])
        line[0].set_ylabel(f"{name} (i)")
    save(figure, path, 80)


def draw_sweeps(rows: list[Row], folder: Path) -> None:
    """Correct rate and true RMSE over rotation and over translation, one figure each."""
    for kind, label in (
        ("rotation", "rotation, degrees"),
        ("translation", "translation, PAN px"),
    ):
        figure = Figure(figsize=(10.0, 6.4), layout="constrained")
        ratios = sorted({row["ratio"] for row in rows})
        grid = figure.subplots(2, len(ratios), squeeze=False, sharex=True, sharey="row")
        for column, ratio in enumerate(ratios):
            part = sorted(group(rows, kind, ratio), key=lambda row: float(row["value"]))
            _draw_sweep(list(grid[:, column]), part)
            grid[0, column].set_title(f"{ratio:g}:1")
            grid[1, column].set_xlabel(label)
        grid[0, 0].set_ylabel("correct rate, %")
        grid[1, 0].set_ylabel("true RMSE, PAN px")
        grid[0, 0].legend(fontsize=8)
        save(figure, folder / f"paper_{kind}.png")


def _draw_sweep(axes: Sequence[Axes], part: list[Row]) -> None:
    x = [row["value"] for row in part]
    for method in METHODS:
        scores = [row["methods"][method] for row in part]
        rate = [100 * s["right"] / s["kept"] if s["kept"] else np.nan for s in scores]
        error = [min(e, WORST_PX) if (e := s["true_rmse_px"]) == e else WORST_PX for s in scores]
        look: dict[str, Any] = {
            "color": COLOURS[method],
            "marker": MARKERS[method],
            "ms": 4,
            "lw": 1.1,
        }
        axes[0].plot(x, rate, label=method, **look)
        axes[1].plot(x, error, **look)
    axes[1].axhline(1.0, color="0.5", lw=0.8, ls=":")
    axes[1].set_yscale("log")
    for one in axes:
        one.grid(alpha=0.3)


def draw_ablation(rows: list[Row], path: Path) -> None:
    """What leaving each step in changes, by condition, with intervals over sources."""
    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    grid = figure.subplots(2, len(MEASURES), sharey=True, sharex="col")
    for line, (alone, title) in enumerate(
        ((True, "the step alone\nagainst none"), (False, "all steps\nagainst all but it"))
    ):
        for axes, (measure, label) in zip(grid[line], MEASURES, strict=True):
            _draw_effects(axes, rows, measure, alone)
            if line:
                axes.set_xlabel(label, fontsize=8)
        grid[line, 0].set_yticks(range(len(STEPS)), list(STEPS))
        grid[line, 0].set_ylabel(title)
    grid[0, 0].invert_yaxis()
    grid[0, -1].legend(fontsize=7, loc="best")
    save(figure, path)


def _draw_effects(axes: Axes, rows: list[Row], measure: str, alone: bool) -> None:
    for index, condition in enumerate(CONTAMINATION):
        part = group(rows, condition)
        found = np.array([
            spread_of(part, [effect(row, step, measure, alone) for row in part]) for step in STEPS
        ])  # fmt: skip
        y = np.arange(len(STEPS)) + 0.14 * (index - (len(CONTAMINATION) - 1) / 2)
        bars = np.abs(found[:, 1:].T - found[:, 0])
        axes.errorbar(found[:, 0], y, xerr=bars, fmt="o", ms=3.5, lw=1.0, label=condition)
    is_ratio = measure.endswith("_px")
    axes.axvline(1.0 if is_ratio else 0.0, color="0.4", lw=0.8)
    if is_ratio:
        axes.set_xscale("log")
    axes.grid(alpha=0.3)
