"""Measures how far apart two rasters are, independently of geodelreg: windowed correlation.

PAN is low-passed to the MS resolution and sampled at the ground positions of the MS pixels, shifted
by trial offsets; each window's offset is the peak of the normalised cross-correlation.  PAN is
sampled where it is asked for, by a cubic spline on a smooth image, so that no sub-pixel phase is
preferred.  Nothing here is shared with the library's own matching.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.scenes.truth import apply

FloatArray = NDArray[np.float64]
LOW_PASS_MS_PX = 0.45
SMOOTH_MS_PX = 0.5
REFINE_STEPS_PX = (0.5, 0.2, 0.1)
MINIMUM_SHARE = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Pixels and where they are.

    Attributes
    ----------
    data : (B, H, W) float32
    valid : (H, W) bool
    transform : Affine
    crs_wkt : str
    """

    data: NDArray[np.float32]
    valid: NDArray[np.bool_]
    transform: Affine
    crs_wkt: str


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """Offsets of the windows that correlate: MS content minus PAN content, in PAN pixels.

    Attributes
    ----------
    centre_px : (N, 2) float64
        Centres of the windows in MS pixels.
    offset_px : (N, 2) float64
        ``(column, row)``, in PAN pixels.
    score : (N,) float64
        Peak correlation.
    band : str
        What was correlated with PAN.
    """

    centre_px: FloatArray
    offset_px: FloatArray
    score: FloatArray
    band: str

    @property
    def median_px(self) -> tuple[float, float]:
        """Median offset of the windows, columns and rows."""
        if not len(self.score):
            return float("nan"), float("nan")
        column, row = np.median(self.offset_px, axis=0)
        return float(column), float(row)

    @property
    def distance_px(self) -> float:
        """Length of the median offset."""
        return float(np.hypot(*self.median_px))

    @property
    def radial_px(self) -> float:
        """Median length of the windows' offsets: shift, scale, rotation and noise together."""
        return float(np.median(np.hypot(*self.offset_px.T))) if len(self.score) else float("nan")


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """How to measure.

    Attributes
    ----------
    window_px, stride_px : int
        Window side and least spacing, in MS pixels.
    windows_per_side : int
        At most so many windows in a row and in a column.
    search_px : float
        Offsets searched in every direction, in MS pixels.
    minimum_score : float
        Windows that correlate less are left out.
    mask_bright : bool
        Leave out what is bright in PAN (Otsu's threshold) with its surroundings: clouds.
    """

    window_px: int = 48
    stride_px: int = 24
    windows_per_side: int = 14
    search_px: float = 4.0
    minimum_score: float = 0.7


def read_raster(path: Path, bands: list[int] | None = None) -> Raster:
    """Read a raster whole; pixels that are no-data, or not finite, in any band are invalid."""
    import rasterio

    with rasterio.open(path) as source:
        data = source.read(bands, out_dtype="float32")
        valid = source.dataset_mask() > 0
        valid &= np.isfinite(data).all(axis=0)
        return Raster(np.nan_to_num(data), valid, source.transform, source.crs.to_wkt())


def measure_offsets(ms: Raster, pan: Raster, options: MeasureOptions) -> Offsets:
    """Offset of each window of MS from PAN under their geotransforms.

    The band of MS that correlates best, or the mean of all bands, gives a first offset.  There the
    bands are mixed so that they look like PAN (non-negative least squares), which keeps small
    disagreements between the bands out of the result; whichever correlates best is used.

    Parameters
    ----------
    ms : Raster
    pan : Raster
        Its first band is used.
    options : MeasureOptions
    """
    sampler = _Sampler(ms, pan)
    candidates = [(f"band {i + 1}", band.astype(np.float64)) for i, band in enumerate(ms.data)]
    scaled = [(band - band.mean()) / (band.std() + 1e-9) for _, band in candidates]
    candidates.append(("mean", np.mean(scaled, axis=0)))
    searches = [_search(name, band, ms, sampler, options) for name, band in candidates]
    best = max(searches, key=lambda found: _merit(np.array(found.score), options))
    single = _refine(best, sampler, options)
    if not len(single.score):
        return single
    mix = _mix_like_pan(ms, sampler, np.array(single.median_px))
    mixed = _refine(_search("mix", mix, ms, sampler, options), sampler, options)
    return max(single, mixed, key=lambda found: _merit(found.score, options))


def _merit(score: FloatArray, options: MeasureOptions) -> float:
    return float(np.maximum(score - options.minimum_score, 0).sum())


def _mix_like_pan(ms: Raster, pan: _Sampler, offset: FloatArray) -> FloatArray:
    """Non-negative combination of the bands nearest to PAN, PAN being moved by `offset`."""
    from scipy import ndimage, optimize

    height, width = ms.valid.shape
    values, weight = pan.sample((slice(0, height), slice(0, width)), offset)
    used = (weight > 0) & ms.valid
    smooth = [ndimage.gaussian_filter(b.astype(np.float64), SMOOTH_MS_PX)[used] for b in ms.data]
    centred = np.stack([band - band.mean() for band in smooth], axis=1)
    weights, _ = optimize.nnls(centred, values[used] - values[used].mean())
    return np.asarray(np.tensordot(weights, ms.data.astype(np.float64), axes=1))


class _Sampler:
    """PAN at the MS resolution, and its validity, at any offset from the MS pixels."""

    def __init__(self, ms: Raster, pan: Raster) -> None:
        from scipy import ndimage

        height, width = ms.valid.shape
        rows, columns = np.mgrid[:height, :width] + 0.5
        x, y = apply(ms.transform, columns, rows)
        x, y = _change_crs(x, y, ms.crs_wkt, pan.crs_wkt)
        self.position = np.stack(apply(~pan.transform, x, y)) - 0.5
        middle = height // 2, width // 2
        step = self.position[:, middle[0], middle[1] + 1] - self.position[:, middle[0], middle[1]]
        self.ratio = float(np.hypot(*step))
        low_pass = np.hypot(
            LOW_PASS_MS_PX * np.sqrt(max(self.ratio**2 - 1.0, 0.0)), SMOOTH_MS_PX * self.ratio
        )
        filled = np.where(pan.valid, pan.data[0], pan.data[0][pan.valid].mean())
        smooth = ndimage.gaussian_filter(filled.astype(np.float64), low_pass)
        self.coefficients = ndimage.spline_filter(smooth, order=3)
        reach = int(np.ceil(2.0 * low_pass))
        self.good = ndimage.binary_erosion(pan.valid, iterations=reach).astype(np.float64)
        values, weight = self.sample((slice(0, height), slice(0, width)), np.zeros(2))
        self.unmoved = values - values.mean(), weight

    def sample(
        self, window: tuple[slice, slice], offset: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """PAN where MS content would lie if it were `offset` PAN pixels off, and its weight."""
        from scipy import ndimage

        column, row = self.position[(slice(None), *window)] - offset[:, None, None]
        values = ndimage.map_coordinates(
            self.coefficients, [row, column], order=3, mode="nearest", prefilter=False
        )
        weight = ndimage.map_coordinates(self.good, [row, column], order=0, mode="constant", cval=0)
        return values, weight


def _change_crs(
    x: FloatArray, y: FloatArray, source: str, target: str
) -> tuple[FloatArray, FloatArray]:
    from pyproj import CRS, Transformer

    a, b = CRS.from_wkt(source), CRS.from_wkt(target)
    return (x, y) if a == b else Transformer.from_crs(a, b, always_xy=True).transform(x, y)


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """Best whole-pixel offset of every window, in MS pixels, and its correlation."""

    name: str
    band: FloatArray
    valid: NDArray[np.bool_]
    corner: list[tuple[int, int]]
    size: int
    offset: list[FloatArray]
    score: list[float]


def _search(
    name: str, band: FloatArray, ms: Raster, pan: _Sampler, options: MeasureOptions
) -> _Search:
    """Correlate every window at all whole-pixel offsets."""
    from scipy import ndimage

    smooth = ndimage.gaussian_filter(band, SMOOTH_MS_PX)
    valid = ndimage.binary_erosion(ms.valid, iterations=2)
    size = min(options.window_px, *smooth.shape)
    reach = int(np.ceil(options.search_px))
    values, weight = (np.pad(image, reach) for image in pan.unmoved)
    found = _Search(name, smooth, valid, _corners(smooth.shape, size, options), size, [], [])
    for left, top in found.corner:
        window = slice(top, top + size), slice(left, left + size)
        around = slice(top, top + size + 2 * reach), slice(left, left + size + 2 * reach)
        shifted = np.lib.stride_tricks.sliding_window_view(values[around], (size, size))
        weights = np.lib.stride_tricks.sliding_window_view(weight[around], (size, size))
        score = _correlations(smooth[window], shifted, weights * valid[window])
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        # The window over PAN that begins `reach` pixels in is the one that is not moved.
        found.offset.append(np.array([reach - column, reach - row], dtype=np.float64))
        found.score.append(float(score[row, column]))
    return found


def _corners(shape: tuple[int, ...], size: int, options: MeasureOptions) -> list[tuple[int, int]]:
    """Upper-left corners ``(column, row)`` of evenly spread windows."""
    starts = []
    for length in (shape[1], shape[0]):
        room = length - size
        count = min(options.windows_per_side, room // options.stride_px + 1)
        starts.append(np.linspace(0, room, count).astype(int).tolist())
    return [(left, top) for top in starts[1] for left in starts[0]]


def _correlations(patch: FloatArray, shifted: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted correlation of a patch (h, w) with many (n, m, h, w)."""
    n = weight.sum(axis=(2, 3))
    share = np.maximum(n, 1.0)
    patch = patch - patch.mean()
    a = np.einsum("nmhw,hw->nm", weight, patch) / share
    b = np.einsum("nmhw,nmhw->nm", weight, shifted) / share
    aa = np.einsum("nmhw,hw->nm", weight, patch**2) / share - a * a
    bb = np.einsum("nmhw,nmhw,nmhw->nm", weight, shifted, shifted) / share - b * b
    ab = np.einsum("nmhw,nmhw,hw->nm", weight, shifted, patch) / share - a * b
    score = ab / np.sqrt(np.maximum(aa, 1e-9) * np.maximum(bb, 1e-9))
    return np.where(n >= MINIMUM_SHARE * patch.size, score, -1.0)


def _refine(search: _Search, pan: _Sampler, options: MeasureOptions) -> Offsets:
    """Climb from the whole-pixel offsets to the sub-pixel peaks."""
    centres, offsets, scores = [], [], []
    limit = (options.search_px + 1.0) * pan.ratio
    for (left, top), start, rough in zip(search.corner, search.offset, search.score, strict=True):
        if rough < options.minimum_score - 0.15:
            continue
        window = slice(top, top + search.size), slice(left, left + search.size)
        patch, valid = search.band[window], search.valid[window]

        def score(
            offset: FloatArray,
            window: tuple[slice, slice] = window,
            patch: FloatArray = patch,
            valid: NDArray[np.bool_] = valid,
        ) -> float:
            values, weight = pan.sample(window, offset)
            return correlation(patch, values, weight * valid)

        best = start * pan.ratio
        for step in REFINE_STEPS_PX:
            best = _climb(score, best, step * pan.ratio)
        peak = score(best)
        if peak >= options.minimum_score and np.abs(best).max() <= limit:
            centres.append((left + search.size / 2, top + search.size / 2))
            offsets.append(best)
            scores.append(peak)
    return Offsets(
        np.array(centres).reshape(-1, 2),
        np.array(offsets).reshape(-1, 2),
        np.array(scores),
        search.name,
    )


def _climb(score: Callable[[FloatArray], float], centre: FloatArray, step: float) -> FloatArray:
    """One step to the peak of a paraboloid through 3 × 3 correlations."""
    ticks = np.array([(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1)], dtype=np.float64)
    values = np.array([score(centre + tick * step) for tick in ticks])
    i, j = ticks.T
    design = np.stack([np.ones(9), i, j, i * i, i * j, j * j], axis=1)
    _, bi, bj, cii, cij, cjj = np.linalg.lstsq(design, values, rcond=None)[0]
    determinant = 4 * cii * cjj - cij**2
    if determinant <= 0 or cii >= 0:
        return np.asarray(centre + ticks[int(np.argmax(values))] * step)
    peak = np.array([cij * bj - 2 * cjj * bi, cij * bi - 2 * cii * bj]) / determinant
    return np.asarray(centre + np.clip(peak, -1.5, 1.5) * step)


def correlation(a: FloatArray, b: FloatArray, weight: FloatArray) -> float:
    """Weighted normalised cross-correlation; -1 when less than half of the weight is there."""
    total = weight.sum()
    if total < MINIMUM_SHARE * weight.size:
        return -1.0
    a = a - (weight * a).sum() / total
    b = b - (weight * b).sum() / total
    power = (weight * a * a).sum() * (weight * b * b).sum()
    return float((weight * a * b).sum() / np.sqrt(power)) if power > 0 else -1.0
