"""Cases of the gate's benchmark, and the real imagery that their pairs are made of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.scenes.imagery import Imagery, ImageryNotFoundError, sentinel2
from geodelreg.values.raster import Window

TUNING, HELD_OUT = "tuning", "held out"
LAND_WINDOW = (slice(260, 1260), slice(60, 1060))
LEAST_BLOCK_STD = 20.0
BLOCK_PX = 16


@dataclass(frozen=True, slots=True)
class Source:
    """Real imagery: where it is, its bands, whether limits were set on it, and its window."""

    pattern: str
    bands: tuple[int, ...]
    part: str
    window: Window | None = None  # column, row, width, height; None = the whole


SOURCES: dict[str, Source] = {
    "sentinel2": Source("", (), TUNING),
    "landsat8_momotombo": Source("landsat8_momotombo/ms.tif", (1, 2, 3, 4), TUNING),
    "naip": Source("naip/*2012*.tif", (3, 2, 1, 4), TUNING),
    "landsat8_oman": Source("landsat8_oman/ms.tif", (1, 2, 3, 1), TUNING),
    "landsat8_clouds": Source("landsat8_clouds/ms.tif", (1, 2, 3, 4), TUNING),
    "landsat8_twodates": Source("landsat8_twodates/20190809.tif", (1, 2, 3, 4), TUNING),
    "landsat_geographic": Source("landsat_geographic/2000.tif", (3, 2, 1, 4), TUNING),
    "landsat8_kanto": Source(
        "rio-pansharpen/LC81070352015122LGN00_B*.tif", (0, 1, 2, 2), HELD_OUT,
        Window(250, 450, 800, 800),
    ),
    "landsat8_guangdong": Source(
        "rio-pansharpen/LC81210442015044LGN00_B*.tif", (0, 1, 2, 2), HELD_OUT,
        Window(220, 600, 1060, 460),
    ),
}  # fmt: skip
"""Bands are blue, green, red, infrared; of one file per band, in the order of their names."""
BENT_HELD_OUT = {
    "landsat_geographic_2020": Source("landsat_geographic/2020.tif", (3, 2, 1, 4), HELD_OUT),
}
"""Besides those above, held out for the bent pairs alone (`benchmarks.gate.bent_cases`)."""
LATER = {
    "landsat8_twodates": Source("landsat8_twodates/20190825.tif", (1, 2, 3, 4), TUNING),
}
PROCEDURAL = {
    "white": TUNING,
    "fractal 1.0": TUNING,
    "mosaic": TUNING,
    "fractal 0.5": HELD_OUT,
    "fractal 1.6": HELD_OUT,
    "stripes": HELD_OUT,
}
UNFIT = {"landsat8_clouds"}  # its bands are 1.4 px apart on the clouds: no ground truth
NEGATIVE = (
    "unrelated", "disjoint crops", "mirrored", "noise", "constant", "all cloud", "repeated",
    "changed", "beyond overlap",
)  # fmt: skip
POSITIVE = (
    "shift", "far shift", "rotation", "scale", "shear", "ratio 1", "ratio 2", "ratio 2.5",
    "ratio 4", "clouds and no data", "radiometry", "other CRS", "small", "noisy", "two dates",
    "real pair",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Case:
    """One pair to make.

    Attributes
    ----------
    alignable : bool
    kind : str
        One of `NEGATIVE` or `POSITIVE`.
    source, other : str
        What MS and PAN are made of.
    number : int
        Seeds what is random.
    """

    alignable: bool
    kind: str
    source: str
    other: str
    number: int

    @property
    def name(self) -> str:
        """Unique, and the seed."""
        return f"{self.kind}/{self.source}/{self.other}/{self.number}"

    @property
    def part(self) -> str:
        """``tuning`` when limits were set on its sources, ``held out`` when on none of them."""
        known = {name: source.part for name, source in SOURCES.items()} | PROCEDURAL
        return known[self.source]


def cases(alignable: bool, count: int, part: str = "") -> list[Case]:
    """The first `count` cases: kinds in turn, in each the sources in turn.

    Parameters
    ----------
    alignable : bool
    count : int
    part : str
        ``tuning`` or ``held out``; both in turn when empty.
    """
    queues = [_of_kind(alignable, kind, part) for kind in (POSITIVE if alignable else NEGATIVE)]
    found: list[Case] = []
    while len(found) < count:
        found.extend(next(queue) for queue in queues)
    return found[:count]


def _of_kind(alignable: bool, kind: str, part: str) -> Iterator[Case]:
    made_of = list(_makings(kind, part) or _makings(kind, ""))
    number = 0
    while True:
        for source, other in made_of:
            yield Case(alignable, kind, source, other, number)
        number += 1


def _makings(kind: str, part: str) -> list[tuple[str, str]]:
    real = [name for name, source in SOURCES.items() if part in ("", source.part)]
    made = [name for name, of in PROCEDURAL.items() if part in ("", of)]
    if kind == "unrelated":
        return [(a, b) for a in real for b in real if a != b and SOURCES[a].part == SOURCES[b].part]
    if kind == "disjoint crops":
        return [(name, name) for name in real if name != "landsat8_oman"]
    if kind in ("noise", "changed"):
        return [(name, name) for name in made]
    if kind == "all cloud":
        crops = ["landsat8_clouds"] if part in ("", HELD_OUT) else []
        return [(name, name) for name in [*(m for m in made if "fractal" in m), *crops]]
    if kind == "two dates":
        return [(name, name) for name in real if name in LATER]
    if kind == "real pair":
        return [(n, n) for n in real if n in ("landsat8_momotombo", "landsat8_oman")]
    left_out = UNFIT if kind in POSITIVE else set()
    if kind == "other CRS":
        left_out = left_out | {"landsat_geographic"}
    return [(name, name) for name in real if name not in left_out]


@lru_cache(maxsize=16)
def imagery_of(name: str, data: Path, later: bool = False) -> Imagery:
    """Four bands of a source.

    Raises
    ------
    ImageryNotFoundError
    """
    import rasterio

    if name == "sentinel2":
        return _land(sentinel2(data))
    source = LATER[name] if later else (SOURCES | BENT_HELD_OUT)[name]
    files = sorted(data.glob(source.pattern))
    if not files:
        raise ImageryNotFoundError(f"no {source.pattern} in {data}")
    read = partial(_read, window=source.window)
    if min(source.bands) == 0:
        bands = np.concatenate([read(files[number], [1]) for number in source.bands])
    else:
        bands = read(files[0], list(source.bands))
    column, row = source.window[:2] if source.window else (0, 0)
    with rasterio.open(files[0]) as raster:
        transform = raster.transform @ Affine.translation(column, row)
        return Imagery(bands, transform, raster.crs.to_wkt(), name)


def _read(file: Path, numbers: list[int], window: Window | None) -> NDArray[np.float32]:
    import rasterio

    part = rasterio.windows.Window(*window) if window else None
    with rasterio.open(file) as raster:
        return np.asarray(np.nan_to_num(raster.read(numbers, window=part)), dtype=np.float32)


def is_there(case: Case, data: Path) -> bool:
    """True when the imagery that a pair is made of is in the folder."""
    names = [name for name in (case.source, case.other) if name in SOURCES]
    return all(not SOURCES[n].pattern or any(data.glob(SOURCES[n].pattern)) for n in names)


def _land(imagery: Imagery) -> Imagery:
    """The half of the Sentinel-2 scene that is not water."""
    rows, columns = LAND_WINDOW
    transform = imagery.transform @ Affine.translation(columns.start, rows.start)
    bands = np.ascontiguousarray(imagery.bands[:, rows, columns])
    return replace(imagery, bands=bands, transform=transform)


def textured_centre(
    imagery: Imagery, side: int, rng: np.random.Generator, tries: int = 40
) -> tuple[float, float]:
    """Centre of a window, inside the imagery, most of whose blocks show more than noise."""
    height, width = imagery.shape
    half = side / 2
    best, best_std = (width / 2, height / 2), -1.0
    grey = imagery.bands[:3].mean(axis=0)
    grey = grey * (3000.0 / max(float(np.percentile(grey[::4, ::4], 99.8)), 1e-9))
    for _ in range(tries):
        x = float(rng.uniform(half, max(width - half, half + 1e-6)))
        y = float(rng.uniform(half, max(height - half, half + 1e-6)))
        top, left = max(int(y - half), 0), max(int(x - half), 0)
        usual = _block_std(grey[top : top + side, left : left + side])
        if usual >= LEAST_BLOCK_STD:
            return x, y
        if usual > best_std:
            best, best_std = (x, y), usual
    return best


def _block_std(grey: NDArray[np.floating[Any]]) -> float:
    """The standard deviation that three quarters of the blocks exceed."""
    rows, columns = (n // BLOCK_PX for n in grey.shape)
    blocks = grey[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(
        rows, BLOCK_PX, columns, BLOCK_PX
    )
    return float(np.percentile(blocks.std(axis=(1, 3)), 25))
