"""GeoJSON as rasterio's ``rio gcps`` prints it: WGS 84 points, the rest as properties."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from geodelreg.errors import GcpFormatError
from geodelreg.geo.crs import map_points
from geodelreg.product.gcps.context import (
    Decoded,
    GcpContext,
    crs_name,
    crs_wkt_of,
    ground_of,
    numbers,
)
from geodelreg.values.points import Gcp

_RECORD_SEPARATOR = "\x1e"


def encode(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of a feature collection.

    Raises
    ------
    GcpFormatError
        If a point lies outside what its CRS can express.
    """
    from rasterio.crs import CRS

    crs_wkt = context.source.crs_wkt
    positions = map_points(ground_of(gcps), crs_wkt, CRS.from_epsg(4326).to_wkt())
    nowhere = [
        gcp.id
        for gcp, position in zip(gcps, positions.tolist(), strict=True)
        if not all(map(math.isfinite, position))
    ]
    if nowhere:
        raise GcpFormatError(
            f"the map coordinates of point {nowhere[0]} have no place in WGS 84, as GeoJSON needs",
            "Correct them, or write another format.",
        )
    name = crs_name(crs_wkt)
    features = [
        _feature(gcp, longitude, latitude, name)
        for gcp, (longitude, latitude) in zip(gcps, positions.tolist(), strict=True)
    ]
    collection = {"type": "FeatureCollection", "features": features}
    return json.dumps(collection, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _feature(gcp: Gcp, longitude: float, latitude: float, crs: str) -> dict[str, Any]:
    return {
        "type": "Feature",
        "id": gcp.id,
        "geometry": {"type": "Point", "coordinates": [longitude, latitude, gcp.z]},
        "properties": {
            "id": gcp.id,
            "info": gcp.info,
            "row": gcp.row,
            "col": gcp.column,
            "x": gcp.x,
            "y": gcp.y,
            "z": gcp.z,
            "crs": crs,
            **dict(gcp.facts),
        },
    }


def decode(text: str, context: GcpContext | None) -> Decoded:
    """GCPs of a feature collection, a feature, or a sequence of features, one a line.

    Raises
    ------
    GcpFormatError
        If the text is no such GeoJSON or its features disagree on the CRS.
    """
    properties = [_properties(feature) for feature in _features(text)]
    properties = [item for item in properties if not item.get("status")]  # 0 is kept
    names = {str(item["crs"]) for item in properties if item.get("crs")}
    if len(names) > 1:
        raise GcpFormatError("the features have different CRSs")
    gcps = tuple(_gcp(item, index) for index, item in enumerate(properties, start=1))
    return gcps, crs_wkt_of(names.pop()) if names else None


def _features(text: str) -> list[Any]:
    try:
        try:
            document = json.loads(text)
        except ValueError:
            lines = text.replace(_RECORD_SEPARATOR, "").splitlines()
            return [json.loads(line) for line in lines if line.strip()]
    except (ValueError, RecursionError) as error:  # also of numbers with thousands of digits
        raise GcpFormatError(f"it is not GeoJSON ({error})") from error
    if isinstance(document, dict) and document.get("type") == "FeatureCollection":
        features = document.get("features")
        return features if isinstance(features, list) else [None]
    return [document]


def _properties(feature: Any) -> dict[str, Any]:
    properties = feature.get("properties") if isinstance(feature, dict) else None
    if not isinstance(properties, dict):
        raise GcpFormatError("it is not a collection of GeoJSON features with properties")
    return properties


def _gcp(item: dict[str, Any], index: int) -> Gcp:
    missing = [name for name in ("row", "col", "x", "y") if name not in item]
    if missing:
        raise GcpFormatError(f"feature {index} lacks the properties {', '.join(missing)}")
    texts = [str(item[name]) for name in ("col", "row", "x", "y")]
    column, row, x, y = numbers(texts, index)
    z = numbers([str(item.get("z") or 0.0)], index)[0]
    return Gcp(str(item.get("id", index)), column, row, x, y, z, str(item.get("info") or ""))
