"""The truth of a scene, and the distance of a corrected geotransform from it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from affine import Affine
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
CHECK_POINTS_PER_SIDE = 21


@dataclass(frozen=True, slots=True)
class Truth:
    """What a tool must find, and the grids to measure it on.

    Attributes
    ----------
    name, description, source : str
    ms_crs, pan_crs : str
        WKT.
    ms_header, ms_true : tuple of 6 float
        Geotransforms of the MS raster, as written in its header and as it should be: the
        coefficients ``a b c d e f`` of ``x = a·column + b·row + c``, ``y = d·column + e·row + f``,
        (0, 0) being the outer corner of the upper-left pixel.
    pan : tuple of 6 float
        Geotransform of the PAN raster, correct by definition.
    ms_shape, pan_shape : tuple of 2 int
        ``(height, width)``.
    """

    name: str
    description: str
    source: str
    ms_crs: str
    pan_crs: str
    ms_header: tuple[float, ...]
    ms_true: tuple[float, ...]
    pan: tuple[float, ...]
    ms_shape: tuple[int, int]
    pan_shape: tuple[int, int]

    def save(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> Truth:
        """Read what `save` wrote."""
        fields = json.loads(path.read_text(encoding="utf-8"))
        for key in ("ms_header", "ms_true", "pan", "ms_shape", "pan_shape"):
            fields[key] = tuple(fields[key])
        return cls(**fields)


def check_points(shape: tuple[int, int], per_side: int = CHECK_POINTS_PER_SIDE) -> FloatArray:
    """Regular grid of positions over a raster, its corners included.

    Returns
    -------
    (per_side², 2) float64
        Outer-corner ``(column, row)``, in pixels.
    """
    height, width = shape
    column, row = np.meshgrid(np.linspace(0, width, per_side), np.linspace(0, height, per_side))
    return np.stack([column.ravel(), row.ravel()], axis=1)


def apply(transform: Affine, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Transform arrays of coordinates."""
    a, b, c, d, e, f = tuple(transform)[:6]
    return a * x + b * y + c, d * x + e * y + f


def to_pan_px(transform: Affine, xy: FloatArray, truth: Truth) -> FloatArray:
    """(N, 2) PAN pixels of (N, 2) MS pixels under a geotransform of MS."""
    from pyproj import CRS, Transformer

    x, y = apply(transform, xy[:, 0], xy[:, 1])
    ms_crs, pan_crs = CRS.from_wkt(truth.ms_crs), CRS.from_wkt(truth.pan_crs)
    if ms_crs != pan_crs:
        x, y = Transformer.from_crs(ms_crs, pan_crs, always_xy=True).transform(x, y)
    return np.stack(apply(~Affine(*truth.pan), x, y), axis=1)


def pan_errors(corrected: Affine, truth: Truth) -> FloatArray:
    """(441, 2) float64: found minus true PAN position of the check points, in PAN pixels."""
    xy = check_points(truth.ms_shape)
    return to_pan_px(corrected, xy, truth) - to_pan_px(Affine(*truth.ms_true), xy, truth)


def grid_rmse(corrected: Affine, truth: Truth) -> dict[str, float]:
    """Radial error of a corrected geotransform over 21 × 21 check points of the MS raster.

    Parameters
    ----------
    corrected : Affine
        Geotransform of the MS raster, in the MS CRS, that a tool found.
    truth : Truth

    Returns
    -------
    dict
        ``rmse_px``, ``p95_px``, ``max_px``, in PAN pixels.
    """
    error = pan_errors(corrected, truth)
    radial = np.hypot(error[:, 0], error[:, 1])
    return {
        "rmse_px": float(np.sqrt(np.mean(radial**2))),
        "p95_px": float(np.percentile(radial, 95)),
        "max_px": float(radial.max()),
    }
