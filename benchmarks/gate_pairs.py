"""Pairs of rasters that cannot be aligned, and pairs that can, from real and procedural ground."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.ground import cloud_layer, fractal
from benchmarks.imagery import Imagery, ImageryNotFoundError, sentinel2
from benchmarks.scenes import HeaderError, Scene, SceneSpec, make_scene
from benchmarks.truth import Truth
from geodelreg.types import Window

TUNING, HELD_OUT = "tuning", "held out"
UTM_WKT_EPSG = 32618
LAND_WINDOW = (slice(260, 1260), slice(60, 1060))
LEAST_BLOCK_STD = 20.0
BLOCK_PX = 16
PAN_SIDES_PX = {"small": (180, 230), "clouds and no data": (400, 520)}


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
    source = LATER[name] if later else SOURCES[name]
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


def make_pair(case: Case, data: Path) -> Scene:
    """Render the pair of a case; the same case gives the same pair, bit by bit.

    Parameters
    ----------
    case : Case
    data : Path
        Folder of the imagery.
    """
    rng = np.random.default_rng(zlib.crc32(case.name.encode()))
    return (_alignable if case.alignable else _hopeless)(case, data, rng)


# --- pairs that can be aligned -------------------------------------------------------------------


def _alignable(case: Case, data: Path, rng: np.random.Generator) -> Scene:
    if case.kind == "real pair":
        return _real_pair(case.source, data, rng, (250, 460))
    imagery = imagery_of(case.source, data)
    spec = _spec(case, imagery, rng)
    scene = make_scene(spec, imagery)
    if case.kind == "two dates":
        later = replace(imagery_of(case.source, data, later=True), transform=imagery.transform)
        scene = replace(scene, ms=make_scene(spec, later).ms)
    if case.kind == "noisy":
        level = float(rng.choice([15.0, 30.0, 50.0]))
        scene = replace(
            scene, ms=_noisier(scene.ms, level / 2, rng), pan=_noisier(scene.pan, level, rng)
        )
    return scene


def _noisier(
    image: NDArray[np.uint16], sigma: float, rng: np.random.Generator
) -> NDArray[np.uint16]:
    noisy = image + sigma * rng.standard_normal(image.shape)
    return np.clip(np.rint(noisy), 1, 4095).astype(np.uint16)


def _spec(case: Case, imagery: Imagery, rng: np.random.Generator) -> SceneSpec:
    kind = case.kind
    ratio = float(rng.choice([2.0, 2.5, 4.0]))
    if kind.startswith("ratio"):
        ratio = float(kind.split()[1])
    low, high = PAN_SIDES_PX.get(kind, (260, 380))
    side = min(int(rng.integers(low, high)), min(imagery.shape) - 2)
    if kind in PAN_SIDES_PX:
        ratio = 2.0
    variants = {"clouds and no data": "clouds", "radiometry": "season"}
    return SceneSpec(
        name=case.name,
        description=kind,
        error=_header_error(kind, rng),
        pan_shape=(side, side),
        ms_shape=(round(0.85 * side / ratio), round(0.8 * side / ratio)),
        ratio=ratio,
        pan_centre=textured_centre(imagery, side, rng),
        variant=variants.get(kind, ""),
        ms_epsg=_other_zone(imagery) if kind == "other CRS" else None,
    )


def _header_error(kind: str, rng: np.random.Generator) -> HeaderError:
    angle = rng.uniform(0, 2 * np.pi)
    length = rng.uniform(40, 120) if kind == "far shift" else rng.uniform(0, 14)
    shift = (float(length * np.cos(angle)), float(length * np.sin(angle)))
    if kind == "rotation":
        return HeaderError.similarity(float(rng.uniform(-180, 180)), 1.0, shift)
    if kind == "scale":
        return HeaderError.similarity(
            float(rng.uniform(-2, 2)), float(rng.uniform(0.9, 1.1)), shift
        )
    if kind == "shear":
        a, b, c, d = rng.uniform(-0.015, 0.015, 4)
        return HeaderError(shift, (1 + float(a), float(b), float(c), 1 + float(d)))
    return HeaderError(shift)


def _other_zone(imagery: Imagery) -> int:
    """The neighbouring UTM zone."""
    from pyproj import CRS

    return (CRS.from_wkt(imagery.crs_wkt).to_epsg() or 0) - 1


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


REAL_SHIFT_PX = {"landsat8_momotombo": (0.0, 1.03), "landsat8_oman": (0.10, -0.04)}


def _real_pair(
    name: str,
    data: Path,
    rng: np.random.Generator,
    sides: tuple[int, int],
    brightest: bool = False,
) -> Scene:
    """A crop of a real Landsat pair with a header error of some pixels added."""
    import rasterio

    folder = data / name
    with rasterio.open(folder / "pan.tif") as raster:
        pan, pan_transform, wkt = raster.read(1), raster.transform, raster.crs.to_wkt()
    with rasterio.open(folder / "ms.tif") as raster:
        ms, ms_transform = raster.read(), raster.transform
    side = min(int(rng.integers(*sides)) // 2, min(ms.shape[1:]) - 2)
    spots = rng.integers(0, np.array(ms.shape[1:]) - side, (60 if brightest else 1, 2))
    level = [float(ms[:3, r : r + side, c : c + side].mean()) for r, c in spots]
    row, column = spots[int(np.argmax(level))]
    ms = ms[:, row : row + side, column : column + side]
    origin = ~pan_transform @ (ms_transform @ (float(column), float(row)))
    left, top = (max(int(v) - 8, 0) for v in origin)
    pan = pan[top : top + 2 * side + 16, left : left + 2 * side + 16]
    pan_transform = pan_transform @ Affine.translation(left, top)
    true = ms_transform @ Affine.translation(float(column), float(row))
    native = REAL_SHIFT_PX.get(name, (0.0, 0.0))
    true = Affine.translation(native[0] * pan_transform.a, native[1] * pan_transform.e) @ true
    error = rng.uniform(-9, 9, 2) * (pan_transform.a, pan_transform.e)
    header = Affine.translation(*error) @ true
    truth = Truth(
        name, "real pair", name, wkt, wkt, tuple(header)[:6], tuple(true)[:6],
        tuple(pan_transform)[:6], ms.shape[1:], pan.shape,
    )  # fmt: skip
    return Scene(_counts(ms), _counts(pan), truth)


def _counts(image: NDArray[Any]) -> NDArray[np.uint16]:
    """16-bit counts, of reflectances too."""
    values = np.nan_to_num(image.astype(np.float64))
    gain = 10_000.0 if values.max() < 100 else 1.0
    return np.clip(np.rint(values * gain), 1, 65535).astype(np.uint16)


# --- pairs that cannot ---------------------------------------------------------------------------


def _hopeless(case: Case, data: Path, rng: np.random.Generator) -> Scene:
    if case.kind == "all cloud" and case.source in SOURCES:
        return _real_pair(case.source, data, rng, (200, 300), brightest=True)
    side = int(rng.integers(220, 340))
    ratio = float(rng.choice([1.0, 2.0, 2.5, 4.0], p=[0.1, 0.3, 0.2, 0.4]))
    if case.source in PROCEDURAL:
        grounds = [_procedural(case, side, rng) for _ in range(2)]
        return _combine(grounds[0], grounds[1], case, side, ratio, rng)
    one = imagery_of(case.source, data)
    if case.kind == "repeated":
        tiled = _tiled(one, side, rng)
        return _combine(tiled, tiled, case, side, ratio, rng, period=True)
    if case.kind in ("disjoint crops", "beyond overlap"):
        ends = _halves(one, rng)
        scene = _combine(*ends, case, side, ratio, rng)
        return (
            _moved_apart(scene) if case.kind == "beyond overlap" and rng.random() < 0.5 else scene
        )
    if case.kind == "constant":
        return _constant(_combine(one, one, case, side, ratio, rng), rng)
    if case.kind == "mirrored":
        flip = rng.integers(2)
        scene = _combine(one, one, case, side, ratio, rng, same_place=True)
        return replace(
            scene, ms=np.ascontiguousarray(scene.ms[:, ::-1] if flip else scene.ms[..., ::-1])
        )
    other = imagery_of(case.other, data)
    return _combine(one, other, case, side, ratio, rng)


def _combine(
    one: Imagery,
    other: Imagery,
    case: Case,
    side: int,
    ratio: float,
    rng: np.random.Generator,
    period: bool = False,
    same_place: bool = False,
) -> Scene:
    """MS of one ground and PAN of another, on one header."""
    side = min(side, *(min(i.shape) for i in (one, other)))
    across, down = (float(v) for v in rng.uniform(-30, 30, 2))
    spec = SceneSpec(
        name=case.name,
        description=case.kind,
        error=HeaderError((across, down)),
        pan_shape=(side, side),
        ms_shape=(round(0.8 * side / ratio), round(0.8 * side / ratio)),
        ratio=ratio,
        pan_centre=textured_centre(one, side, rng, 10),
    )
    scene = make_scene(spec, one)
    if period or same_place:
        return scene
    pan = make_scene(replace(spec, pan_centre=textured_centre(other, side, rng, 10)), other).pan
    return replace(scene, pan=pan)


def _halves(imagery: Imagery, rng: np.random.Generator) -> tuple[Imagery, Imagery]:
    """Two parts of the imagery without common ground, in random order."""
    height, width = imagery.shape
    if width >= height:
        parts = [imagery.bands[:, :, : width // 2], imagery.bands[:, :, -(width // 2) :]]
    else:
        parts = [imagery.bands[:, : height // 2], imagery.bands[:, -(height // 2) :]]
    first = int(rng.integers(2))
    return replace(imagery, bands=parts[first]), replace(imagery, bands=parts[1 - first])


def _moved_apart(scene: Scene) -> Scene:
    """PAN's header moved until it no longer touches MS."""
    truth = scene.truth
    a, b, c, d, e, f = truth.pan
    beyond = (c + 1.5 * a * truth.pan_shape[1], f)
    return replace(scene, truth=replace(truth, pan=(a, b, beyond[0], d, e, beyond[1])))


def _tiled(imagery: Imagery, side: int, rng: np.random.Generator) -> Imagery:
    """A crop of the imagery, or a field with borders, repeated without end."""
    period = int(rng.integers(14, 90))
    x, y = textured_centre(imagery, period + 2, rng, 10)
    top, left = max(int(y) - period // 2, 0), max(int(x) - period // 2, 0)
    tile = imagery.bands[:, top : top + period, left : left + period]
    if rng.random() < 0.3:
        tile = np.repeat(tile.mean(axis=(1, 2), keepdims=True), period, 1).repeat(period, 2)
        tile[:, : period // 4] *= 1.4
        tile[:, :, : period // 5] *= 0.6
    times = 3 * side // period + 1
    return replace(imagery, bands=np.tile(tile, (1, times, times)))


def _constant(scene: Scene, rng: np.random.Generator) -> Scene:
    """One image or both without any texture, or with nothing but noise of a count or two."""
    which, noise = int(rng.integers(3)), float(rng.choice([0.0, 1.0, 2.0]))
    ms, pan = scene.ms, scene.pan
    if which != 1:
        pan = _noisier(np.full_like(pan, 1200), noise, rng)
    if which != 0:
        ms = _noisier(np.full_like(ms, 900), noise, rng)
    return replace(scene, ms=ms, pan=pan)


def _procedural(case: Case, side: int, rng: np.random.Generator) -> Imagery:
    """Four bands of a random field, alike but for some noise, on a UTM grid."""
    from pyproj import CRS

    shape = (side, side)
    base: NDArray[np.floating[Any]]
    if case.kind == "all cloud":
        layer = cloud_layer(shape, 0.95, (0.0, 0.0), rng)
        base = 300.0 + layer.opacity * (layer.radiance - 300.0)
    elif case.source == "mosaic":
        base = _mosaic(shape, rng)
    elif case.source == "stripes":
        base = 1200 + 250 * np.sin(np.arange(side) / rng.uniform(2, 9))[None, :] * np.ones(shape)
        base = base + 150 * fractal(shape, 1.0, rng)
    else:
        slope = 0.0 if case.source == "white" else float(case.source.split()[1])
        base = 1200 + 300 * fractal(shape, slope, rng)
    if case.kind == "changed" and case.source != "mosaic":
        base = 0.5 * base + 0.5 * _mosaic(shape, rng)
    bands = [base * gain + 20 * fractal(shape, 0.8, rng) for gain in (0.8, 1.0, 1.1, 1.3)]
    stacked = np.clip(np.stack(bands), 1, 4000).astype(np.float32)
    transform = Affine(10.0, 0.0, 500_000.0, 0.0, -10.0, 4_000_000.0)
    return Imagery(stacked, transform, CRS.from_epsg(UTM_WKT_EPSG).to_wkt(), case.source)


def _mosaic(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float64]:
    """Fields: cells around random points, each of its own brightness."""
    from scipy.spatial import KDTree

    points = rng.uniform(0, max(shape), (int(rng.integers(60, 400)), 2))
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    cell = KDTree(points).query(np.stack([rows.ravel(), columns.ravel()], axis=1))[1]
    return np.asarray(rng.uniform(500, 2500, len(points))[cell].reshape(shape))
