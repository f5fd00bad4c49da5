"""GeoPackage and FlatGeobuf: a layer of points with fields, which programs edit as any other."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.door.names import LOCAL
from geodelreg.door.vectors import check_vector, ogr
from geodelreg.errors import GcpFormatError, RasterUnreadableError
from geodelreg.product.gcps.context import Decoded, GcpContext, crs_name, ground_of
from geodelreg.product.gcps.facts import ENABLE, FIT, STATUS
from geodelreg.product.gcps.features import fields_of_gcp, gcps_of
from geodelreg.values.points import Gcp

_LAYER = "points"
_INSTEAD = ". GeoJSON needs nothing."
_TEXTS, _WHOLE = ("id", "info", "crs", FIT), (ENABLE, STATUS)
_ROUNDING = 1e-9  # of a coordinate: millimetres, which changes of CRS there and back stay below
_DATE = {"OGR_CURRENT_DATE": "1970-01-01T00:00:00Z"}  # the same points are the same bytes


def encode_geopackage(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> bytes:
    """Bytes of a GeoPackage.

    Raises
    ------
    MissingExtraError
    """
    return _encoded(gcps, context, path, driver="GPKG")


def encode_flatgeobuf(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> bytes:
    """Bytes of a FlatGeobuf file, in the order of the points.

    Raises
    ------
    MissingExtraError
    """
    return _encoded(gcps, context, path, driver="FlatGeobuf", SPATIAL_INDEX="NO")


def _encoded(
    gcps: Sequence[Gcp], context: GcpContext, path: Path, driver: str, **options: str
) -> bytes:
    from shapely import points, to_wkb

    pyogrio = ogr(f"{path} needs pyogrio", _INSTEAD)
    crs = crs_name(context.source.crs_wkt)
    rows = [fields_of_gcp(gcp) | {"crs": crs} for gcp in gcps]
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns: list[NDArray[Any]] = [
        np.array([row.get(name) for row in rows], dtype=_kind(name)) for name in names
    ]
    out = io.BytesIO()
    pyogrio.set_gdal_config_options(_DATE)
    try:
        pyogrio.raw.write(
            out, to_wkb(points(ground_of(gcps))), columns, names, crs=context.source.crs_wkt,
            geometry_type="Point", driver=driver, layer=_LAYER, **options,
        )  # fmt: skip
    finally:
        pyogrio.set_gdal_config_options(dict.fromkeys(_DATE))
    return out.getvalue()


def _kind(name: str) -> type:
    return object if name in _TEXTS else np.int32 if name in _WHOLE else np.float64


def decode(path: Path, context: GcpContext | None) -> Decoded:
    """GCPs of the layer ``points``, or of the only one.

    Raises
    ------
    GcpFormatError, MissingExtraError
    """
    from shapely import from_wkb, get_coordinates, get_num_coordinates

    pyogrio = ogr(f"{path} needs pyogrio", _INSTEAD)
    try:
        check_vector(str(path), LOCAL)
        layers = [str(name) for name, _ in pyogrio.list_layers(path)]
        if _LAYER not in layers and len(layers) != 1:
            raise GcpFormatError(f"it has no layer {_LAYER!r} but {', '.join(layers) or 'none'}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of columns that GDAL cannot keep
            about, _, binary, columns = pyogrio.raw.read(
                path, layer=_LAYER if _LAYER in layers else layers[0]
            )
    except (RuntimeError, ValueError, OSError, RasterUnreadableError) as error:
        raise GcpFormatError(f"it cannot be read ({' '.join(str(error).split())})") from error
    if about["crs"] is None:
        raise GcpFormatError("its layer has no CRS", "Give it that of MS.")
    shapes = from_wkb(binary)
    if (get_num_coordinates(shapes) != 1).any():
        raise GcpFormatError("a feature is no point", "Leave points alone in the layer.")
    places = get_coordinates(shapes)
    fields = [str(name) for name in about["fields"]]
    rows = zip(*(column.tolist() for column in columns), strict=True)
    items = [_known(dict(zip(fields, row, strict=True))) for row in rows]
    tolerance = _ROUNDING * float(np.abs(places).max(initial=1.0))
    return gcps_of(items, places, _wkt(str(about["crs"])), tolerance, context)


def _known(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields that hold something; NaN and empty ones do not."""
    return {
        name: value
        for name, value in fields.items()
        if value is not None and not (isinstance(value, float) and math.isnan(value))
    }


def _wkt(crs: str) -> str:
    from rasterio.crs import CRS

    return str(CRS.from_user_input(crs).to_wkt())
