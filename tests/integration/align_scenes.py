"""Small scenes of real ground with known truth, as real files.

The ground is the sample pair, pansharpened: 800 × 800 pixels of 10 m in four bands.  MS bands are
rendered from it exactly (`benchmarks.scenes.simulate`), wherever and however their pixels lie.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from scipy import ndimage

from benchmarks.scenes.make import BAND_GAINS, BAND_GAMMAS, BLUR_MS_PX, PAN_GAMMA, PAN_WEIGHTS
from benchmarks.scenes.simulate import Placement, digitise, render, tone
from benchmarks.scenes.truth import Truth, grid_rmse

SAMPLE = Path(__file__).resolve().parents[2] / "sample_tiles"
HEADER_ERROR = Affine.translation(1.84, -1.16)
UTM18 = CRS.from_epsg(32618).to_wkt()
PAN_WINDOW = (80, 80, 640, 640)
MIDDLE = (400.0, 400.0)

Pixels = NDArray[np.uint16]
Bands = NDArray[np.float64]


@dataclass(frozen=True)
class Ground:
    """Four bands in 12-bit counts; `transform` takes their pixels to UTM zone 18N."""

    bands: Bands
    transform: Affine


@lru_cache(maxsize=1)
def ground() -> Ground:
    truth = Truth.load(SAMPLE / "truth.json")
    with rasterio.open(SAMPLE / "pan.tif") as pan, rasterio.open(SAMPLE / "ms.tif") as ms:
        fine, coarse = pan.read(1).astype(np.float64), ms.read().astype(np.float64)
        to_ms = ~Affine(*truth.ms_true) @ pan.transform
        transform = pan.transform
    rows, columns = np.mgrid[: fine.shape[0], : fine.shape[1]] + 0.5
    x, y = to_ms @ (columns, rows)
    smooth = ndimage.gaussian_filter(fine, 4.0)
    index = [y - 0.5, x - 0.5]
    bands = [ndimage.map_coordinates(band, index, order=1, mode="nearest") for band in coarse]
    return Ground(np.stack(bands) * np.clip(fine / smooth, 0.3, 3.0), transform)


@dataclass(frozen=True)
class Scene:
    """Two files and where the MS raster truly lies."""

    ms: Path
    pan: Path
    truth: Truth

    def rmse_px(self, transform: Affine) -> float:
        """Of a geotransform of MS, over 21 × 21 points, in PAN pixels."""
        return grid_rmse(transform, self.truth)["rmse_px"]

    @property
    def before_px(self) -> float:
        return self.rmse_px(Affine(*self.truth.ms_header))


@dataclass(frozen=True)
class Recipe:
    """How a scene is made.

    Attributes
    ----------
    to_ground : Affine
        True MS pixels to pixels of the ground; of `ms_crs` where that is not UTM zone 18N: such
        pixels at the ground's middle.
    shape : tuple of int
        ``(height, width)`` of MS.
    error : Affine
        Header pixels of MS to its true pixels: where the header says a pixel lies, another is.
    pan_ratio : float
        PAN pixel over the ground's.
    ms_crs : str
    land : callable or None
        Changes the ground's bands (4, 800, 800) for both images.
    change : callable or None
        Applied to the finished arrays, MS (4, h, w) and PAN (H, W), before they are written.
    nodata : int or None
    """

    to_ground: Affine
    shape: tuple[int, int]
    error: Affine = HEADER_ERROR
    pan_ratio: float = 1.0
    ms_crs: str = UTM18
    land: Callable[[Bands], Bands] | None = None
    change: Callable[[Pixels, Pixels], None] | None = None
    nodata: int | None = None
    pan_window: tuple[int, int, int, int] = PAN_WINDOW


def centred(ratio: float, side: int, turn: float = 0.0, aspect: float = 1.0) -> Affine:
    """MS pixels to ground pixels: a square of `side` pixels around the ground's middle."""
    scale = Affine.scale(ratio, ratio * aspect)
    middle = Affine.translation(-side / 2, -side / 2)
    return Affine.translation(*MIDDLE) @ Affine.rotation(turn) @ scale @ middle


def about(error: Affine, side: int) -> Affine:
    """A header error, in MS pixels, around the middle of MS instead of its corner."""
    return Affine.translation(side / 2, side / 2) @ error @ Affine.translation(-side / 2, -side / 2)


def make_scene(folder: Path, recipe: Recipe) -> Scene:
    """Render, expose and write ``ms.tif`` and ``pan.tif``."""
    rng, land = np.random.default_rng(1), ground()
    bands = land.bands if recipe.land is None else recipe.land(land.bands)
    true = _true_transform(recipe)
    ms = _expose_ms(bands, _placement(true, recipe), rng)
    pan, pan_transform = _expose_pan(bands, recipe, rng)
    if recipe.change is not None:
        recipe.change(ms, pan)
    header = true @ recipe.error
    truth = Truth(
        name="", description="", source="", ms_crs=recipe.ms_crs, pan_crs=UTM18,
        ms_header=tuple(header)[:6], ms_true=tuple(true)[:6],
        pan=tuple(land.transform @ pan_transform)[:6],
        ms_shape=recipe.shape, pan_shape=(pan.shape[0], pan.shape[1]),
    )  # fmt: skip
    scene = Scene(folder / "ms.tif", folder / "pan.tif", truth)
    write(scene.ms, ms, header, recipe.ms_crs, recipe.nodata)
    write(scene.pan, pan[None], Affine(*truth.pan), UTM18, recipe.nodata)
    return scene


def write(
    path: Path, data: NDArray[np.generic], transform: Affine, crs: str, nodata: int | None = None
) -> Path:
    count, height, width = data.shape
    profile = {"driver": "GTiff", "count": count, "height": height, "width": width}
    with rasterio.open(
        path, "w", dtype=data.dtype, crs=crs, transform=transform, nodata=nodata, **profile
    ) as raster:
        raster.write(data)
    return path


def _true_transform(recipe: Recipe) -> Affine:
    here = ground().transform @ recipe.to_ground
    if recipe.ms_crs == UTM18:
        return here
    change = Transformer.from_crs(UTM18, recipe.ms_crs, always_xy=True)
    height, width = recipe.shape
    columns, rows = np.array([0, 20, 0]) + width / 2, np.array([0, 0, 20]) + height / 2
    x, y = change.transform(*(here @ (columns, rows)))
    scale = Affine.scale((x[1] - x[0]) / 20, (y[2] - y[0]) / 20)
    return Affine.translation(x[0], y[0]) @ scale @ Affine.translation(-width / 2, -height / 2)


def _placement(true: Affine, recipe: Recipe) -> Placement:
    """Where the MS pixels' centres lie in the ground, exactly."""
    back = Transformer.from_crs(recipe.ms_crs, UTM18, always_xy=True)

    def locate(column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = back.transform(*(true @ (column, row)))
        return np.stack(~ground().transform @ (x, y), axis=-1)

    rows, columns = np.mgrid[: recipe.shape[0], : recipe.shape[1]] + 0.5
    middle = np.array([recipe.shape[1] / 2, recipe.shape[0] / 2])
    ends = locate(middle[0] + np.array([-4.0, 4, 0, 0]), middle[1] + np.array([0, 0, -4.0, 4]))
    linear = np.stack([ends[1] - ends[0], ends[3] - ends[2]], axis=1) / 8
    return Placement(locate(columns, rows), linear)


def _expose_ms(bands: Bands, placement: Placement, rng: np.random.Generator) -> Pixels:
    placement, bands = _cropped(placement, bands)
    exposed = [
        digitise(tone(render(band, placement, BLUR_MS_PX), gamma, gain), rng)
        for band, gamma, gain in zip(bands, BAND_GAMMAS, BAND_GAINS, strict=True)
    ]
    return np.stack(exposed)


def _cropped(placement: Placement, bands: Bands) -> tuple[Placement, Bands]:
    """Only the ground that is seen, with a margin beyond the point spread."""
    low = np.maximum(np.floor(placement.centres_px.min(axis=(0, 1))).astype(int) - 40, 0)
    high = np.ceil(placement.centres_px.max(axis=(0, 1))).astype(int) + 40
    part = bands[:, low[1] : max(high[1], 1), low[0] : max(high[0], 1)]
    return Placement(placement.centres_px - low, placement.linear), part


def _expose_pan(bands: Bands, recipe: Recipe, rng: np.random.Generator) -> tuple[Pixels, Affine]:
    column, row, width, height = recipe.pan_window
    radiance = np.tensordot(np.array(PAN_WEIGHTS), bands, axes=1)
    ratio = recipe.pan_ratio
    place = Affine.translation(column, row) @ Affine.scale(ratio)
    if ratio == 1.0:
        seen = radiance[row : row + height, column : column + width]
    else:
        shape = (round(height / ratio), round(width / ratio))
        rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
        centres = np.stack(place @ (columns, rows), axis=-1)
        seen = render(radiance, Placement(centres, np.eye(2) * ratio), BLUR_MS_PX)
    return digitise(tone(seen, PAN_GAMMA), rng), place
