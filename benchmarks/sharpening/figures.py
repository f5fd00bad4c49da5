"""Curves of what misalignment costs, and crops of what it looks like."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import geodelreg
from benchmarks.sharpening.pairs import Known

if TYPE_CHECKING:
    from benchmarks.sharpening.wald import Row

_CROPPED = {"landsat8_momotombo": "wald_volcano.png", "sentinel2 4:1": "wald_coast.png"}
_CROP_PX = 120


def draw_curves(rows: list[Row], path: Path) -> None:
    """ERGAS and SAM of each pair against the misalignment, as it is and aligned."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = figure.subplots(1, 2)
    names = list(dict.fromkeys(row.pair for row in rows))
    for axes, figures, label in zip(panels, ("ergas", "sam_deg"), ("ERGAS", "SAM"), strict=True):
        for number, name in enumerate(names):
            mine = [row for row in rows if row.pair == name]
            errors = [row.error_px for row in mine]
            best = getattr(mine[0].before, figures)
            for part, style in (("before", "-"), ("after", ":")):
                rise = [100 * (getattr(getattr(r, part), figures) / best - 1) for r in mine]
                axes.plot(errors, rise, style, color=f"C{number}", lw=1.5,
                          label=name if part == "before" else None)  # fmt: skip
        axes.set_xlabel("misalignment, PAN px")
        axes.set_ylabel(f"{label} above that of the true header, %")
        axes.set_yscale("symlog", linthresh=10)
        axes.axhline(5, color="0.6", lw=0.8)
        axes.spines[["top", "right"]].set_visible(False)
    panels[1].legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    panels[0].set_title("full: as it is; dotted: aligned", fontsize=9)
    figure.savefig(path, dpi=90)


def draw_crops(known: Known, folder: Path, images: Path) -> None:
    """The reference, and what is sharpened from the last files in a folder, as is and aligned."""
    if known.name not in _CROPPED:
        return
    from matplotlib.figure import Figure

    from benchmarks.sharpening.wald import sharpened

    alignment = geodelreg.align(folder / "ms.tif", folder / "pan.tif")
    panels = {
        "MS itself": known.reference,
        "sharpened, 3 PAN px off": sharpened(known, folder, None),
        "sharpened, aligned": sharpened(known, folder, alignment),
    }
    rows, columns = _busiest(known.pan)
    shown = known.reference[[2, 1, 0]][:, rows, columns]
    limits = np.percentile(shown, (1, 99), axis=(1, 2))
    figure = Figure(figsize=(7.2, 2.6), layout="constrained")
    for axes, (title, image) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        crop = np.moveaxis(image[[2, 1, 0]][:, rows, columns].astype(np.float64), 0, -1)
        axes.imshow(np.clip((crop - limits[0]) / (limits[1] - limits[0]), 0, 1) ** 0.8)
        axes.set_title(title, fontsize=8)
        axes.set_axis_off()
    figure.savefig(images / _CROPPED[known.name], dpi=100)


def _busiest(pan: NDArray[Any]) -> tuple[slice, slice]:
    """Rows and columns of a crop with much to see, away from the edges."""
    best, place = -1.0, (0, 0)
    side = min(_CROP_PX, *(n // 2 for n in pan.shape))
    for top in range(side // 4, pan.shape[0] - side, side // 2):
        for left in range(side // 4, pan.shape[1] - side, side // 2):
            spread = float(np.std(pan[top : top + side, left : left + side]))
            if spread > best:
                best, place = spread, (top, left)
    return slice(place[0], place[0] + side), slice(place[1], place[1] + side)
