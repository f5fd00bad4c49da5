"""The standard error where PAN and MS see different light: stated against true error.

PAN with 0 to 60 % infrared, MS with all bands, some, or one, on crops of real imagery.
"""

from __future__ import annotations

import argparse
import math
import zlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import ndimage

import geodelreg
from benchmarks.accuracy.measure import MeasureOptions, Raster, measure_offsets
from benchmarks.gate.cases import imagery_of
from benchmarks.report import replace_section
from benchmarks.scenes.imagery import Imagery
from benchmarks.scenes.make import PAN_WEIGHTS, HeaderError, SceneSpec, make_scene, write_scene
from benchmarks.scenes.truth import grid_rmse
from geodelreg.errors import GeodelregError

SOURCES = (
    "sentinel2", "landsat8_momotombo", "naip", "landsat8_twodates", "landsat_geographic",
    "landsat8_oman",
)  # fmt: skip
WITHOUT_INFRARED = ("landsat8_oman",)
INFRARED = 3
MIXED = (0.1, 0.25, 0.25, 0.4)
LIGHT = {
    "the same": (PAN_WEIGHTS, (0, 1, 2, 3)),
    "PAN 15 % infrared": ((0.05, 0.4, 0.4, 0.15), (0, 1, 2)),
    "PAN 35 % infrared": ((0.05, 0.3, 0.3, 0.35), (0, 1, 2)),
    "PAN 60 % infrared": ((0.03, 0.17, 0.2, 0.6), (0, 1, 2)),
    "blue alone": (PAN_WEIGHTS, (0,)),
    "green alone": (PAN_WEIGHTS, (1,)),
    "red alone": (PAN_WEIGHTS, (2,)),
    "infrared alone": (PAN_WEIGHTS, (3,)),
    "red and infrared": (PAN_WEIGHTS, (2, 3)),
    "PAN 40 % infrared, blue alone": (MIXED, (0,)),
    "PAN 40 % infrared, green alone": (MIXED, (1,)),
    "PAN 40 % infrared, red alone": (MIXED, (2,)),
    "PAN 40 % infrared, infrared alone": (MIXED, (3,)),
}
"""Weights of blue, green, red and infrared in PAN, and the bands of MS."""
SIDES_PX = ((900, 4.0), (500, 2.0))  # of PAN, and the ratio of pixel sizes
LAND_PX = (0.5, 0.6)  # of the imagery's sides: where crops may be centred about its middle
MS_SHARE = 0.9
GREEN = 1
MEASURED_PX = 1400
ALIKE = MeasureOptions(64, 64, windows_per_side=10, search_px=3.0, minimum_score=0.8)
FEWEST_WINDOWS = 20
SURE_SIGMAS = 3.0
MAD_TO_SIGMA, MEDIAN_OVER_MEAN = 1.4826, 1.2533
"""Of normal errors: standard deviation over median deviation, and the standard error of a median
over that of a mean."""


@dataclass(frozen=True, slots=True)
class Draw:
    """One pair: what it is made of, and what came out."""

    source: str
    light: str
    error_px: float
    sigma_px: float
    systematic_px: float

    @property
    def normalised(self) -> float:
        """True over stated error."""
        return self.error_px / self.sigma_px


def together(imagery: Imagery) -> Imagery:
    """The imagery with its bands moved to where its green one is, where they surely lie apart.

    Bands of a product can lie some tenths of a pixel apart, as infrared and green of Sentinel-2 do.
    Any mix of them then has a place of its own, and no truth.  The distance is measured by
    windows that look alike in both, which share no code with the library.
    """
    bands = imagery.bands.copy()
    part = np.s_[:MEASURED_PX, :MEASURED_PX]
    valid = np.asarray((bands[:, *part] > 0).all(axis=0))
    seen = [
        Raster(band[None][:, *part], valid, imagery.transform, imagery.crs_wkt) for band in bands
    ]
    for band, one in enumerate(seen):
        found = measure_offsets(one, seen[GREEN], ALIKE)
        if band == GREEN or len(found.score) < FEWEST_WINDOWS:
            continue
        offset = np.array(found.median_px)
        spread = MAD_TO_SIGMA * np.median(np.abs(found.offset_px - offset), axis=0)
        error = np.hypot(*spread) * MEDIAN_OVER_MEAN / math.sqrt(len(found.score))
        if np.hypot(*offset) > SURE_SIGMAS * error:
            bands[band] = ndimage.shift(bands[band], -offset[::-1], order=3, mode="nearest")
    return replace(imagery, bands=bands)


def draws(data: Path, repeat: int) -> Iterator[Draw | None]:
    """Every light on crops of every source; None of a pair that was refused."""
    for source in SOURCES:
        imagery = together(imagery_of(source, data))
        for number in range(repeat):
            rng = np.random.default_rng(zlib.crc32(f"{source} {number}".encode()))
            wanted, ratio = SIDES_PX[number % len(SIDES_PX)]
            side = min(wanted, min(imagery.shape) - 4)
            ends = (np.array(imagery.shape[::-1]) - side - 4) / 2
            x, y = np.array(imagery.shape[::-1]) / 2 + rng.uniform(-1, 1, 2) * ends * LAND_PX
            for light, (weights, bands) in LIGHT.items():
                if source in WITHOUT_INFRARED and (weights[INFRARED] or INFRARED in bands):
                    continue
                spec = SceneSpec(
                    f"{source} {light} {number}",
                    light,
                    HeaderError((float(rng.uniform(-4, 4)), float(rng.uniform(-4, 4)))),
                    pan_shape=(side, side),
                    ms_shape=(int(MS_SHARE * side / ratio),) * 2,
                    ratio=ratio,
                    pan_centre=(float(x), float(y)),
                    pan_weights=weights,
                    ms_bands=bands,
                )
                yield _draw(spec, imagery, source, light)


def _draw(spec: SceneSpec, imagery: Imagery, source: str, light: str) -> Draw | None:
    with TemporaryDirectory() as name:
        folder, scene = Path(name), make_scene(spec, imagery)
        write_scene(scene, folder)
        try:
            found = geodelreg.align(folder / "ms.tif", folder / "pan.tif")
        except GeodelregError:
            return None
    error_px = grid_rmse(found.correction.corrected, scene.truth)["rmse_px"]
    accuracy = found.accuracy
    return Draw(source, light, error_px, accuracy.sigma_corner_px, accuracy.systematic_px)


def table(found: list[Draw], refused: int) -> str:
    """RMS of the normalised error by light and by source, and the medians of both errors."""
    lines = [
        "| light or source | pairs | RMS of error / sigma | median error, PAN px | median sigma |",
        "|---|---|---|---|---|",
    ]
    groups: dict[str, list[Draw]] = defaultdict(list)
    for draw in found:
        groups[draw.light].append(draw)
    for draw in found:
        if draw.light != next(iter(LIGHT)):
            groups[draw.source].append(draw)
    for name, some in [*groups.items(), ("**all**", found)]:
        rms = math.sqrt(float(np.mean([draw.normalised**2 for draw in some])))
        error = float(np.median([draw.error_px for draw in some]))
        sigma = float(np.median([draw.sigma_px for draw in some]))
        lines.append(f"| {name} | {len(some)} | {rms:.2f} | {error:.4f} | {sigma:.4f} |")
    return "\n".join([*lines, "", f"Refused: {refused}."])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks unshared``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real imagery")
    parser.add_argument("--repeat", type=int, default=2, help="crops of each source")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def run(args: argparse.Namespace) -> int:
    """Draw, and print the table; into a page where one is given."""
    found = list(draws(args.data, args.repeat))
    accepted = [draw for draw in found if draw is not None]
    page = table(accepted, len(found) - len(accepted))
    print(page)
    if args.docs is not None:
        replace_section(args.docs, "unshared", page)
    return 0
