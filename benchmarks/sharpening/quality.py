"""How good a sharpened image is, against the image that it should be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_BLOCK_PX = 32
"""Side of the blocks that Q2n is averaged over, as its authors use it."""


@dataclass(frozen=True, slots=True)
class Quality:
    """Figures of a sharpened image; the first two are best at 0, the others at 1.

    Attributes
    ----------
    ergas : float
        Relative error, per cent of the mean over the GSD ratio (Wald 2000).
    sam_deg : float
        Mean angle between spectra.
    scc : float
        Correlation of the high frequencies.
    q2n : float
        Hypercomplex quality index (Garzelli and Nencini 2009).
    qnr : float
        Quality without a reference (Alparone and others 2008).
    """

    ergas: float
    sam_deg: float
    scc: float
    q2n: float
    qnr: float


def quality_of(
    sharpened: FloatArray, reference: FloatArray, ms: FloatArray, pan: FloatArray, ratio: int
) -> Quality:
    """Compare a sharpened image with the reference, and with what it was made of.

    Parameters
    ----------
    sharpened, reference : (H, W, B) float64
    ms : (H / ratio, W / ratio, B) float64
        Where it truly lies.
    pan : (H, W) float64
    ratio : int
    """
    import sewar

    return Quality(
        ergas=float(sewar.ergas(reference, sharpened, r=1 / ratio)),
        sam_deg=float(np.degrees(sewar.sam(reference, sharpened))),
        scc=float(sewar.scc(reference, sharpened)),
        q2n=q2n(reference, sharpened),
        qnr=float(sewar.qnr(pan, ms, sharpened, r=ratio)),
    )


def q2n(reference: FloatArray, image: FloatArray) -> float:
    """Quality index of images of any number of bands, as hypercomplex numbers.

    Parameters
    ----------
    reference, image : (H, W, B) float64
    """
    size = 1 << max(reference.shape[2] - 1, 0).bit_length()
    blocks = []
    for top in range(0, reference.shape[0] - _BLOCK_PX + 1, _BLOCK_PX):
        for left in range(0, reference.shape[1] - _BLOCK_PX + 1, _BLOCK_PX):
            part = (slice(top, top + _BLOCK_PX), slice(left, left + _BLOCK_PX))
            blocks.append(_q_of_block(_padded(reference[part], size), _padded(image[part], size)))
    return float(np.mean(blocks))


def _padded(block: FloatArray, size: int) -> FloatArray:
    """(N, size) hypercomplex numbers of pixels; missing components are 0."""
    flat = block.reshape(-1, block.shape[2])
    return np.pad(flat, ((0, 0), (0, size - flat.shape[1])))


def _q_of_block(one: FloatArray, other: FloatArray) -> float:
    mean_one, mean_other = one.mean(axis=0), other.mean(axis=0)
    mixed = hyper_product(one, conjugate(other)).mean(axis=0)
    covariance = mixed - hyper_product(mean_one, conjugate(mean_other))
    variances = ((one - mean_one) ** 2).sum(axis=1).mean() + ((other - mean_other) ** 2).sum(
        axis=1
    ).mean()
    means = (mean_one**2).sum() + (mean_other**2).sum()
    if variances == 0 or means == 0:
        return float(np.array_equal(one, other))
    lengths = np.linalg.norm(mean_one) * np.linalg.norm(mean_other)
    return float(4 * np.linalg.norm(covariance) * lengths / (variances * means))


def conjugate(numbers: Any) -> FloatArray:
    """Hypercomplex numbers (..., 2^n) with all but the first component negated."""
    signs = -np.ones(np.shape(numbers)[-1])
    signs[0] = 1.0
    return np.asarray(numbers * signs)


def hyper_product(one: Any, other: Any) -> FloatArray:
    """Product of hypercomplex numbers (..., 2^n), by Cayley and Dickson."""
    one, other = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    half = one.shape[-1] // 2
    if not half:
        return np.asarray(one * other)
    a, b, c, d = one[..., :half], one[..., half:], other[..., :half], other[..., half:]
    real = hyper_product(a, c) - hyper_product(conjugate(d), b)
    imaginary = hyper_product(d, a) + hyper_product(b, conjugate(c))
    return np.concatenate([real, imaginary], axis=-1)
