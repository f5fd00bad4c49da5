"""From pixels of one raster to those of another, as their headers claim."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from affine import Affine

from geodelreg.geo.crs import CrsOperation, crs_operation, map_pixels, same_crs
from geodelreg.geo.maps.smooth import SmoothMap
from geodelreg.values.raster import FloatArray, Grid

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class HeaderMap(SmoothMap):
    """Source pixels to reference pixels through both geotransforms and the change of CRS.

    Attributes
    ----------
    source, reference : Grid
    operation : CrsOperation
    """

    source: Grid
    reference: Grid
    operation: CrsOperation

    def forward(self, xy: FloatArray) -> FloatArray:
        """(..., 2) source pixels to (..., 2) reference pixels; NaN where undefined."""
        return map_pixels(xy, self.source, self.reference)

    def inverse(self, xy: FloatArray) -> FloatArray:
        """(..., 2) reference pixels to (..., 2) source pixels; NaN where undefined."""
        return map_pixels(xy, self.reference, self.source)

    def to_json(self) -> dict[str, Any]:
        """Both geotransforms, in GDAL's order, with their CRSs."""
        sides = {"source": self.source, "reference": self.reference}
        return {"kind": "headers"} | {
            side: {"geotransform": grid.transform.to_gdal(), "crs_wkt": grid.crs_wkt}
            for side, grid in sides.items()
        }

    def as_affine(self) -> Affine | None:
        """Of equal CRSs; else None."""
        if not same_crs(self.source.crs_wkt, self.reference.crs_wkt):
            return None
        affine: Affine = ~self.reference.transform @ self.source.transform
        return affine


def header_map(source: Grid, reference: Grid) -> HeaderMap:
    """Map between two rasters' pixels.

    Raises
    ------
    CrsTransformError
        If PROJ knows no operation between the CRSs.
    """
    operation = crs_operation(source.crs_wkt, reference.crs_wkt)
    if operation.warning:
        logger.warning(operation.warning)
    return HeaderMap(source, reference, operation)
