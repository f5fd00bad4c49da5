"""How surprising agreement is: the number of false alarms, a contrario, and a binomial tail."""

from __future__ import annotations

import math

import numpy as np

from geodelreg.values.raster import FloatArray, IntArray

_LN_10 = math.log(10)  # between the bases
_RESIDUAL_FLOOR_PX = 0.1
"""Positions are no better, and a residual of 0 would prove everything; by hand: ½ to 2 × alike."""


def log_nfa(
    residual_px: FloatArray, area_px2: float, sample_size: int, max_residual_px: float = math.inf
) -> tuple[float, float]:
    """Expected number of chance agreements as good as this one (number of false alarms).

    A contrario model: matched points fall anywhere in the reference, uniformly and independently
    (Moisan & Stival 2004, doi:10.1023/B:VISI.0000013094.38752.5c; the form of Moulon, Monasse &
    Marlet 2012, doi:10.1007/978-3-642-37447-0_20).  Below 0 (less than one false alarm), agreement
    is unlikely to be chance; a gate should ask for much less.

    Parameters
    ----------
    residual_px : (M,) float64
        Radial residuals of all one-to-one matches that were available to the search, outliers too.
    area_px2 : float
        Area of the reference in which the matches could fall.
    sample_size : int
        Matches that fix the model: 1 for a shift, 2 for a similarity, 3 for an affine.
    max_residual_px : float
        Largest inlier threshold considered.

    Returns
    -------
    log10_nfa : float
        Minimum over the inlier thresholds; ``inf`` when there are no more matches than
        `sample_size`.
    threshold_px : float
        Where it is reached; NaN when it is not.
    """
    residual = np.sort(np.maximum(residual_px, _RESIDUAL_FLOOR_PX))
    count = len(residual)
    inliers = np.arange(sample_size + 1, count + 1)
    inliers = inliers[residual[inliers - 1] <= max_residual_px]
    if len(inliers) == 0:
        return math.inf, math.nan
    probability = np.minimum(np.pi * residual[inliers - 1] ** 2 / area_px2, 1.0)
    log_counts = (
        math.log10(count - sample_size)
        + (_log_choose(count, inliers) + _log_choose(inliers, sample_size)) / _LN_10
        + (inliers - sample_size) * np.log10(probability)
    )
    best = int(log_counts.argmin())
    return float(log_counts[best]), float(residual[inliers[best] - 1])


def log10_binomial_tail(successes: int, trials: int, probability: float) -> float:
    """log10 of P(X ≥ successes) for a binomial X, far below the smallest float too."""
    if successes <= trials * probability:
        return 0.0
    k = np.arange(successes, trials + 1)
    odds = math.log(probability) - math.log1p(-probability)
    terms = _log_choose(trials, k) + k * odds + trials * math.log1p(-probability)
    return min(float(np.logaddexp.reduce(terms)) / _LN_10, 0.0)


def signed_ranks(differences: FloatArray) -> tuple[float, float]:
    """Whether positive values are larger than negative ones (Wilcoxon 1945, doi:10.2307/3001968).

    Parameters
    ----------
    differences : (N,) float64
        At least one.

    Returns
    -------
    log10_tail : float
        log10 of P(sum of the ranks of positive values as large), were signs a matter of chance: by
        the normal approximation, whose mean and variance are exact.
    share : float
        Share of the sum of ranks that positive values hold; by chance about a half.
    """
    from scipy.special import log_ndtr

    order = np.argsort(np.abs(differences), kind="stable")
    rank = np.argsort(order, kind="stable").astype(np.float64) + 1.0
    positive, total = rank[differences > 0].sum(), rank.sum()
    spread = math.sqrt(float((rank**2).sum())) / 2
    tail = float(log_ndtr(-float(positive - total / 2) / spread)) / _LN_10
    return tail, float(positive / total)


def _log_choose(n: IntArray | int, k: IntArray | int) -> FloatArray:
    """Natural logarithm of the numbers of ways to choose k of n."""
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, np.max(n) + 1)))])
    return np.asarray(log_factorial[n] - log_factorial[k] - log_factorial[np.subtract(n, k)])
