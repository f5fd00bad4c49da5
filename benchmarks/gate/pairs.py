"""Pairs of rasters that cannot be aligned, and pairs that can, from real and procedural ground."""

from __future__ import annotations

import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.gate.cases import PROCEDURAL, SOURCES, Case, imagery_of, textured_centre
from benchmarks.scenes.ground import cloud_layer, fractal
from benchmarks.scenes.imagery import Imagery
from benchmarks.scenes.make import HeaderError, Scene, SceneSpec, make_scene
from benchmarks.scenes.truth import Truth

UTM_WKT_EPSG = 32618
PAN_SIDES_PX = {"small": (180, 230), "clouds and no data": (400, 520)}


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
