"""Transformation models of a raster header: source pixel ↦ where its content lies in header pixels.

A model M turns the geotransform G into G ∘ M.  ``shift`` and ``scale`` (shift and per-axis scale)
keep a north-up raster north-up; ``similarity`` is one on the ground, whatever the pixel's shape.
``projective`` is no affine: no geotransform holds it, and `auto` never takes it.

A new linear model is a branch of `generators`, with its name in `PARAMETER_COUNT`; CONTRIBUTING
lists what else knows models by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from geodelreg.geo.affine import affine_from_matrix
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.maps.projective import ProjectiveMap
from geodelreg.options import FOLLOWING
from geodelreg.pair import Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray

MODEL_ORDER = ("shift", "scale", "similarity", "affine")
NORTH_UP = ("shift", "scale")
NONLINEAR = ("projective",)
"""Their design changes with the parameters."""
PARAMETER_COUNT = {
    "none": 0, "shift": 2, "scale": 4, "similarity": 4, "affine": 6, "projective": 8
}  # fmt: skip
"""As many as `design` has columns."""


def points_that_fix(model: str) -> int:
    """Points that determine a model; of one that follows what bends its trend, an affine."""
    return PARAMETER_COUNT["affine" if model in FOLLOWING else model] // 2


@dataclass(frozen=True, slots=True)
class Frame:
    """Coordinates in which models are linear and well conditioned.

    Attributes
    ----------
    centre : (float, float)
        Pixel that is the origin.
    span_px : float
        Pixels that become 1.
    metric : (float, float, float, float)
        2 × 2, row by row: pixel steps to metres on the ground (a common factor does not matter).
    """

    centre: tuple[float, float]
    span_px: float
    metric: tuple[float, float, float, float] = (1.0, 0.0, 0.0, -1.0)

    @classmethod
    def of(cls, pair: Pair) -> Frame:
        """Of the MS raster: its centre, half its longer side, metric axes."""
        height, width = pair.source.grid.shape
        a, b, c, d = pair.metric.ravel().tolist()
        return cls((width / 2, height / 2), max(height, width) / 2, (a, b, c, d))

    def normalise(self, xy: FloatArray) -> FloatArray:
        """(N, 2) pixels to (N, 2) dimensionless coordinates around the centre."""
        return (np.asarray(xy, dtype=np.float64) - self.centre) / self.span_px


def design(
    model: str, xy: FloatArray, frame: Frame, parameters: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Linear form of a model: ``target ≈ base + D p``, in normalised coordinates.

    Parameters
    ----------
    model : str
        One of `MODEL_ORDER`.
    xy : (N, 2) float64
        Pixels.
    frame : Frame
    parameters : (k,) float64, optional
        Where a model that is not linear is linearised; at the identity when not given.

    Returns
    -------
    D : (N, 2, k) float64
    base : (N, 2) float64
    """
    u = frame.normalise(xy)
    if model == "projective":
        return _projective_design(
            u, np.zeros(PARAMETER_COUNT[model]) if parameters is None else parameters
        )
    ways = generators(model, frame)
    columns = np.zeros((len(u), 2, 2 + len(ways)))
    columns[:, (0, 1), (0, 1)] = 1.0
    for number, way in enumerate(ways, 2):
        columns[:, :, number] = u @ way.T
    return columns, u


def _projective_design(u: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eight parameters: those of the affine, and the two of the horizon."""
    affine, base = design("affine", u, Frame((0.0, 0.0), 1.0))
    horizon = p[affine.shape[2] :]
    depth = (1.0 + u @ horizon)[:, None]
    there = (base + affine @ p[: affine.shape[2]]) / depth
    columns = np.concatenate([affine, -there[:, :, None] * u[:, None, :]], axis=2) / depth[:, None]
    return columns, there - columns @ p


def generators(model: str, frame: Frame) -> FloatArray:
    """(K, 2, 2) how each parameter of a linear model beyond its shift changes steps of pixels."""
    if model == "scale":
        return np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]])
    if model == "affine":
        return np.eye(4).reshape(-1, 2, 2)
    if model == "similarity":
        metric = np.array(frame.metric).reshape(2, 2)
        turn = np.linalg.inv(metric) @ np.array([[0.0, -1.0], [1.0, 0.0]]) @ metric
        return np.stack([np.eye(2), turn])
    return np.empty((0, 2, 2))


def fitted_map(
    model: str, parameters: FloatArray, frame: Frame, covariance: FloatArray | None = None
) -> PixelMap:
    """The map of pixels that the parameters of `design` describe.

    Parameters
    ----------
    model : str
    parameters : (k,) float64
    frame : Frame
    covariance : (k, k) float64, optional
        Of the parameters; without it the map counts as exact.
    """
    sigma = None
    if covariance is not None:
        sigma = partial(_sigma_at, model, frame, parameters, covariance)
    if model == "projective":
        return ProjectiveMap(_homography(parameters, frame), sigma)
    linear = np.eye(2)
    for amount, way in zip(parameters[2:], generators(model, frame), strict=True):
        linear = linear + amount * way
    centre = np.array(frame.centre)
    offset = centre - linear @ centre + parameters[:2] * frame.span_px
    return AffineMap(affine_from_matrix(np.column_stack([linear, offset])), sigma)


def _homography(parameters: FloatArray, frame: Frame) -> FloatArray:
    """(3, 3) of pixels, from parameters in normalised coordinates."""
    count = PARAMETER_COUNT["affine"]
    normal = np.eye(3)
    normal[:2, 2] = parameters[:2]
    normal[:2, :2] += parameters[2:count].reshape(2, 2)
    normal[2, :2] = parameters[count:]
    to_normal = np.diag([1.0, 1.0, frame.span_px])
    to_normal[:2, 2] = -np.array(frame.centre)
    found = np.linalg.inv(to_normal) @ normal @ to_normal
    return np.asarray(found / found[2, 2])


def _sigma_at(
    model: str, frame: Frame, parameters: FloatArray, covariance: FloatArray, xy: FloatArray
) -> FloatArray:
    """(N,) standard error (radial, pixels) at (N, 2) pixels."""
    columns, _ = design(model, xy, frame, parameters)
    spread = np.einsum("nik,kl,nil->n", columns, covariance, columns)
    return np.asarray(np.sqrt(np.maximum(spread, 0)) * frame.span_px)
