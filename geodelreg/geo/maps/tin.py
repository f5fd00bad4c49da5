"""Small facets: an affine in each triangle of the Delaunay mesh of the points.

The rectification of Zhang, Ma & Zhang (2013).  It passes through every point, noise and all, and
has an edge wherever two facets meet; beyond the mesh it is the affine of all points, moved by what
the nearest place of the mesh's edge is moved against that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from geodelreg.geo.maps.smooth import SmoothMap, point_rows, points_of_rows, solved
from geodelreg.values.raster import FloatArray, IntArray

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

_INVERSE_STEPS = 40  # each shrinks an error at least to the strain's share
_SLIVER = 0.1  # of the longest side: a height below it
_AT_ONCE = 20_000  # places beyond the mesh that are compared with its edges: they fit in memory


@dataclass(frozen=True, eq=False)
class TinMap(SmoothMap):
    """Facets through points: source pixels to header pixels.

    Attributes
    ----------
    source, target : (N, 2) float64
        Points that it passes through, source and header pixels.
    noise_px2 : (N, 2) float64
        Variance of the points along columns and rows, with what bends between them.
    """

    source: FloatArray
    target: FloatArray
    noise_px2: FloatArray

    def forward(self, xy: FloatArray) -> FloatArray:
        """(..., 2) header pixels of (..., 2) source pixels."""
        flat = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        corner, share = self._facets(flat)
        left = np.einsum("mk,mki->mi", share, self._left[corner])
        return np.asarray(self._affine(flat) + left).reshape(np.shape(xy))

    def inverse(self, xy: FloatArray) -> FloatArray:
        """(..., 2) source pixels of (..., 2) header pixels; NaN where it is not found."""
        goal = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        back: FloatArray = np.asarray(np.linalg.inv(self._trend[:2]), dtype=np.float64)
        at = solved(self.forward, goal, (goal - self._trend[2]) @ back, back, _INVERSE_STEPS)
        return np.asarray(at.reshape(np.shape(xy)))

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """(N,) radial standard error at (N, 2) source pixels, out of the variances of corners."""
        corner, share = self._facets(np.asarray(xy, dtype=np.float64))
        total = np.einsum("mk,mk->m", share**2, self.noise_px2.sum(axis=1)[corner])
        return np.asarray(np.sqrt(total))

    @property
    def places(self) -> FloatArray:
        """(T, 2) centres of the facets."""
        return np.asarray(self.source[self._mesh.simplices].mean(axis=1))

    def strain_at(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Largest strain of a facet beyond the points' affine, and its determinant over that's.

        Slivers, which magnify what their points are off, may fold but have no strain.
        """
        number = self._mesh.find_simplex(xy)
        corners = self._mesh.simplices[np.maximum(number, 0)]
        edges = self.source[corners[:, 1:]] - self.source[corners[:, :1]]
        moved = self._left[corners[:, 1:]] - self._left[corners[:, :1]]
        slope = np.linalg.solve(edges, moved) @ np.linalg.inv(self._trend[:2])
        slope[number < 0] = 0.0
        sides2 = (np.concatenate([edges, edges[:, :1] - edges[:, 1:]], axis=1) ** 2).sum(axis=2)
        sliver = np.abs(np.linalg.det(edges)) < _SLIVER * sides2.max(axis=1)
        strain = np.where(sliver, 0.0, np.linalg.norm(slope, ord=2, axis=(1, 2)))
        return strain, np.linalg.det(slope + np.eye(2))

    def to_json(self) -> dict[str, Any]:
        """Every point as source, target and variances."""
        return {"kind": "tin", "points": point_rows(self.source, self.target, self.noise_px2)}

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> TinMap:
        """The same map again.

        Raises
        ------
        KeyError, TypeError, ValueError
            Of what `to_json` has not made.
        """
        return cls(*points_of_rows(said["points"]))

    @cached_property
    def _mesh(self) -> Delaunay:
        from scipy.spatial import Delaunay

        return Delaunay(self.source)

    @cached_property
    def _trend(self) -> FloatArray:
        """(3, 2) affine of least squares."""
        columns = np.column_stack([self.source, np.ones(len(self.source))])
        return np.asarray(np.linalg.lstsq(columns, self.target, rcond=None)[0])

    @cached_property
    def _left(self) -> FloatArray:
        """(N, 2) what that leaves of the points."""
        return np.asarray(self.target - self._affine(self.source))

    def _affine(self, xy: FloatArray) -> FloatArray:
        return np.asarray(xy @ self._trend[:2] + self._trend[2])

    def _facets(self, xy: FloatArray) -> tuple[IntArray, FloatArray]:
        """(M, 3) corners of the facet that each place lies in, and their barycentric shares.

        Beyond the mesh those of the nearest place of its edge.
        """
        number = self._mesh.find_simplex(xy)
        transform = self._mesh.transform[number]
        two = np.einsum("mij,mj->mi", transform[:, :2], xy - transform[:, 2])
        corner = self._mesh.simplices[number].astype(np.intp)
        share = np.column_stack([two, 1.0 - two.sum(axis=1)])
        for place in np.array_split(np.flatnonzero(number < 0), 1 + (number < 0).sum() // _AT_ONCE):
            corner[place], share[place] = self._on_edge(xy[place])
        return corner, share

    def _on_edge(self, xy: FloatArray) -> tuple[IntArray, FloatArray]:
        """The same of the nearest place of the hull."""
        one, other = self._mesh.convex_hull.T
        start, along = self.source[one], self.source[other] - self.source[one]
        part = np.einsum("mei,ei->me", xy[:, None] - start, along) / (along**2).sum(axis=1)
        part = np.clip(part, 0.0, 1.0)
        gap = start + part[..., None] * along - xy[:, None]
        best = np.nan_to_num((gap**2).sum(axis=2), nan=np.inf).argmin(axis=1)
        t = part[np.arange(len(xy)), best]
        return (
            np.column_stack([one[best], other[best], one[best]]).astype(np.intp),
            np.column_stack([1.0 - t, t, np.zeros(len(t))]),
        )
