"""Transformation models of a raster header: source pixel ↦ where its content lies in header pixels.

A model M turns the geotransform G into G ∘ M.  ``shift`` and ``scale`` (shift and per-axis scale)
keep a north-up raster north-up; ``similarity`` is one on the ground, whatever the pixel's shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from affine import Affine

from geodelreg.geo.affine import affine_from_matrix, affine_matrix, apply_affine
from geodelreg.types import FloatArray

MODEL_ORDER = ("shift", "scale", "similarity", "affine")
NORTH_UP = ("shift", "scale")
PARAMETER_COUNT = {"none": 0, "shift": 2, "scale": 4, "similarity": 4, "affine": 6}
IDENTITY: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


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

    def normalise(self, xy: FloatArray) -> FloatArray:
        """(N, 2) pixels to (N, 2) dimensionless coordinates around the centre."""
        return (np.asarray(xy, dtype=np.float64) - self.centre) / self.span_px


@dataclass(frozen=True, slots=True, eq=False)
class Transformation:
    """An affine of one of the models, in pixels.

    Attributes
    ----------
    model : str
        Name of the model.
    matrix : (2, 3) float64
    """

    model: str
    matrix: FloatArray

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Transform (..., 2) points."""
        return apply_affine(affine_from_matrix(self.matrix), np.asarray(xy, dtype=np.float64))

    @property
    def inverse(self) -> Transformation:
        """The transformation back."""
        return Transformation(self.model, affine_matrix(~affine_from_matrix(self.matrix)))

    def residuals(self, source: FloatArray, target: FloatArray) -> FloatArray:
        """(N, 2) transformed source minus target."""
        return self(source) - target

    def affine(self) -> Affine:
        """As an `affine.Affine`."""
        return affine_from_matrix(self.matrix)


def design(model: str, xy: FloatArray, frame: Frame) -> tuple[FloatArray, FloatArray]:
    """Linear form of a model: ``target ≈ base + D p``, in normalised coordinates.

    Parameters
    ----------
    model : str
        One of `MODEL_ORDER`.
    xy : (N, 2) float64
        Pixels.
    frame : Frame

    Returns
    -------
    D : (N, 2, k) float64
    base : (N, 2) float64
    """
    u = frame.normalise(xy)
    x, y = u[:, 0], u[:, 1]
    columns = np.zeros((len(u), 2, PARAMETER_COUNT[model]))
    columns[:, 0, 0] = 1.0
    columns[:, 1, 1] = 1.0
    if model == "scale":
        columns[:, 0, 2], columns[:, 1, 3] = x, y
    elif model == "affine":
        columns[:, 0, 2], columns[:, 0, 3] = x, y
        columns[:, 1, 4], columns[:, 1, 5] = x, y
    elif model == "similarity":
        growth, turn = _similarity_generators(frame)
        columns[:, :, 2], columns[:, :, 3] = u @ growth.T, u @ turn.T
    return columns, u


def _similarity_generators(frame: Frame) -> tuple[FloatArray, FloatArray]:
    metric = np.array(frame.metric).reshape(2, 2)
    turn = np.linalg.inv(metric) @ np.array([[0.0, -1.0], [1.0, 0.0]]) @ metric
    return np.eye(2), turn


def transformation(model: str, parameters: FloatArray, frame: Frame) -> Transformation:
    """Transformation in pixels from the parameters of `design`."""
    linear = np.eye(2)
    if model == "scale":
        linear = np.diag(1.0 + parameters[2:4])
    elif model == "affine":
        linear = np.eye(2) + parameters[2:6].reshape(2, 2)
    elif model == "similarity":
        growth, turn = _similarity_generators(frame)
        linear = np.eye(2) + parameters[2] * growth + parameters[3] * turn
    centre = np.array(frame.centre)
    offset = centre - linear @ centre + parameters[:2] * frame.span_px
    return Transformation(model, np.column_stack([linear, offset]))
