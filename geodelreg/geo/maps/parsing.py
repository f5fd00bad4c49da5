"""Maps out of what their `to_json` has made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.projective import ProjectiveMap
from geodelreg.values.maps import PixelMap


def map_of_json(said: Mapping[str, Any]) -> PixelMap:
    """The map again: an affine, a projective one or a field.

    Raises
    ------
    KeyError, TypeError, ValueError
        It is none of these, or broken.
    """
    kinds = {"affine": _affine, "projective": _projective, "field": FieldMap.from_json}
    kind = said["kind"]
    if kind not in kinds:
        raise ValueError(f"{kind!r} is no kind of correction")
    return kinds[kind](said)


def _affine(said: Mapping[str, Any]) -> AffineMap:
    return AffineMap.of(_finite(said["matrix"], (2, 3)))


def _projective(said: Mapping[str, Any]) -> ProjectiveMap:
    return ProjectiveMap(_finite(said["matrix"], (3, 3)))


def _finite(numbers: Any, shape: tuple[int, int]) -> np.ndarray[Any, np.dtype[np.float64]]:
    matrix = np.array(numbers, dtype=np.float64)
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise ValueError("the matrix of a correction is broken")
    return matrix
