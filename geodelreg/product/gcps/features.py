"""Control points as features with a place and fields, whatever file they come from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from geodelreg.errors import GcpFormatError
from geodelreg.geo.crs import map_points
from geodelreg.product.gcps.context import Decoded, GcpContext, crs_wkt_of, numbers
from geodelreg.product.gcps.facts import ENABLE, FIT, MEASURED, fields_of, form_of, read_facts
from geodelreg.values.points import Gcp
from geodelreg.values.raster import FloatArray


def fields_of_gcp(gcp: Gcp) -> dict[str, Any]:
    """What stands beside the geometry of a point."""
    place = {"row": gcp.row, "col": gcp.column, "x": gcp.x, "y": gcp.y, "z": gcp.z}
    return {"id": gcp.id, "info": gcp.info, **place, **fields_of(gcp)}


def gcps_of(
    features: Sequence[Mapping[str, Any]],
    places: FloatArray,
    places_crs: str,
    tolerance: float,
    context: GcpContext | None,
) -> Decoded:
    """Control points of features that a person may have edited, and the CRS of ``x`` and ``y``.

    Of a point that was exported and whose geometry lies elsewhere than its ``x`` and ``y``, the
    geometry holds, and its standard errors do not.  A point that was drawn has a geometry only.

    Parameters
    ----------
    features : sequence of mapping
        Fields of each; None is empty.
    places : (N, 2) float64
        Geometries; NaN where there is none.
    places_crs : str
        WKT of their CRS.
    tolerance : float
        By which they may lie off ``x`` and ``y``, in units of that CRS: files are rounded.
    context : GcpContext, optional
        Of which the CRS is that of MS, for features that name none.

    Raises
    ------
    GcpFormatError
        Something is missing or no number, or the features disagree on the CRS.
    """
    names = {str(item["crs"]) for item in features if item.get("crs")}
    if len(names) > 1:
        raise GcpFormatError("the features have different CRSs")
    crs_wkt = crs_wkt_of(names.pop()) if names else None
    around = crs_wkt or (context.source.crs_wkt if context else places_crs)
    said = np.array([[_coordinate(item, axis) for axis in "xy"] for item in features])
    claimed = map_points(said.reshape(-1, 2), around, places_crs)
    moved = np.abs(places - claimed).max(axis=1, initial=0.0) > tolerance
    inside = map_points(places, places_crs, around)
    rows = zip(features, inside.tolist(), moved.tolist(), strict=True)
    return tuple(_gcp(*row, index) for index, row in enumerate(rows, start=1)), crs_wkt


def _coordinate(item: Mapping[str, Any], axis: str) -> float:
    try:
        return float(item[axis])
    except (KeyError, TypeError, ValueError):
        return math.nan


def _gcp(fields: Mapping[str, Any], place: list[float], moved: bool, index: int) -> Gcp:
    missing = [name for name in ("row", "col", "x", "y") if fields.get(name) is None]
    placed = all(map(math.isfinite, place))
    if missing and not placed:
        raise GcpFormatError(f"feature {index} lacks the properties {', '.join(missing)}")
    facts, enabled = read_facts(fields, f"feature {index}")
    drawn = "x" in missing or "y" in missing
    if drawn or (placed and moved and fields.get(ENABLE) is not None):
        x, y = place
        facts = tuple((name, value) for name, value in facts if name not in MEASURED)
    else:
        x, y = numbers([str(fields["x"]), str(fields["y"])], index)
    column = row = math.nan
    if "row" not in missing and "col" not in missing:
        column, row = numbers([str(fields["col"]), str(fields["row"])], index)
    z = numbers([str(fields.get("z") or 0.0)], index)[0]
    name, info = fields.get("id"), str(fields.get("info") or "")
    form = form_of(fields.get(FIT), f"feature {index}")
    return Gcp(str(name or index), column, row, x, y, z, info, enabled, facts, form)
