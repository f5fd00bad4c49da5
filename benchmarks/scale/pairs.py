"""Pairs of any size with known truth, written block by block: what `scale` runs on.

The ground is that of scene J (`benchmarks.scenes.ground.enlarge`), as a function of the place, so
that a raster of 40 000² pixels needs no more memory than a small one.  MS is shifted and scaled but
not turned, so its point spread is separable; the Gaussian in it passes nothing at PAN's sampling
frequency, which makes sums over PAN pixels exact integrals.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from math import ceil, erf, floor, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.scenes.ground import fractal
from benchmarks.scenes.imagery import Imagery
from benchmarks.scenes.make import (
    BAND_GAINS,
    BAND_GAMMAS,
    BLUR_MS_PX,
    PAN_GAMMA,
    PAN_WEIGHTS,
    HeaderError,
    SceneSpec,
    true_grids,
)
from benchmarks.scenes.simulate import FULL_SCALE, READ_NOISE, SHOT_NOISE
from benchmarks.scenes.truth import Truth

Float32Array = NDArray[np.float32]
Span = tuple[int, int]
RATIO = 4
MS_SHARE = 0.93
BLOCK = 512
_CHUNK = 2048
_STRIP_ROWS = 16
_PSF_REACH_PX = 14
_THREADS = 2
FLIPS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
_ERROR = HeaderError((12.3, -7.8), (1.0005, 0.0, 0.0, 0.9996))


@dataclass(frozen=True, slots=True, eq=False)
class EndlessGround:
    """Real imagery magnified to `size`² pixels with real fine texture, window by window.

    Attributes
    ----------
    coarse : (B, s, s) float32
        The imagery to magnify.
    detail : (B, t, t) float32
        Its high-pass, laid out in flipped tiles.
    strength : (n, n) float32
        How strong the detail is, to be magnified, too.
    orientations : (16,) int
    size : int
    """

    coarse: Float32Array
    detail: Float32Array
    strength: Float32Array
    orientations: NDArray[np.intp]
    size: int

    @classmethod
    def of(cls, imagery: Imagery, size: int) -> EndlessGround:
        """Ground of `size`² pixels; the same imagery and size give the same ground."""
        from scipy import ndimage

        rng = np.random.default_rng(zlib.crc32(f"scale {size}".encode()))
        side = min(imagery.shape)
        coarse = imagery.bands[:, :side, :side]
        detail = coarse - ndimage.gaussian_filter(coarse, (0.0, 4.0, 4.0))
        low, high = np.percentile(detail, [0.05, 99.95], axis=(1, 2), keepdims=True)
        texture = fractal((max(size // 32, 8),) * 2, 1.5, rng)
        strength = 0.5 + 0.5 / (1.0 + np.exp(-2.0 * texture))
        orientations = rng.permutation(np.arange(16) % 4)
        clipped = np.clip(detail, low, high).astype(np.float32)
        return cls(coarse, clipped, strength.astype(np.float32), orientations, size)

    def mixed(self, weights: Sequence[float]) -> EndlessGround:
        """A ground of one band, the weighted sum of all."""
        mix = np.array(weights, dtype=np.float32)
        coarse, detail = (np.tensordot(mix, b, axes=1)[None] for b in (self.coarse, self.detail))
        return replace(self, coarse=coarse, detail=detail)

    def radiance(self, rows: Span, columns: Span) -> Iterator[Float32Array]:
        """(h, w) float32 of each band, in a window of PAN's pixels."""
        texture = self._magnified(self.strength, rows, columns)
        for coarse, detail in zip(self.coarse, self.detail, strict=True):
            field = self._magnified(coarse, rows, columns)
            self._add_detail(field, texture, detail, rows[0], columns[0])
            yield np.maximum(field, np.float32(1.0), out=field)

    def _add_detail(
        self,
        field: Float32Array,
        texture: Float32Array,
        detail: Float32Array,
        top: int,
        left: int,
    ) -> None:
        side, (height, width) = len(detail), field.shape
        for row in _pieces((top, top + height), side):
            for column in _pieces((left, left + width), side):
                place = row[0] // side * ceil(self.size / side) + column[0] // side
                down, across = FLIPS[int(self.orientations[place % 16])]
                here = (
                    slice(row[0] - top, row[1] - top),
                    slice(column[0] - left, column[1] - left),
                )
                y, x = row[0] % side, column[0] % side
                cut = detail[::down, ::across][
                    y : y + row[1] - row[0], x : x + column[1] - column[0]
                ]
                field[here] += texture[here] * cut

    def _magnified(self, image: Float32Array, rows: Span, columns: Span) -> Float32Array:
        step = len(image) / self.size
        down, across = (_cubic(span, step, len(image)) for span in (rows, columns))
        return _separable(image, down, across)


def _pieces(span: Span, side: int) -> list[Span]:
    edges = [span[0], *range((span[0] // side + 1) * side, span[1], side), span[1]]
    return list(pairwise(edges))


def _cubic(span: Span, step: float, count: int) -> Any:
    """Sparse matrix that interpolates pixels `span` of the magnified image (Catmull and Rom)."""
    at = (np.arange(*span) + 0.5) * step - 0.5
    first = np.floor(at).astype(np.intp)
    f = at - first
    weights = [
        -0.5 * f + f**2 - 0.5 * f**3,
        1 - 2.5 * f**2 + 1.5 * f**3,
        0.5 * f + 2 * f**2 - 1.5 * f**3,
        -0.5 * f**2 + 0.5 * f**3,
    ]
    index = np.clip(first[:, None] + np.arange(-1, 3), 0, count - 1)
    return _sparse(np.stack(weights, axis=1), index, count)


def _integration(centres: NDArray[np.float64], width: float, start: int, count: int) -> Any:
    """Sparse matrix that integrates PAN pixels over MS pixels of a width: a box and a Gaussian."""
    index = np.floor(centres).astype(np.intp)[:, None] + np.arange(
        -_PSF_REACH_PX, _PSF_REACH_PX + 1
    )
    away = (index + 0.5 - centres[:, None]) / width
    gauss = np.vectorize(lambda x: 0.5 * (1.0 + erf(x / (BLUR_MS_PX * sqrt(2.0)))))
    weights = np.asarray(gauss(away + 0.5) - gauss(away - 0.5), dtype=np.float64)
    return _sparse(weights / weights.sum(axis=1, keepdims=True), index - start, count)


def _sparse(weights: NDArray[np.float64], index: NDArray[np.intp], count: int) -> Any:
    from scipy.sparse import csr_array

    ends = np.arange(0, index.size + 1, index.shape[1])
    entries = (weights.ravel().astype(np.float32), index.ravel(), ends)
    return csr_array(entries, shape=(len(index), count))


def _separable(image: Float32Array, down: Any, across: Any) -> Float32Array:
    """`down` along the rows, then `across` along the columns."""
    used = np.unique(across.indices)
    first, last = int(used[0]), int(used[-1]) + 1
    narrow = down @ np.ascontiguousarray(image[:, first:last])
    return np.ascontiguousarray((across[:, first:last] @ np.ascontiguousarray(narrow.T)).T)


def pair_truth(size: int, imagery: Imagery) -> Truth:
    """Grids of a pair, PAN of `size`² pixels."""
    side = round(MS_SHARE * size / RATIO)
    spec = SceneSpec(
        f"scale {size}", f"PAN {size}², MS {side}²", _ERROR, (size, size), (side, side), RATIO
    )
    step = min(imagery.shape) / size
    return true_grids(spec, imagery, imagery.transform @ Affine.scale(step))


def write_pair(folder: Path, size: int, imagery: Imagery) -> None:
    """Write ``pan.tif``, ``ms.tif`` (uint16, tiled, deflate, no overviews) and ``truth.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    truth, ground = pair_truth(size, imagery), EndlessGround.of(imagery, size)
    _write(folder / "pan.tif", 1, truth.pan, truth.pan_shape, truth.pan_crs, _pan_chunks(ground))
    chunks = _ms_chunks(ground, truth)
    _write(folder / "ms.tif", 4, truth.ms_header, truth.ms_shape, truth.ms_crs, chunks)
    truth.save(folder / "truth.json")


Job = tuple[Span, Span, Any]
"""Rows and columns of a chunk, and the function that makes its (B, h, w) pixels."""


def _pan_chunks(ground: EndlessGround) -> Iterator[Job]:
    pan_ground = ground.mixed(PAN_WEIGHTS)

    def expose(rows: Span, columns: Span) -> NDArray[np.uint16]:
        (seen,) = pan_ground.radiance(rows, columns)
        return _exposed(seen, PAN_GAMMA, 1.0, np.random.default_rng([0, rows[0], columns[0]]))[None]

    whole = (0, ground.size)
    for rows in _pieces(whole, _CHUNK):
        for columns in _pieces(whole, _CHUNK):
            yield rows, columns, expose


def _ms_chunks(ground: EndlessGround, truth: Truth) -> Iterator[Job]:
    to_pan = ~Affine(*truth.pan) @ Affine(*truth.ms_true)

    def expose(rows: Span, columns: Span) -> NDArray[np.uint16]:
        down, fine_rows = integration_axis(rows, to_pan.e, to_pan.f)
        across, fine_columns = integration_axis(columns, to_pan.a, to_pan.c)
        rng = np.random.default_rng([1, rows[0], columns[0]])
        fields = ground.radiance(fine_rows, fine_columns)
        responses = zip(fields, BAND_GAMMAS, BAND_GAINS, strict=True)
        return np.stack(
            [
                _exposed(_separable(f, down, across), gamma, gain, rng)
                for f, gamma, gain in responses
            ]
        )

    height, width = truth.ms_shape
    for rows in _pieces((0, height), BLOCK):
        for columns in _pieces((0, width), BLOCK):
            yield rows, columns, expose


def _exposed(
    radiance: Float32Array, gamma: float, gain: float, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """`tone` and `digitise` of the scenes in single precision, as there are so many."""
    full = np.float32(FULL_SCALE)
    counts = np.power(np.minimum(radiance, full) / full, np.float32(gamma)) * np.float32(
        gain * full
    )
    noise = np.sqrt(np.float32(READ_NOISE**2) + np.float32(SHOT_NOISE) * counts)
    noise *= rng.standard_normal(counts.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(counts + noise), 1, full), dtype=np.uint16)


def integration_axis(span: Span, width: float, offset: float) -> tuple[Any, Span]:
    """Integration matrix of MS pixels along one axis, and the PAN pixels that it takes."""
    centres = np.asarray((np.arange(*span) + 0.5) * width + offset, dtype=np.float64)
    start = floor(centres[0]) - _PSF_REACH_PX
    stop = floor(centres[-1]) + _PSF_REACH_PX + 1
    return _integration(centres, width, start, stop - start), (start, stop)


def _write(
    path: Path,
    count: int,
    transform: tuple[float, ...],
    shape: tuple[int, int],
    crs_wkt: str,
    jobs: Iterator[Job],
) -> None:
    import rasterio
    from rasterio.windows import Window

    profile = {
        **_profile(count, shape, crs_wkt), "transform": Affine(*transform), "tiled": True,
        "blockxsize": BLOCK, "blockysize": BLOCK,
    }  # fmt: skip
    draft = path.with_suffix(".draft.tif")
    with ExitStack() as stack:
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=256_000_000))
        raster = stack.enter_context(rasterio.open(draft, "w", **profile))
        pool = stack.enter_context(ThreadPoolExecutor(_THREADS))
        while some := list(islice(jobs, 2 * _THREADS)):
            made = pool.map(lambda job: job[2](job[0], job[1]), some)
            for (rows, columns, _), pixels in zip(some, made, strict=True):
                raster.write(pixels, window=Window.from_slices(rows, columns))
    draft.replace(path)


def _profile(count: int, shape: tuple[int, int], crs_wkt: str) -> dict[str, Any]:
    return {
        "driver": "GTiff", "dtype": "uint16", "count": count, "height": shape[0],
        "width": shape[1], "crs": crs_wkt, "compress": "deflate", "predictor": 2,
        "bigtiff": "if_safer", "num_threads": _THREADS,
    }  # fmt: skip


def add_overviews(folder: Path, original: Path) -> None:
    """The same pair with overviews of PAN, in a file beside a link to it."""
    import rasterio
    from rasterio.enums import Resampling

    _link(folder, original, ("ms.tif", "pan.tif", "truth.json"))
    env = {"COMPRESS_OVERVIEW": "DEFLATE", "PREDICTOR_OVERVIEW": "2", "TIFF_USE_OVR": "YES"}
    with (
        rasterio.Env(**env, GDAL_CACHEMAX=256_000_000, GDAL_NUM_THREADS=str(_THREADS)),
        rasterio.open(folder / "pan.tif", "r+") as pan,
    ):
        levels = [2**n for n in range(1, 9) if max(pan.shape) >> n >= 256]
        pan.build_overviews(levels, Resampling.average)


def write_striped(folder: Path, original: Path) -> None:
    """The same pair with PAN in strips of 16 rows instead of tiles."""
    import rasterio
    from rasterio.windows import Window

    _link(folder, original, ("ms.tif", "truth.json"))
    with ExitStack() as stack:
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=256_000_000, GDAL_NUM_THREADS="2"))
        pan = stack.enter_context(rasterio.open(original / "pan.tif"))
        profile = {
            **_profile(1, pan.shape, pan.crs.to_wkt()), "transform": pan.transform,
            "blockysize": _STRIP_ROWS,
        }  # fmt: skip
        strips = stack.enter_context(rasterio.open(folder / "pan.tif", "w", **profile))
        for row in range(0, pan.height, BLOCK):
            window = Window(0, row, pan.width, min(BLOCK, pan.height - row))
            strips.write(pan.read(window=window), window=window)


def write_sparse_ms(folder: Path, original: Path, gigabytes: float) -> None:
    """The same pair with MS in a sparse BigTIFF that claims so many gigabytes.

    The raster is uncompressed and larger than what `original` shows of it; the rest has never been
    written.
    """
    import rasterio
    from rasterio.windows import Window

    _link(folder, original, ("pan.tif",))
    with ExitStack() as stack:
        ms = stack.enter_context(rasterio.open(original / "ms.tif"))
        side = ceil(sqrt(gigabytes * 1e9 / 2 / ms.count) / BLOCK) * BLOCK
        profile = {
            **_profile(ms.count, (side, side), ms.crs.to_wkt()), "transform": ms.transform,
            "compress": "none", "predictor": 1, "bigtiff": "yes", "sparse_ok": True, "nodata": 0,
            "tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK,
        }  # fmt: skip
        out = stack.enter_context(rasterio.open(folder / "ms.tif", "w", **profile))
        out.write(ms.read(), window=Window(0, 0, ms.width, ms.height))
    truth = Truth.load(original / "truth.json")
    truth.save(folder / "truth.json")
    _extend(folder / "ms.tif", int(gigabytes * 1e9))


def _extend(path: Path, size: int) -> None:
    """Make a file as long as its pixels would be, all of it a hole."""
    with path.open("r+b") as file:
        file.truncate(max(size, path.stat().st_size))


def _link(folder: Path, original: Path, names: tuple[str, ...]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        link = folder / name
        if not link.exists():
            link.symlink_to((original / name).resolve())
