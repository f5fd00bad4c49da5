"""Sub-pixel refinement: least-squares matching of many small patches at once.

Each patch of the coarser image (the template) is compared with the finer image, low-passed to the
template's resolution and sampled through the current transformation.  Gain and offset are free, so
that radiometry does not matter; Gauss–Newton gives displacement and covariance (Gruen 1985;
Ackermann 1984; with the linear regression form, template noise alone enters the residuals).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from geodelreg.fine.patches import Patches, patch_offsets
from geodelreg.fine.surface import Surface, sample_patches
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Status
from geodelreg.values.raster import TINY, BoolArray, Float32Array, FloatArray, IntArray, StatusArray

ROUGH_STEP = 0.04
"""Tolerance where hundredths of a pixel suffice: the step after such a one is much smaller."""
MAX_MOVE = 1.5
"""A patch that moves further than this, in template pixels, has not converged."""
_MAX_STEP = 0.05
"""Nor has one whose last step is above this, in template pixels."""
_MIN_VALID = 0.6
"""Least share of usable pixels in a patch."""
_MIN_VALID_AMONG_STRIPES = 0.3
"""The same where most patches are hidden in part: 43 pixels of the smallest tell four unknowns."""
MIN_CORRELATION = 0.5
"""Least absolute correlation after matching."""
_MAX_SIGMA = 0.5
"""Largest standard error along the worse axis, in template pixels."""
_MARGIN = 1
_ROUNDING = 1e-9  # of the energy: sums of float32 are no better
_LEAST_DETERMINANT = 1e-6  # of three columns of unit length; by hand: ½ to 2 × alike
_UNKNOWN_PX2 = 1e6  # a variance that no weight survives


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """How patches are matched.

    Attributes
    ----------
    size : int
        Side of a patch, in template pixels.
    iterations : int
        Gauss–Newton steps at most.
    tolerance : float
        Patches whose step is below this, in template pixels, take no further one.
    every : int
        Match only every so many-th patch: enough where little is asked of the result.
    bent : bool
        Follow a map that bends within patches, instead of its local affine.
    """

    size: int = 20
    iterations: int = 4
    tolerance: float = 0.01
    every: int = 1
    bent: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """What least-squares matching found, one row per patch.

    Attributes
    ----------
    template_px : (P, 2) float64
        Patch centres.
    surface_px : (P, 2) float64
        Matching positions in the finer image, full-raster pixels.
    covariance_px2 : (P, 2, 2) float64
        Of `surface_px`.
    correlation : (P,) float64
        Of patch and image at the end; negative where contrast is inverted.
    status : (P,) uint8
        `Status` code.
    """

    template_px: FloatArray
    surface_px: FloatArray
    covariance_px2: FloatArray
    correlation: FloatArray
    status: StatusArray

    @classmethod
    def joined(cls, parts: Sequence[Matched]) -> Matched:
        """All of several, in order."""
        if not parts:
            none = np.empty((0, 2))
            return cls(none, none, np.empty((0, 2, 2)), none[:, 0], none[:, 0].astype(np.uint8))
        rows = ([getattr(part, f.name) for part in parts] for f in fields(cls))
        return cls(*(np.concatenate(row) for row in rows))


def match_patches(
    patches: Patches, surfaces: Sequence[Surface], there: PixelMap, options: MatchOptions
) -> Matched:
    """Match patches, each on its surface.

    Parameters
    ----------
    patches : Patches
    surfaces : sequence of Surface
        What `Patches.owner` refers to.
    there : PixelMap
        As it is known so far: template raster pixels to surface raster pixels.
    options : MatchOptions

    Returns
    -------
    Matched
        In the order of `patches`; none dropped.
    """
    count = len(patches)
    local = there.linearise(patches.centre)
    bend = _curvature(there, patches) if options.bent else None
    offsets = patch_offsets(np.arange(patches.size + 2 * _MARGIN) - _MARGIN, patches.size)
    move = np.zeros((count, 2))
    last = np.full(count, np.inf)
    covariance = np.full((count, 2, 2), np.inf)
    correlation = np.zeros(count)
    share = np.zeros(count)
    active = np.arange(count)
    for _ in range(options.iterations):
        if not len(active):
            break
        step = _gauss_newton(patches, surfaces, local, bend, offsets, move, active)
        move[active] += step.move
        covariance[active], correlation[active] = step.covariance, step.correlation
        share[active] = step.usable_share
        last[active] = np.abs(step.move).max(axis=1)
        lost = np.abs(move[active]).max(axis=1) > 2 * MAX_MOVE
        active = active[(last[active] >= options.tolerance) & ~lost]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(_finite(covariance))[:, 1], 0))
    status = np.zeros(count, dtype=np.uint8)
    status[np.abs(correlation) < MIN_CORRELATION] = Status.CORRELATION
    status[(last > _MAX_STEP) | (np.abs(move).max(axis=1) > MAX_MOVE)] = Status.CONVERGENCE
    status[~(spread < _MAX_SIGMA) | (share < least_valid(share))] = Status.TEXTURE
    linear = local[:, :, :2] * patches.step
    position = local[:, :, 2] + np.einsum("pij,pj->pi", linear, move)
    in_surface = np.einsum("pij,pjk,plk->pil", linear, _finite(covariance), linear)
    return Matched(patches.centre, position, in_surface, correlation, status)


def least_valid(share: FloatArray) -> float:
    """Least share of usable pixels in a patch, given (P,) those of all.

    Clouds and edges hide some patches and leave others whole.  Stripes, labels or dead pixels leave
    hardly any whole, and what is left of each has to do.
    """
    some = share[share > 0]
    whole = not len(some) or float(np.median(some)) >= _MIN_VALID
    return _MIN_VALID if whole else _MIN_VALID_AMONG_STRIPES


def _curvature(there: PixelMap, patches: Patches) -> FloatArray:
    """(P, 2, 3) second derivatives by patch pixels: along columns, mixed, and along rows.

    By central differences over half a patch.
    """
    reach, at = patches.size / 2, patches.centre
    right = np.array([patches.step[0] * reach, 0.0])
    down = np.array([0.0, patches.step[1] * reach])
    ways = [0 * right, right, -right, down, -down]
    ways += [right + down, -right - down, right - down, down - right]
    here, e, w, s, n, se, nw, ne, sw = there.forward(np.stack([at + way for way in ways]))
    second = np.stack([e - 2 * here + w, (se + nw - ne - sw) / 4, s - 2 * here + n], axis=-1)
    return np.asarray(second / reach**2)


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    move: FloatArray
    covariance: FloatArray
    correlation: FloatArray
    usable_share: FloatArray


def _gauss_newton(
    patches: Patches,
    surfaces: Sequence[Surface],
    local: FloatArray,
    bend: FloatArray | None,
    offsets: FloatArray,
    move: FloatArray,
    active: IntArray,
) -> _Step:
    """One step for the active patches, from the Gram matrices of image, derivatives, template."""
    n, side = patches.size, patches.size + 2 * _MARGIN
    linear = local[active, :, :2] * patches.step
    anchor = local[active, :, 2] + np.einsum("pij,pj->pi", linear, move[active])
    curved = None if bend is None else bend[active]
    values, usable = sample_patches(
        surfaces, patches.owner[active], anchor, linear, offsets, curved
    )
    image = values.reshape(-1, side, side)
    good = usable.reshape(-1, side, side)[:, 1:-1, 1:-1].reshape(len(active), -1)
    good = good & patches.valid[active]
    bands = patches.values.shape[1]
    cube = np.empty((len(active), 3 + bands, n, n), dtype=np.float32)
    cube[:, 0] = image[:, 1:-1, 1:-1]
    np.subtract(image[:, 1:-1, 2:], image[:, 1:-1, :-2], out=cube[:, 1])
    np.subtract(image[:, 2:, 1:-1], image[:, :-2, 1:-1], out=cube[:, 2])
    cube[:, 1:3] *= np.float32(0.5)
    stack = cube.reshape(len(active), 3 + bands, n * n)
    stack[:, 3:] = patches.values[active]
    total = _centre(stack, good)
    gram = np.matmul(stack, stack.transpose(0, 2, 1)).astype(np.float64)
    solve = _template_on_image if patches.values.shape[1] == 1 else _image_on_bands
    step, covariance, correlation, solvable = solve(gram, total)
    step[~solvable] = 0.0  # those that cannot be solved stay where they are
    covariance[~solvable] = np.inf
    correlation[~solvable] = 0.0
    return _Step(np.clip(step, -1.0, 1.0), covariance, correlation, good.mean(axis=1))


def _centre(stack: Float32Array, good: BoolArray) -> FloatArray:
    """Take each row's mean over good pixels off (P, K, n²) in place, 0 elsewhere; (P,) good ones.

    Where all are good, as nearly everywhere, nothing needs a weight.
    """
    if good.all():
        stack -= stack.mean(axis=2, keepdims=True)
        return np.full(len(stack), float(good.shape[1]))
    weight = good.astype(np.float32)[:, None]
    total = np.maximum(weight.sum(axis=2, keepdims=True), np.float32(1))
    stack *= weight
    stack -= stack.sum(axis=2, keepdims=True) / total
    stack *= weight
    return np.asarray(total[:, 0, 0], dtype=np.float64)


_Solved = tuple[FloatArray, FloatArray, FloatArray, BoolArray]
"""(P, 2) steps, (P, 2, 2) covariances, (P,) correlations, and where there are such."""


def _template_on_image(gram: FloatArray, total: FloatArray) -> _Solved:
    """Regress the (noisy) template on image and derivatives: (P, 4, 4) image, d/dx, d/dy, template.

    The displacement is the derivatives' coefficients over the image's.
    """
    normal, right, energy = gram[:, :3, :3], gram[:, :3, 3], gram[:, 3, 3]
    inverse, solvable = _inverted(normal)
    solution = np.einsum("pij,pj->pi", inverse, right)
    solvable &= (
        (total > 3 * normal.shape[1] + 3)
        & (energy > 0)
        & (solution[:, 0] ** 2 * gram[:, 0, 0] > _ROUNDING * energy)
    )
    gain = np.where(solvable, solution[:, 0], 1.0)
    residual = np.maximum(energy - np.einsum("pi,pi->p", solution, right), _ROUNDING * energy)
    variance = residual / np.maximum(total - 4, 1) / gain**2
    together = np.sqrt(np.maximum(gram[:, 0, 0], TINY) * np.maximum(energy, TINY))
    covariance = inverse[:, 1:, 1:] * variance[:, None, None]
    return solution[:, 1:] / gain[:, None], covariance, gram[:, 0, 3] / together, solvable


def _image_on_bands(gram: FloatArray, total: FloatArray) -> _Solved:
    """Regress the image on bands and derivatives: (P, 3 + B, 3 + B) image, d/dx, d/dy, bands.

    The bands' weights are the patch's own, so that changed fields may change in their own way.
    """
    normal, right, energy = gram[:, 1:, 1:], gram[:, 0, 1:], gram[:, 0, 0]
    inverse, solvable = _inverted(normal)
    solution = np.einsum("pij,pj->pi", inverse, right)
    solvable &= (total > 3 * normal.shape[1]) & (energy > 0)
    residual = np.maximum(energy - np.einsum("pi,pi->p", solution, right), _ROUNDING * energy)
    variance = residual / np.maximum(total - normal.shape[1] - 1, 1)
    by_bands, fine = _inverted(normal[:, 2:, 2:])
    explained = np.einsum("pi,pij,pj->p", right[:, 2:], by_bands, right[:, 2:])
    correlation = np.sqrt(np.clip(explained / np.maximum(energy, TINY), 0, 1))
    covariance = inverse[:, :2, :2] * variance[:, None, None]
    return -solution[:, :2], covariance, correlation, solvable & fine


def _inverted(normal: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Inverses of (P, k, k) normal matrices, and where they exist."""
    count = normal.shape[1]
    scale = np.sqrt(np.maximum(np.einsum("pii->pi", normal), TINY))
    outer = scale[:, :, None] * scale[:, None, :]
    scaled = normal / outer + np.eye(count) * _ROUNDING
    solvable = np.linalg.det(scaled) > _LEAST_DETERMINANT ** (count / 3)
    scaled[~solvable] = np.eye(count)
    return np.linalg.inv(scaled) / outer, solvable


def _finite(covariance: FloatArray) -> FloatArray:
    good = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    return np.where(good[:, None, None], covariance, np.eye(2) * _UNKNOWN_PX2)
