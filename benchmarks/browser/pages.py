"""Pages to open: a good pair, a refused one, names from strangers, and a batch of 200 pairs."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

import geodelreg
from geodelreg.batch.figures import figures_of
from geodelreg.batch.job import PairResult
from geodelreg.batch.tables import write_table
from geodelreg.errors import AlignmentRefusedError
from geodelreg.geo.lonlat import footprint
from geodelreg.report.index import PAGES, page_name
from geodelreg.values.result import Alignment

SAMPLE = Path(__file__).resolve().parents[2] / "sample_tiles"
PAIRS = 200
HOSTILE = "\"><img src=x onerror=alert(1)><script>alert(2)</script>\u202e'"
_STEP_DEG = 0.12
_COLUMNS = 20


@dataclass(frozen=True, slots=True)
class Pages:
    """Where they are.

    Attributes
    ----------
    good, refused, hostile, index : Path
    """

    good: Path
    refused: Path
    hostile: Path
    index: Path

    def named(self) -> dict[str, Path]:
        """Each with a name."""
        names = ("good", "refused", "hostile", "index")
        return {name: getattr(self, name) for name in names}


def make_pages(folder: Path) -> Pages:
    """Align the sample pair, refuse one of noise, and make all pages in a folder."""
    for name in ("ms.tif", "pan.tif"):
        shutil.copy(SAMPLE / name, folder)
    pages = Pages(*(folder / f"{name}.html" for name in ("good", "refused", "hostile", "index")))
    good = geodelreg.align(str(folder / "ms.tif"), str(folder / "pan.tif"))
    geodelreg.write_report(good, pages.good)
    with rasterio.open(folder / "pan.tif") as dataset:
        profile = dataset.profile
    with rasterio.open(folder / "noise.tif", "w", **profile) as out:
        shape = (profile["height"], profile["width"])
        noise = np.random.default_rng(1).integers(1, 4000, shape)
        out.write(noise.astype(profile["dtype"]), 1)
    geodelreg.write_report(_refused(folder), pages.refused)
    with rasterio.open(folder / "ms.tif", "r+") as dataset:
        dataset.descriptions = tuple(f"{HOSTILE}{n}" for n in dataset.indexes)
    named = folder / f"{HOSTILE.replace('/', '_')}.tif"
    (folder / "ms.tif").rename(named)
    geodelreg.write_report(
        replace(good, source=replace(good.source, paths=(str(named),))), pages.hostile
    )
    (folder / PAGES).mkdir()
    shutil.copy(pages.good, folder / PAGES / page_name(1))
    write_table(_results(good), pages.index)
    return pages


def _refused(folder: Path) -> Alignment:
    """What the refusal of the pair of noise found out."""
    try:
        geodelreg.align(str(folder / "ms.tif"), str(folder / "noise.tif"))
    except AlignmentRefusedError as refusal:
        if isinstance(refusal.alignment, Alignment):
            return refusal.alignment
    raise RuntimeError("a pair of noise was not refused")


def _results(good: Alignment) -> Iterator[PairResult]:
    """As many results as `PAIRS`, side by side, each with numbers of its own."""
    outline = footprint(good.source.grid, good.source.grid.transform)
    assert outline is not None
    figures, rng = figures_of(good), np.random.default_rng(2)
    outcomes = ("aligned", "aligned", "aligned", "already_aligned", "refused", "failed")
    for number in range(1, PAIRS + 1):
        outcome = outcomes[number % len(outcomes)]
        known = {**figures, "offset_px": float(rng.uniform(0, 40))}
        yield PairResult(
            number,
            (f"scene_{number:03}_ms{HOSTILE if number == 7 else ''}.tif",),
            f"scene_{number:03}_pan.tif",
            "",
            outcome,
            reason="" if "aligned" in outcome else f"why {number} was {outcome}",
            figures=known if outcome != "failed" else {},
            footprint=_moved(outline, number) if outcome != "failed" else None,
        )


def _moved(outline: dict[str, Any], number: int) -> dict[str, Any]:
    row, column = divmod(number, _COLUMNS)
    ring = [(x + _STEP_DEG * column, y - _STEP_DEG * row) for x, y in outline["coordinates"][0]]
    return {"type": "Polygon", "coordinates": [ring]}
