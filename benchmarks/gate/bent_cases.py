"""Cases of pairs that are bent, torn, coloured, filled or framed, and their making."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from affine import Affine

from benchmarks.gate.cases import (
    HELD_OUT,
    SOURCES,
    TUNING,
    UNFIT,
    imagery_of,
    textured_centre,
)
from benchmarks.gate.distortions import (
    Array,
    Tear,
    fade,
    few_levels,
    flood,
    frame,
    gradient_contrast,
    relief_shading,
    waves,
    zero_fill,
)
from benchmarks.scenes.imagery import Imagery
from benchmarks.scenes.make import Bend, HeaderError, Scene, SceneSpec, make_scene
from benchmarks.scenes.truth import Truth, apply, check_points
from geodelreg.fine.tiles import SMALLEST_PATCH_PX

SOURCES_HELD_OUT = ("landsat8_kanto", "landsat8_guangdong", "landsat_geographic_2020")
"""Their pairs are aligned to judge a finished method, and looked at by nobody before:
``rio-pansharpen/LC81070352015122LGN00_B2.tif``, ``…_B3.tif``, ``…_B4.tif``,
``rio-pansharpen/LC81210442015044LGN00_B2.tif``, ``…_B3.tif``, ``…_B4.tif``, and
``landsat_geographic/2020.tif``."""
BENT = ("waves", "tear", "bands apart")
ONE_AFFINE = (
    "unbent", "clouds beside", "relief shading", "gradient contrast", "single band", "fill",
    "collar", "labels", "stripes", "logo", "fixed pattern", "water", "moving ice", "few levels",
    "scaled, clustered", "ratio 6", "ratio 8",
)  # fmt: skip
FRAMED = tuple(f"another scene, {what}" for what in ("collar", "labels", "stripes", "logo"))
KINDS = (*BENT, *ONE_AFFINE, *FRAMED)
PAN_SIDE_PX = (700, 1000)
MOST_STRAIN = 0.04
TORN_PATCHES = 8
"""Of 12 MS pixels square: of a smaller part nobody could tell whether it is torn off."""


@dataclass(frozen=True, slots=True)
class BentCase:
    """One pair to make.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    source : str
    number : int
        Seeds what is random.
    """

    kind: str
    source: str
    number: int

    @property
    def name(self) -> str:
        """Unique, and the seed."""
        return f"{self.kind}/{self.source}/{self.number}"

    @property
    def part(self) -> str:
        """``tuning`` or ``held out``."""
        return HELD_OUT if self.source in SOURCES_HELD_OUT else TUNING


@dataclass(frozen=True, slots=True, eq=False)
class BentPair:
    """Two rasters with where every MS pixel truly lies.

    Attributes
    ----------
    scene : Scene
    bend : callable or None
        As for `benchmarks.scenes.make.make_scene`.
    band_shifts : tuple of (float, float)
        PAN pixels.
    same_ground : bool
        False of two scenes that share nothing but a frame: no correction is right.
    """

    scene: Scene
    bend: Bend | None = None
    band_shifts: tuple[tuple[float, float], ...] = ()
    same_ground: bool = True

    def pan_px(self, source_px: Array) -> Array:
        """(N, 2) where (N, 2) MS pixels truly lie in PAN, the bands' mean where they differ."""
        truth = self.scene.truth
        place = self.to_pan(truth, Affine(*truth.ms_true), source_px)
        if self.bend is not None:
            place = place + self.bend(place)
        return place + np.mean(self.band_shifts, axis=0) if self.band_shifts else place

    @staticmethod
    def to_pan(truth: Truth, transform: Affine, source_px: Array) -> Array:
        """(N, 2) PAN pixels of (N, 2) MS pixels under a geotransform of MS, in PAN's CRS."""
        to_pan = ~Affine(*truth.pan) @ transform
        return np.stack(apply(to_pan, source_px[:, 0], source_px[:, 1]), axis=1)

    def errors(self, corrected: Affine) -> Array:
        """(K, 2) found minus true PAN place over the common part of the two rasters, PAN pixels."""
        truth = self.scene.truth
        spots = check_points(truth.ms_shape)
        true = self.pan_px(spots)
        inside = (true >= 0).all(axis=1) & (true <= truth.pan_shape[::-1]).all(axis=1)
        return self.to_pan(truth, corrected, spots[inside]) - true[inside]

    def best_affine(self) -> Affine:
        """Geotransform of MS that leaves least, over the common part."""
        truth = self.scene.truth
        spots = check_points(truth.ms_shape)
        true = self.pan_px(spots)
        inside = (true >= 0).all(axis=1) & (true <= truth.pan_shape[::-1]).all(axis=1)
        columns = np.column_stack([spots[inside], np.ones(int(inside.sum()))])
        fit = np.linalg.lstsq(columns, true[inside], rcond=None)[0].T
        return Affine(*truth.pan) @ Affine(*fit.ravel())


def bent_cases(count: int, part: str = "") -> list[BentCase]:
    """The first `count` cases: kinds in turn, in each the sources in turn."""
    queues = [_of_kind(kind, part) for kind in KINDS]
    found: list[BentCase] = []
    while len(found) < count:
        found.extend(next(queue) for queue in queues)
    return found[:count]


def _of_kind(kind: str, part: str) -> Iterator[BentCase]:
    tuning = [name for name, s in SOURCES.items() if s.part == TUNING and name not in UNFIT]
    names = {TUNING: tuning, HELD_OUT: list(SOURCES_HELD_OUT)}
    chosen = names.get(part, [*tuning, *SOURCES_HELD_OUT])
    number = 0
    while True:
        for source in chosen:
            yield BentCase(kind, source, number)
        number += 1


def make_bent(case: BentCase, data: Path) -> BentPair:
    """Render the pair of a case; the same case gives the same pair, bit by bit."""
    rng = np.random.default_rng(zlib.crc32(case.name.encode()))
    imagery = imagery_of(case.source, data)
    side = min(int(rng.integers(*PAN_SIDE_PX)), min(imagery.shape) - 2)
    spec = _spec(case, imagery, side, rng)
    if case.kind == "waves":
        return _bent(spec, imagery, _waves(side, rng))
    if case.kind == "tear":
        return _bent(spec, imagery, _tear(spec, rng))
    if case.kind == "bands apart":
        return _apart(spec, imagery, rng)
    if case.kind in FRAMED:
        return _framed_strangers(case, spec, imagery, rng)
    return BentPair(_dressed(case.kind, make_scene(spec, imagery), rng))


def _spec(case: BentCase, imagery: Imagery, side: int, rng: np.random.Generator) -> SceneSpec:
    ratio = float(case.kind.split()[1]) if case.kind.startswith("ratio") else 0.0
    ratio = ratio or float(rng.choice([2.0, 3.0, 4.0]))
    angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(0, 10)
    linear = (1.0, 0.0, 0.0, 1.0)
    if case.kind == "scaled, clustered":
        grown = 1.0 + float(rng.choice([-1, 1]) * rng.uniform(0.01, 0.03))
        linear = (grown, 0.0, 0.0, grown)
    return SceneSpec(
        name=case.name,
        description=case.kind,
        error=HeaderError((float(length * np.cos(angle)), float(length * np.sin(angle))), linear),
        pan_shape=(side, side),
        ms_shape=(round(0.9 * side / ratio), round(0.9 * side / ratio)),
        ratio=ratio,
        pan_centre=textured_centre(imagery, side, rng),
        variant="clouds" if case.kind == "clouds beside" else "",
    )


def _bent(spec: SceneSpec, imagery: Imagery, bend: Bend) -> BentPair:
    return BentPair(make_scene(spec, imagery, bend), bend)


def _waves(side: int, rng: np.random.Generator) -> Bend:
    """0.3 to 5 px over 300 to 3000 px, log-uniform, no steeper than a header could be."""
    length = float(np.exp(rng.uniform(np.log(300), np.log(3000))))
    steepest = MOST_STRAIN * length * np.sqrt(2) / (2 * np.pi)
    amplitude = float(np.exp(rng.uniform(np.log(0.3), np.log(min(5.0, steepest)))))
    return waves(amplitude, length, rng)


def _tear(spec: SceneSpec, rng: np.random.Generator) -> Tear:
    """2 to 40 px, 10 to 50 % of the area and some patches at least, half of them at a slant."""
    length, angle = float(np.exp(rng.uniform(np.log(2), np.log(40)))), rng.uniform(0, 2 * np.pi)
    shift = (length * float(np.cos(angle)), length * float(np.sin(angle)))
    slant = float(rng.choice([0.0, rng.uniform(20, 70)]))
    least = TORN_PATCHES * SMALLEST_PATCH_PX**2 / (spec.ms_shape[0] * spec.ms_shape[1])
    return Tear(shift, max(float(rng.uniform(0.1, 0.5)), least), slant, spec.pan_shape)


def _apart(spec: SceneSpec, imagery: Imagery, rng: np.random.Generator) -> BentPair:
    """One band or two lie 0.5 to 8 px from the others."""
    length, angle = float(np.exp(rng.uniform(np.log(0.5), np.log(8)))), rng.uniform(0, 2 * np.pi)
    shift = (length * float(np.cos(angle)), length * float(np.sin(angle)))
    wrong = rng.choice(4, int(rng.integers(1, 3)), replace=False)
    shifts = tuple(shift if number in wrong else (0.0, 0.0) for number in range(4))
    return BentPair(make_scene(spec, imagery, band_shifts=shifts), band_shifts=shifts)


def _framed_strangers(
    case: BentCase, spec: SceneSpec, imagery: Imagery, rng: np.random.Generator
) -> BentPair:
    """Two places that share nothing but a frame: the one mirrored, for no rotation undoes that."""
    scene = make_scene(spec, imagery)
    mirrored = replace(imagery, bands=np.ascontiguousarray(imagery.bands[:, :, ::-1]))
    scene = replace(scene, pan=make_scene(spec, mirrored).pan)
    frame((scene.ms, scene.pan), case.kind.split(", ")[1], rng)
    return BentPair(scene, same_ground=False)


def _dressed(kind: str, scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene as other sensors, formats and seasons would show it; its truth stays."""
    ms, pan = scene.ms, scene.pan
    if kind == "relief shading":
        return replace(scene, ms=relief_shading(ms, rng))
    if kind == "gradient contrast":
        return replace(scene, ms=gradient_contrast(ms))
    if kind == "single band":
        return replace(scene, ms=ms[int(rng.integers(4))][None])
    if kind == "few levels":
        return replace(scene, ms=few_levels(ms, int(rng.choice([4, 8, 16]))))
    if kind == "fill":
        zero_fill((ms, pan), float(rng.uniform(0.1, 0.4)), rng)
    elif kind in ("collar", "labels", "stripes", "logo", "fixed pattern"):
        frame((ms, pan), kind, rng)
    elif kind in ("water", "moving ice"):
        pan = flood(scene.ms, scene.pan, scene.truth, kind == "moving ice", rng)
    elif kind == "scaled, clustered":
        fade(ms, float(rng.uniform(0.35, 0.5)), rng)
    return replace(scene, ms=ms, pan=pan)
