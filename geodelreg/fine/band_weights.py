"""Non-negative weights of the MS bands that reproduce PAN, robust against clouds and change."""

from __future__ import annotations

import numpy as np

from geodelreg.values.raster import MAD_TO_SIGMA, TINY, Float32Array, FloatArray

_ROUNDS = 12  # half of least absolute deviations, half of the biweight; unexplained: ablate
_TUKEY = 3.0
_LEVERAGE = 3.0
_CLEARLY = 0.7  # of the spread; unexplained: ablate
_RIDGE = 1e-9  # of the mean power: nothing beside rounding of samples in float32
_FLOOR = 1e-3  # of the target's spread; unexplained: ablate
_LEAST_TRUST = 16.0  # samples' worth; unexplained: ablate


def non_negative_weights(gram: FloatArray, moment: FloatArray) -> FloatArray:
    """Minimise ``w' G w − 2 m' w`` over w ≥ 0 (Lawson & Hanson 1974).

    Parameters
    ----------
    gram : (B, B) float64
        Positive semi-definite.
    moment : (B,) float64
    """
    from scipy.linalg import cholesky, solve_triangular
    from scipy.optimize import nnls

    count = len(moment)
    ridge = gram + np.eye(count) * _RIDGE * max(float(np.trace(gram)), TINY) / count
    upper = cholesky(ridge)
    return np.asarray(nnls(upper, solve_triangular(upper, moment, trans="T"))[0], dtype=np.float64)


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
        trusted = rows * trust
        mean = trusted.sum(axis=1) / total
        # einsum, for BLAS would wake its threads for products as thin as these
        second = np.einsum("bn,cn->bc", trusted, rows) - total * np.multiply.outer(mean, mean)
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
