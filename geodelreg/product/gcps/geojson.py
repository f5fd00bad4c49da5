"""GeoJSON as rasterio's ``rio gcps`` prints it: WGS 84 points, the rest as properties."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geodelreg.errors import GcpFormatError
from geodelreg.geo.crs import map_points
from geodelreg.product.gcps.context import Decoded, GcpContext, crs_name, ground_of
from geodelreg.product.gcps.features import fields_of_gcp, gcps_of
from geodelreg.values.points import Gcp

_RECORD_SEPARATOR = "\x1e"
_MOVED_DEG = 1e-7
"""Seven decimals are what RFC 7946 advises and other programs round to: a centimetre."""


def encode(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of a feature collection.

    Raises
    ------
    GcpFormatError
        If a point lies outside what its CRS can express.
    """
    crs_wkt = context.source.crs_wkt
    positions = map_points(ground_of(gcps), crs_wkt, _wgs84())
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
        "properties": fields_of_gcp(gcp) | {"crs": crs},
    }


def decode(text: str, context: GcpContext | None) -> Decoded:
    """GCPs of a feature collection, a feature, or a sequence of features, one a line.

    Raises
    ------
    GcpFormatError
        If the text is no such GeoJSON or its features disagree on the CRS.
    """
    features = _features(text)
    properties = [_properties(feature) for feature in features]
    places = np.array([_position(feature) for feature in features]).reshape(-1, 2)
    return gcps_of(properties, places, _wgs84(), _MOVED_DEG, context)


def _position(feature: Any) -> tuple[float, float]:
    """Longitude and latitude of a feature's point; NaN where it has none."""
    try:
        longitude, latitude, *_ = feature["geometry"]["coordinates"]
        return float(longitude), float(latitude)
    except (KeyError, TypeError, ValueError):
        return math.nan, math.nan


def _wgs84() -> str:
    from rasterio.crs import CRS

    return str(CRS.from_epsg(4326).to_wkt())


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
