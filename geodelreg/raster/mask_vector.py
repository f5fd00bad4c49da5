"""Vector masks: a pixel of the image is hidden when a polygon, line or point touches it."""

from __future__ import annotations

import json
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.door.names import LOCAL, gdal_name, is_local, needed_access
from geodelreg.door.vectors import EXTENSIONS, GEOJSON, GEOJSON_LINES, check_vector, ogr
from geodelreg.errors import GeodelregError, MaskError, RasterUnreadableError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.masking import AUTO, VECTOR, MaskSpec, Ranges
from geodelreg.values.raster import BoolArray, FloatArray, Grid

Geometries = NDArray[np.object_]

WGS84 = "OGC:CRS84"

_LATTICE = 17
_AROUND = 0.05
_STEP_PX = 4.0
_MARGIN_PX = 2.0


class VectorMask:
    """Geometries that say which pixels of an image to leave out.

    Parameters
    ----------
    spec : MaskSpec
    image : Grid
        Of the full image.
    allow : str
        What may be opened, `AlignOptions.allow`.

    Attributes
    ----------
    kind : str
        ``vector``.
    band : None
    hide : tuple
        Empty.
    covered_share : float
        Always 1: no geometry is an answer, too.
    is_elsewhere : bool
        True when there are geometries and none of them touches the image.

    Raises
    ------
    MaskError
        If the file cannot be read or does not say where it lies.
    AccessNotAllowedError
        If it could be of another format than its ending says.
    MissingExtraError
        If its format needs pyogrio and that is not installed.
    """

    kind, band, covered_share = VECTOR, None, 1.0
    hide: Ranges = ()

    def __init__(self, spec: MaskSpec, image: Grid, allow: str = LOCAL) -> None:
        from shapely import STRtree

        self.path = spec.path
        if spec.kind != AUTO:
            raise MaskError(
                f"the mask {spec.path} is a vector file, whose geometries have no values to choose",
                "Drop what follows the =; everything that a geometry touches is hidden.",
            )
        self._image = image
        geometries, crs = _read(spec.path, allow)
        wkt = _wkt(spec.path, crs, geometries)
        self._shapes = _in_pixels(spec.path, geometries, wkt, image)
        self.is_elsewhere = bool(len(geometries)) and not len(self._shapes)
        self._tree = STRtree(self._shapes)

    def hides(self, grid: Grid) -> BoolArray:
        """(H, W) bool, True for the pixels of `grid`, a part of the image, to be left out."""
        from rasterio.features import rasterize
        from shapely import box, clip_by_rect

        height, width = grid.shape
        relative = ~self._image.transform @ grid.transform
        ends = (relative @ (-_MARGIN_PX, -_MARGIN_PX), relative @ (width + 2.0, height + 2.0))
        (left, top), (right, bottom) = ends
        near = self._shapes[np.sort(self._tree.query(box(left, top, right, bottom)))]
        # what lies outside needs not be burned; the cut edges are in the margin
        parts = clip_by_rect(near, left, top, right, bottom)
        shown = [part for part in parts if not part.is_empty]
        if not shown:
            return np.zeros(grid.shape, dtype=np.bool_)
        burned = rasterize(shown, (height, width), transform=relative, all_touched=True)
        return np.asarray(burned > 0)


def _read(path: str, allow: str) -> tuple[Geometries, str]:
    """Geometries of a file, and its CRS in any form that pyproj knows."""
    if is_local(path) and not Path(path).is_file():
        raise MaskError(f"the mask {path} does not exist", "Check the path.")
    suffix = PurePath(path).suffix.lower()
    if suffix in GEOJSON | GEOJSON_LINES and is_local(path):
        return _read_geojson(path, by_line=suffix in GEOJSON_LINES)
    if suffix not in EXTENSIONS and needed_access(path) == LOCAL:
        raise MaskError(f"the mask {path} is GeoJSON in an archive", "Unpack the archive first.")
    return _read_with_pyogrio(path, allow)


def _read_geojson(path: str, by_line: bool) -> tuple[Geometries, str]:
    from shapely.errors import ShapelyError
    from shapely.geometry import shape

    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        lines = [line.strip("\x1e \r\t") for line in text.split("\n")] if by_line else [text]
        documents = [json.loads(line) for line in lines if line]
        found = [shape(member) for document in documents for member in _members(document)]
        crs = _legacy_crs(documents[0])
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        IndexError,
        ShapelyError,
    ) as e:
        reason = " ".join(str(e).split()) or type(e).__name__
        raise MaskError(
            f"the mask {path} is not GeoJSON ({reason})",
            "Give GeoJSON with polygons, or another vector format.",
        ) from e
    return np.array([one for one in found if not one.is_empty], dtype=object), crs


def _members(document: Any) -> list[dict[str, Any]]:
    """The geometry objects in a GeoJSON object; features without one are left out."""
    kind = document["type"]
    if kind == "FeatureCollection":
        return [member for feature in document["features"] for member in _members(feature)]
    if kind == "Feature":
        return [] if document["geometry"] is None else [document["geometry"]]
    return [document]


def _legacy_crs(document: dict[str, Any]) -> str:
    """CRS of a GeoJSON object: WGS 84 (RFC 7946) unless it says otherwise as in 2008."""
    member = document.get("crs")
    return WGS84 if member is None else str(member["properties"]["name"])


def _read_with_pyogrio(path: str, allow: str) -> tuple[Geometries, str]:
    from shapely import from_wkb

    pyogrio = ogr(f"the mask {path} needs pyogrio to be read", "; or convert the mask to GeoJSON.")
    suffix = PurePath(path).suffix.lower()
    try:
        if suffix in EXTENSIONS:
            check_vector(path, allow)
        # OGR writes what it has learned of a GML file beside it, unless the file is in memory
        in_memory = suffix == ".gml" and is_local(path)
        opened = Path(path).read_bytes() if in_memory else gdal_name(path)
        layers = [str(name) for name, kind in pyogrio.list_layers(opened) if kind is not None]
        if len(layers) != 1:
            raise MaskError(
                f"the mask {path} has {len(layers)} layers with geometries"
                + (f" ({', '.join(layers)})" if layers else ""),
                "A mask has one: ogr2ogr -nln mask one.gpkg FILE LAYER.",
            )
        about, _, binary, _ = pyogrio.raw.read(opened, layer=layers[0], columns=[], force_2d=True)
        found = from_wkb(binary)
    except (RuntimeError, ValueError, OSError, RasterUnreadableError) as error:
        reason = " ".join(str(error).split())
        raise MaskError(
            f"the mask {path} cannot be read ({reason})",
            "Give GeoJSON, GeoPackage, a shapefile or another format that ogrinfo reads.",
        ) from error
    if about["crs"] is None:
        raise MaskError(
            f"the mask {path} has no coordinate reference system",
            "Assign the right one: ogr2ogr -a_srs EPSG:… OUT FILE.",
        )
    keep = [one for one in found if one is not None and not one.is_empty]
    return np.array(keep, dtype=object), str(about["crs"])


def _wkt(path: str, name: str, geometries: Geometries) -> str:
    """WKT of a CRS, after a look at whether the coordinates can be in it."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError
    from shapely import total_bounds

    try:
        crs = CRS.from_user_input(name)
    except CRSError as error:
        raise MaskError(
            f"the coordinate reference system {name!r} of the mask {path} is not known",
            "Correct it; GeoJSON without one is in WGS 84.",
        ) from error
    if crs.is_geographic and len(geometries):
        most = np.abs(total_bounds(geometries)).reshape(2, 2).max(axis=0)
        if most[0] > 360 or most[1] > 90:
            raise MaskError(
                f"the mask {path} is in degrees ({crs.name}), but has coordinates up to "
                f"{most[0]:g}, {most[1]:g}",
                "Say which CRS they are in; GeoJSON without one is in WGS 84.",
            )
    return str(crs.to_wkt())


def _in_pixels(path: str, geometries: Geometries, wkt: str, image: Grid) -> Geometries:
    """Single geometries that touch the image, in its pixels (outer corner).

    They are cut off around the image first, for far away a projection has no image or a wrong one,
    and densified, for what is straight in one CRS is not in another.
    """
    from shapely import (
        STRtree,
        box,
        clip_by_rect,
        get_parts,
        is_valid,
        make_valid,
        segmentize,
        transform,
    )  # fmt: skip

    if not len(geometries):
        return geometries
    broken = ~is_valid(geometries)
    geometries[broken] = make_valid(geometries[broken])
    try:
        around, step = _neighbourhood(image, wkt)
        if around is not None:
            geometries = clip_by_rect(geometries, *around)
        parts = segmentize(get_parts(geometries), step)
        moved = transform(parts, lambda xy: _to_pixels(xy, wkt, image))
    except GeodelregError as error:
        raise MaskError(
            f"the mask {path} cannot be put on the image: {error.cause}", error.remedy
        ) from error
    height, width = image.shape
    flat = _flat(moved)
    return np.asarray(flat[np.sort(STRtree(flat).query(box(0, 0, width, height)))])


def _flat(geometries: Geometries) -> Geometries:
    """Parts of collections in collections, without empty ones and those without an image."""
    from shapely import bounds, get_parts, get_type_id

    while (get_type_id(geometries) >= 4).any():
        geometries = get_parts(geometries)
    return np.asarray(geometries[np.isfinite(bounds(geometries)).all(axis=1)])


def _neighbourhood(image: Grid, wkt: str) -> tuple[tuple[float, float, float, float] | None, float]:
    """Box around the image in another CRS, and the length of some pixels there.

    No box where the image spans the antimeridian or a pole.
    """
    from pyproj import CRS

    height, width = image.shape
    columns, rows = np.meshgrid(np.linspace(0, width, _LATTICE), np.linspace(0, height, _LATTICE))
    ground = apply_affine(image.transform, np.stack([columns, rows], axis=-1))
    there = map_points(ground, image.crs_wkt, wkt).reshape(-1, 2)
    there = there[np.isfinite(there).all(axis=1)]
    if not len(there):
        return None, np.inf
    low, high = there.min(axis=0), there.max(axis=0)
    size = high - low
    step = float(max(size[0] / width, size[1] / height)) * _STEP_PX
    if CRS.from_wkt(wkt).is_geographic and size[0] > 180:
        return None, step
    margin = _AROUND * size + step
    return tuple(np.concatenate([low - margin, high + margin]).tolist()), step


def _to_pixels(xy: FloatArray, wkt: str, image: Grid) -> FloatArray:
    return apply_affine(~image.transform, map_points(xy, wkt, image.crs_wkt))
