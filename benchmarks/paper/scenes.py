"""Pairs for the paper's experiments: real imagery, known truth, several sources and seeds."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from affine import Affine

from benchmarks.gate.cases import Case as GateCase
from benchmarks.gate.cases import imagery_of, textured_centre
from benchmarks.gate.pairs import make_pair as make_gate_pair
from benchmarks.scenes.imagery import SAMPLE_FOLDER, Imagery
from benchmarks.scenes.make import HeaderError, Scene, SceneSpec, make_scene
from benchmarks.scenes.truth import Truth

CLEAN, CLOUDS, SEASON, DATES, REAL, SAMPLE = (
    "clean", "clouds", "radiometry", "two dates", "real pair", "sample pair",
)  # fmt: skip
SOURCES = ("sentinel2", "landsat8_momotombo", "naip", "landsat8_twodates")
TWO_DATES = ("landsat8_twodates", "landsat_geographic")
REAL_PAIRS = ("landsat8_momotombo", "landsat8_oman")
RATIOS = (1.0, 4.0)
VARIANTS = {CLOUDS: "clouds", SEASON: "season"}
PAN_SIDE_PX = {1.0: 360, 4.0: 840}
MS_SHARE = 0.85
SWEEP_CENTRE = (560.0, 560.0)
SWEEP_SIDE_PX = {"rotation": 420, "translation": 600}
TRANSLATION_DEG = 20.0


@dataclass(frozen=True, slots=True)
class Case:
    """One pair.

    Attributes
    ----------
    condition : str
        What stands between the two images: ``clean``, ``clouds``, ...; or the kind of a sweep.
    source : str
        Imagery that it is made of.
    ratio : float
        MS pixel size over PAN pixel size.
    seed : int
    value : float
        Degrees or PAN pixels of a sweep.
    """

    condition: str
    source: str
    ratio: float
    seed: int
    value: float = 0.0

    @property
    def name(self) -> str:
        """Unique, and the seed of what is random."""
        return f"paper/{self.condition}/{self.source}/{self.ratio:g}/{self.seed}/{self.value:g}"


FIGURES = {
    "Fig 4, 5": Case(DATES, "landsat8_twodates", 1.0, 0),
    "Fig 6": Case("rotation", "sentinel2", 1.0, 0, 36.0),
    "Fig 7": Case("translation", "sentinel2", 1.0, 0, 230.0),
}
"""What stands in for the images of the paper's figures: an ordinary pair, 36° and 230 px."""


def cases(seeds: int) -> list[Case]:
    """Every condition, source and GSD ratio, `seeds` times, and the sample pair once."""
    found = [Case(SAMPLE, "sample_tiles", 4.0, 0)]
    for seed in range(seeds):
        for ratio in RATIOS:
            for condition in (CLEAN, CLOUDS, SEASON):
                found += [Case(condition, source, ratio, seed) for source in SOURCES]
            found += [Case(DATES, source, ratio, seed) for source in TWO_DATES]
        found += [Case(REAL, source, 2.0, seed) for source in REAL_PAIRS]
    return found


def sweep_cases(quick: bool) -> list[Case]:
    """Rotation 0 to 360 degrees and translation 0 to 500 px, with the paper's 36° and 230 px."""
    turns = sorted({*range(0, 361, 90 if quick else 30), 36})
    steps = sorted({*range(0, 501, 250 if quick else 50), 230})
    return [
        Case(kind, "sentinel2", ratio, 0, float(value))
        for ratio in RATIOS
        for kind, values in (("rotation", turns), ("translation", steps))
        for value in values
    ]


def make_pair(case: Case, data: Path) -> Scene:
    """Render the pair of a case; the same case gives the same pair, bit by bit.

    Parameters
    ----------
    case : Case
    data : Path
        Folder of the real imagery.
    """
    if case.condition == SAMPLE:
        return _sample()
    if case.condition == REAL:
        return make_gate_pair(
            GateCase(True, "real pair", case.source, case.source, case.seed), data
        )
    imagery = imagery_of(case.source, data)
    if case.condition in ("rotation", "translation"):
        return _swept(case, imagery)
    rng = np.random.default_rng(zlib.crc32(case.name.encode()))
    spec = _spec(case, imagery, rng)
    scene = make_scene(spec, imagery)
    if case.condition == DATES:
        later = replace(_later(case.source, data), transform=imagery.transform)
        scene = replace(scene, ms=make_scene(spec, later).ms)
    return scene


def _spec(case: Case, imagery: Imagery, rng: np.random.Generator) -> SceneSpec:
    side = min(PAN_SIDE_PX[case.ratio], min(imagery.shape) - 2)
    ms_side = round(MS_SHARE * side / case.ratio)
    angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(2, 14)
    shift = (float(length * np.cos(angle)), float(length * np.sin(angle)))
    return SceneSpec(
        name=case.name,
        description=case.condition,
        error=HeaderError.similarity(
            float(rng.uniform(-5, 5)), float(rng.uniform(0.97, 1.03)), shift
        ),
        pan_shape=(side, side),
        ms_shape=(ms_side, ms_side),
        ratio=case.ratio,
        pan_centre=textured_centre(imagery, side, rng),
        variant=VARIANTS.get(case.condition, ""),
    )


def _later(source: str, data: Path) -> Imagery:
    """The same ground at another date, on the same grid."""
    if source == "landsat8_twodates":
        return imagery_of(source, data, later=True)
    import rasterio

    with rasterio.open(data / "landsat_geographic/2020.tif") as raster:
        bands = raster.read([3, 2, 1, 4], out_dtype="float32")
        return Imagery(np.nan_to_num(bands), raster.transform, raster.crs.to_wkt(), source)


def _sample() -> Scene:
    """The pair of the README."""
    import rasterio

    with rasterio.open(SAMPLE_FOLDER / "ms.tif") as raster:
        ms = raster.read()
    with rasterio.open(SAMPLE_FOLDER / "pan.tif") as raster:
        pan = raster.read(1)
    return Scene(ms, pan, Truth.load(SAMPLE_FOLDER / "truth.json"))


def _swept(case: Case, imagery: Imagery) -> Scene:
    """MS and PAN of one size, as the paper's; a translation leaves less in common."""
    side = SWEEP_SIDE_PX[case.condition]
    turning = case.condition == "rotation"
    angle = math.radians(TRANSLATION_DEG)
    shift = (0.0, 0.0) if turning else (case.value * math.cos(angle), case.value * math.sin(angle))
    spec = SceneSpec(
        name=case.name,
        description=case.condition,
        error=HeaderError.similarity(case.value if turning else 0.0, 1.0, shift),
        pan_shape=(side, side),
        ms_shape=(round(side / case.ratio), round(side / case.ratio)),
        ratio=case.ratio,
        pan_centre=SWEEP_CENTRE,
    )
    if turning:
        return make_scene(spec, imagery)
    reach = math.ceil(max(map(abs, shift)))
    wide = replace(spec, pan_shape=(side + 2 * reach, side + 2 * reach))
    return crop_pan(
        make_scene(wide, imagery), reach - round(shift[0]), reach - round(shift[1]), side
    )


def crop_pan(scene: Scene, left: int, top: int, side: int) -> Scene:
    """The scene with a square cut-out of its PAN, whose header moves along.

    Parameters
    ----------
    scene : Scene
    left, top : int
        Upper-left pixel of the cut-out.
    side : int
    """
    truth = scene.truth
    transform = Affine(*truth.pan) @ Affine.translation(left, top)
    pan = np.ascontiguousarray(scene.pan[top : top + side, left : left + side])
    truth = replace(truth, pan=tuple(transform)[:6], pan_shape=(side, side))
    return replace(scene, pan=pan, truth=truth)
