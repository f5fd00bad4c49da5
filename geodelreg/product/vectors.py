"""Vectors and lists of points of a scene, with a correction applied to their coordinates."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from geodelreg.door.vectors import GEOJSON, check_vector, ogr
from geodelreg.errors import RasterUnreadableError, VectorUnreadableError
from geodelreg.geotiff.atomic import staged, write_text_atomically
from geodelreg.product.stored import StoredCorrection
from geodelreg.values.raster import FloatArray

WGS84 = "OGC:CRS84"
CSV = frozenset({".csv"})
GEOPACKAGE = frozenset({".gpkg"})
VECTORS = GEOJSON | CSV | GEOPACKAGE
"""Endings of files whose coordinates can be corrected."""
_COLUMNS = {
    ("lon", "lat"): True,
    ("longitude", "latitude"): True,
    ("x", "y"): False,
    ("easting", "northing"): False,
}
"""Names of coordinates in a CSV file, and whether they are degrees (WGS 84) or in the MS CRS."""


def write_vector(
    stored: StoredCorrection, source: Path, target: Path, overwrite: bool, force: bool
) -> None:
    """Write a vector file with corrected coordinates; all else stays as it is.

    Parameters
    ----------
    stored : StoredCorrection
    source, target : Path
        Of the same ending: GeoJSON (WGS 84, or the CRS that it names), GeoPackage, or CSV with
        columns lon and lat (WGS 84), or x and y (in the CRS of MS).
    overwrite : bool
    force : bool
        Also where the file lies elsewhere than the raster that was aligned.

    Raises
    ------
    VectorUnreadableError, CorrectionMisfitError, MissingExtraError
    OutputExistsError, OutputUnwritableError
    """
    kind = source.suffix.lower()
    if kind in GEOPACKAGE:
        _write_geopackage(stored, source, target, overwrite, force)
        return
    try:
        text = source.read_text(encoding="utf-8-sig")
        moved = (_csv if kind in CSV else _geojson)(stored, str(source), text, force)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, IndexError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise VectorUnreadableError(
            f"{source} cannot be read ({reason})",
            "Give GeoJSON, GeoPackage, or CSV with columns lon,lat or x,y.",
        ) from error
    write_text_atomically(target, moved, overwrite)


def _mover(
    stored: StoredCorrection, name: str, xy: FloatArray, crs: str, force: bool
) -> FloatArray:
    """(N, 2) corrected coordinates."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        wkt = str(CRS.from_user_input(crs).to_wkt())
    except CRSError as error:
        raise ValueError(f"its CRS {crs!r} is not known") from error
    if not len(xy):
        return xy
    if not force:
        stored.check_share(name, stored.inside(xy, wkt))
    return stored.ground(xy, wkt)


def _geojson(stored: StoredCorrection, name: str, text: str, force: bool) -> str:
    document = json.loads(text)
    member = document.get("crs")
    crs = WGS84 if member is None else str(member["properties"]["name"])
    places: list[list[float]] = []
    _collect(document, places)
    xy = np.array([place[:2] for place in places], dtype=np.float64).reshape(-1, 2)
    for place, (x, y) in zip(places, _mover(stored, name, xy, crs, force).tolist(), strict=True):
        place[:2] = [x, y]
    _drop_boxes(document)
    return json.dumps(document, ensure_ascii=False) + "\n"


def _collect(member: Any, places: list[list[float]]) -> None:
    """Positions of all geometries in a GeoJSON object, to be changed in place."""
    kind = member["type"]
    if kind == "FeatureCollection":
        for feature in member["features"]:
            _collect(feature, places)
    elif kind == "Feature":
        if member["geometry"] is not None:
            _collect(member["geometry"], places)
    elif kind == "GeometryCollection":
        for geometry in member["geometries"]:
            _collect(geometry, places)
    else:
        _positions(member["coordinates"], places)


def _positions(nested: Any, places: list[list[float]]) -> None:
    if nested and isinstance(nested[0], int | float):
        places.append(nested)
        return
    for part in nested:
        _positions(part, places)


def _drop_boxes(member: Any) -> None:
    """Take off bounding boxes, which are not right any more."""
    member.pop("bbox", None)
    for part in member.get("features", []):
        _drop_boxes(part)
    if isinstance(member.get("geometry"), dict):
        _drop_boxes(member["geometry"])


def _csv(stored: StoredCorrection, name: str, text: str, force: bool) -> str:
    dialect = csv.Sniffer().sniff(text[:4096], delimiters=",;\t")
    head, *rows = list(csv.reader(io.StringIO(text), dialect))
    lower = [cell.strip().lower() for cell in head]
    pair = next((p for p in _COLUMNS if set(p) <= set(lower)), None)
    if pair is None:
        raise ValueError(f"no columns lon,lat or x,y among {', '.join(head)}")
    at = [lower.index(column) for column in pair]
    rows = [row for row in rows if row]
    xy = np.array([[float(row[i]) for i in at] for row in rows], dtype=np.float64).reshape(-1, 2)
    crs = WGS84 if _COLUMNS[pair] else stored.source.crs_wkt
    for row, values in zip(rows, _mover(stored, name, xy, crs, force).tolist(), strict=True):
        for index, value in zip(at, values, strict=True):
            row[index] = repr(value)
    out = io.StringIO()
    csv.writer(out, dialect, lineterminator="\n").writerows([head, *rows])
    return out.getvalue()


def _write_geopackage(
    stored: StoredCorrection, source: Path, target: Path, overwrite: bool, force: bool
) -> None:
    pyogrio = ogr(f"{source} needs pyogrio to be read", "; or convert the file to GeoJSON.")
    from shapely import from_wkb, get_coordinates, set_coordinates, to_wkb

    try:
        check_vector(str(source), "local")
        layers = [str(layer) for layer, _ in pyogrio.list_layers(source)]
        with staged(target, overwrite=overwrite) as out:
            for layer in layers:
                about, _, binary, columns = pyogrio.raw.read(source, layer=layer)
                shapes = from_wkb(binary)
                xy = get_coordinates(shapes)
                moved = _mover(stored, str(source), xy, str(about["crs"]), force)
                pyogrio.raw.write(
                    out,
                    to_wkb(set_coordinates(shapes.copy(), moved)),
                    columns,
                    about["fields"],
                    crs=about["crs"],
                    geometry_type=about["geometry_type"],
                    layer=layer,
                    driver="GPKG",
                    append=layer != layers[0],
                )
    except (RuntimeError, ValueError, OSError, RasterUnreadableError) as error:
        reason = " ".join(str(error).split())
        raise VectorUnreadableError(
            f"{source} cannot be read ({reason})", "Give GeoJSON, GeoPackage or CSV."
        ) from error
