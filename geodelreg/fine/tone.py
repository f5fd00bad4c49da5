"""A synthetic PAN: non-negative, robust weights of the MS bands that best reproduce PAN."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from geodelreg.values.raster import MAD_TO_SIGMA, TINY, Band, BoolArray, Float32Array, FloatArray

_SLICE = 512  # rows at a time; by hand: ½ to 2 × alike
_TUKEY_WIDE = 4.0
_MAX_CURVED_BANDS = 6  # they have 21 products; by hand: ½ to 2 × alike
_WORTHWHILE = 0.97
"""Of the spread: three percent of it are worth the curvature; by hand: ½ to 2 × alike."""
_RANGE_PERCENT = (0.2, 99.8)  # by hand: ½ to 2 × alike
_TUKEY_ROUNDS = 6  # by hand: ½ to 2 × alike
_RIDGE = 1e-6  # a sample, of standardised products: nothing beside their noise
_ROUNDS = 12  # half of least absolute deviations, half of the biweight; by hand: ½ to 2 × alike
_TUKEY = 3.0
_LEVERAGE = 3.0
_CLEARLY = 0.7  # of the spread; by hand: ½ to 2 × alike
_GRAM_RIDGE = 1e-9  # of the mean power: nothing beside rounding of samples in float32
_MOST_EXCHANGES = 1000  # of 12 bands, which have 4096 sets; a handful is usual
_FLOOR = 1e-3  # of the target's spread; by hand: ½ to 2 × alike
_LEAST_TRUST = 16.0  # samples' worth; by hand: ½ to 2 × alike


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticPan:
    """How the MS bands become an image that looks like PAN.

    Attributes
    ----------
    weights : (B,) float64
        Non-negative linear weights.
    centre, spread, low, high : (B,) float64
        Of the bands: standardisation and range of the curvature terms.
    curvature : (B (B + 1) / 2,) float64
        Weights of the products of standardised bands; zero where linear weights suffice.
    correlation : float
        With the low-passed PAN, robustly weighted.
    """

    weights: FloatArray
    centre: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray
    curvature: FloatArray
    correlation: float

    def __call__(self, bands: list[Band]) -> Band:
        """Combine bands of one grid; valid where every band with a weight is."""
        used = np.flatnonzero((self.weights != 0) | self._curved())
        data = np.zeros(bands[0].data.shape, dtype=np.float32)
        valid = np.ones(bands[0].data.shape, dtype=bool)
        for b in used:
            data += np.float32(self.weights[b]) * bands[b].data
            valid &= bands[b].valid
        if self.curvature.any():
            stack = np.stack([band.data for band in bands])
            for term, weight in zip(self._products(stack), self.curvature, strict=True):
                data += np.float32(weight) * term
        return Band(data, valid, bands[0].grid, "synthetic PAN")

    def _curved(self) -> BoolArray:
        return np.full(len(self.weights), bool(self.curvature.any()))

    def _products(self, stack: Float32Array) -> Iterator[Float32Array]:
        yield from _products(stack, self.centre, self.spread, self.low, self.high)


def _products(
    stack: Float32Array, centre: FloatArray, spread: FloatArray, low: FloatArray, high: FloatArray
) -> Iterator[Float32Array]:
    z = [
        np.asarray((np.clip(values, lo, hi) - mid) / width, dtype=np.float32)
        for values, lo, hi, mid, width in zip(stack, low, high, centre, spread, strict=True)
    ]
    for i, first in enumerate(z):
        for second in z[i:]:
            yield first * second


def single_band(count: int, index: int) -> SyntheticPan:
    """One band as it is."""
    weights = np.zeros(count)
    weights[index] = 1.0
    ones, zeros = np.ones(count), np.zeros(count)
    return SyntheticPan(
        weights, zeros, ones, zeros, ones, np.zeros(count * (count + 1) // 2), float("nan")
    )


def fit_synthetic_pan(bands: Float32Array, target: Float32Array) -> SyntheticPan | None:
    """Fit linear weights robustly, then the curvature that the bands' different tones need.

    A sensor's bands and its PAN differ in gain and tone; with linear weights alone, what curvature
    is left over pulls the match towards single bands.  Curvature is kept only when it explains
    held-out samples better.

    Parameters
    ----------
    bands : (B, N) float32
    target : (N,) float32
        The low-passed PAN at the same places.

    Returns
    -------
    SyntheticPan or None
        None when no band has a positive relation to the target.
    """
    weights, correlation = robust_band_weights(bands, target)
    if not weights.any():
        return None
    stack = bands.astype(np.float64)
    low, high = np.percentile(stack, _RANGE_PERCENT, axis=1)
    centre, spread = stack.mean(axis=1), np.maximum(stack.std(axis=1), TINY)
    curvature = np.zeros(len(bands) * (len(bands) + 1) // 2)
    if len(bands) <= _MAX_CURVED_BANDS:
        products = np.stack(list(_products(bands, centre, spread, low, high)), axis=1)
        linear = ((stack - centre[:, None]) / spread[:, None]).T
        fitted = _curved(products, linear, target - weights @ stack, weights * spread)
        if fitted is not None:
            curvature, weights = fitted[0], fitted[1] / spread
            dark, bright = ((end - centre) / spread for end in (low, high))
            least, most = _rising(fitted[0], fitted[1], dark, bright)
            low, high = centre + spread * least, centre + spread * most
    return SyntheticPan(weights, centre, spread, low, high, curvature, correlation)


def _curved(
    products: Float32Array, linear: FloatArray, left: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Curvature and the linear weights beside it, of standardised bands; None to do without.

    Only bands with a positive weight are bent: one that would lose it goes without.
    """
    first, second = np.triu_indices(len(weights))
    constant = np.ones((len(left), 1))
    free = weights > 0
    while free.any():
        used = free[first] & free[second]
        design = np.column_stack([constant, products[:, used], linear[:, free]])
        without = left + linear[:, ~free] @ weights[~free]
        fitted = _tukey_fit(design, without)
        curvature, steeper = np.zeros(len(first)), np.zeros(len(weights))
        curvature[used] = fitted[1 : 1 + used.sum()]
        steeper[free] = weights[free] + fitted[1 + used.sum() :]
        if (steeper >= 0).all():
            return (curvature, steeper) if _is_worthwhile(design, without, left) else None
        free &= steeper > 0
    return None


def _rising(
    curvature: FloatArray, weights: FloatArray, dark: FloatArray, bright: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The part of the range, (B,) standardised bands each, over which the curvature brightens.

    Few pixels may lie beyond, and yet hold most of the contrast: of clouds, or of an image shaded
    like relief, both sides of a slope would look bright.
    """
    bend = np.zeros((len(weights), len(weights)))
    bend[np.triu_indices(len(weights))] = curvature
    # from the centre towards either end, the slope along the way changes evenly
    slope = float(weights @ (bright - dark))
    ends = []
    for end in (dark, bright):
        change = float(end @ (bend + bend.T) @ (bright - dark))
        share = min(1.0, -slope / change) if change < 0 else 1.0
        ends.append(max(share, 0.0) * end)
    return ends[0], ends[1]


def _is_worthwhile(design: FloatArray, target: FloatArray, plain: FloatArray) -> bool:
    """True when the design explains held-out samples better than a constant does `plain`."""
    train = np.arange(len(target)) % 2 == 0
    predicted = design @ _tukey_fit(design[train], target[train])
    before = _robust_spread((plain - np.median(plain[train]))[~train])
    return _robust_spread((target - predicted)[~train]) < _WORTHWHILE * before


def _robust_spread(values: FloatArray) -> float:
    return MAD_TO_SIGMA * float(np.median(np.abs(values)))


def _tukey_fit(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least squares by Tukey's biweight from the median absolute residual, a little ridge."""
    ridge = np.eye(design.shape[1]) * _RIDGE * len(target)
    trust = np.clip(1 - (target / (_TUKEY_WIDE * _robust_spread(target) + TINY)) ** 2, 0, None)
    fitted: FloatArray = np.zeros(design.shape[1])
    for _ in range(_TUKEY_ROUNDS):
        weighted = design * trust[:, None]
        normal = ridge + sum(
            weighted[start : start + _SLICE].T @ design[start : start + _SLICE]
            for start in range(0, len(target), _SLICE)
        )
        moment = np.einsum("nk,n->k", weighted, target)
        fitted = np.asarray(np.linalg.solve(normal, moment), dtype=np.float64)
        residual = target - np.einsum("nk,k->n", design, fitted)
        scale = _robust_spread(residual)
        trust = np.clip(1 - (residual / (_TUKEY_WIDE * scale + TINY)) ** 2, 0, None) ** 2
    return fitted


def non_negative_weights(gram: FloatArray, moment: FloatArray) -> FloatArray:
    """Minimise ``w' G w − 2 m' w`` over w ≥ 0.

    By exchanging one band at a time between those that are free and those that are 0 until all
    signs are right (Murty 1974), which for a definite G ends; a few bands need a few exchanges.

    Parameters
    ----------
    gram : (B, B) float64
        Positive semi-definite.
    moment : (B,) float64
    """
    count = len(moment)
    ridge = gram + np.eye(count) * _GRAM_RIDGE * max(float(np.trace(gram)), TINY) / count
    free = np.ones(count, dtype=np.bool_)
    rounding = _GRAM_RIDGE * float(np.abs(moment).max())
    weights = np.zeros(count)
    for _ in range(_MOST_EXCHANGES):
        weights = np.zeros(count)
        weights[free] = np.linalg.solve(ridge[np.ix_(free, free)], moment[free])
        wrong = np.flatnonzero(np.where(free, weights < 0, moment - ridge @ weights > rounding))
        if not len(wrong):
            break
        free[wrong[-1]] ^= True
    return np.maximum(weights, 0.0)


def robust_band_weights(bands: Float32Array, target: Float32Array) -> tuple[FloatArray, float]:
    """Weights of the bands, robust against clouds and changed pixels.

    Iteratively reweighted (Tukey's biweight) non-negative least squares with a free constant,
    started from the least absolute deviations: of all pixels, and of those that are bright or dark
    in no band (clouds that only the MS shows have leverage, which no residual betrays).

    Parameters
    ----------
    bands : (B, N) float32
        MS pixels.
    target : (N,) float32
        The low-passed PAN at the same places.

    Returns
    -------
    weights : (B,) float64
        All zero when no band has a positive relation to the target.
    correlation : float
        Weighted correlation of the combination with the target; 0 when all weights are zero.
    """
    x, y = bands.astype(np.float64), target.astype(np.float64)
    weights, correlation, scale = _reweighted(x, y, np.ones(y.shape))
    other, steadier, narrower = _reweighted(x, y, _unremarkable(x))
    if narrower < _CLEARLY * scale and steadier > correlation:
        return other, steadier
    return weights, correlation


def _unremarkable(x: FloatArray) -> FloatArray:
    """(N,) 1 where no band is far from its median, else 0."""
    gap = np.abs(x - np.median(x, axis=1, keepdims=True))
    limit = _LEVERAGE * MAD_TO_SIGMA * np.median(gap, axis=1, keepdims=True)
    return np.asarray((gap <= limit).all(axis=0), dtype=np.float64)


def _reweighted(x: FloatArray, y: FloatArray, start: FloatArray) -> tuple[FloatArray, float, float]:
    """Weights, correlation and robust spread of the residuals, from a first trust in pixels."""
    rows = np.vstack([x, y])
    rows -= rows.mean(axis=1, keepdims=True)
    floor = _FLOOR * float(rows[-1].std()) + TINY
    trust = start
    weights, correlation, scale = np.zeros(len(x)), 0.0, np.inf
    for round_number in range(_ROUNDS):
        total = max(float(trust.sum()), TINY)
        mean = (rows * trust).sum(axis=1) / total
        centred = rows - mean[:, None]
        # einsum, for BLAS would wake its threads for products as thin as these
        second = np.einsum("bn,cn->bc", centred * trust, centred)
        gram, moment, power = second[:-1, :-1], second[:-1, -1], float(second[-1, -1])
        weights = non_negative_weights(gram, moment)
        energy = float(weights @ gram @ weights)
        if energy <= 0 or power <= 0:
            return np.zeros(len(x)), 0.0, np.inf
        correlation = float(weights @ moment) / np.sqrt(energy * power)
        constant = float(mean[-1] - weights @ mean[:-1])
        residual = np.abs(rows[-1] - np.einsum("b,bn->n", weights, rows[:-1]) - constant)
        if round_number < _ROUNDS // 2:
            trust = start / np.maximum(residual, floor)
            scale = MAD_TO_SIGMA * float(np.median(residual))
            continue
        scale = min(scale, MAD_TO_SIGMA * float(np.median(residual)))
        trust = np.clip(1 - (residual / (_TUKEY * scale + TINY)) ** 2, 0, None) ** 2
        if trust.sum() < _LEAST_TRUST:
            break
    return weights, correlation, scale
