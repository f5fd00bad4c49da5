"""Where each pixel of a grid lies in a source raster, as a lattice that GDAL's warper looks up.

GDAL warps through any map when a geolocation array of the *target* says where its pixels lie: the
way from target to source is then a bilinear interpolation of that array, without an inverse, a
polynomial or an approximation of GDAL's own.  The lattice is as fine as that needs.  Its nodes come
from a spline through a coarser lattice, on which the map itself is asked.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from affine import Affine

from geodelreg.door.opening import opened_vrt
from geodelreg.geo.maps.header import header_map
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.geo.maps.spline import FINEST_PX, MARGIN, axes, interpolated
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import Correction

TOLERANCE_PX = 1e-3
"""Of a source pixel, between the map and what is interpolated."""
_SPLINE_PX = TOLERANCE_PX / 4
_UNDEFINED = -1e9
"""Far outside of any source."""


@dataclass(frozen=True, slots=True, eq=False)
class Lookup:
    """Source pixels at nodes of a target grid.

    Attributes
    ----------
    nodes : (R, C, 2) float64
        Source pixels, outer corner.
    step : int
        Target pixels between nodes; the first lies `MARGIN` of these up and left of the corner.
    rows : (int, int)
        Of the source, first and past the last, that are seen.
    """

    nodes: FloatArray
    step: int
    rows: tuple[int, int]


def lookups_of(
    placement: PixelMap | None, correction: Correction, grid: Grid, shape: tuple[int, int]
) -> Sequence[Lookup | None]:
    """How the pixels of a target are found, for each part of the source that is smooth.

    Parameters
    ----------
    placement : PixelMap or None
        Source pixels to those of its original header; None where a geotransform says it all.
    correction : Correction
    grid : Grid
        Of the target.
    shape : (int, int)
        Of the source.
    """
    if placement is None:
        return [None]
    header = header_map(grid, Grid(correction.original, shape, correction.crs_wkt))
    found = []
    for part, first, last in placement.pieces():
        rows = tuple(round(min(max(row, 0.0), shape[0])) for row in (first, last))
        if rows[0] < rows[1]:
            found.append(make_lookup(header.then(Inverse(part)), grid.shape, (rows[0], rows[1])))
    return found


def make_lookup(there: PixelMap, shape: tuple[int, int], rows: tuple[int, int]) -> Lookup:
    """Lattice that agrees with a smooth map to `TOLERANCE_PX`.

    Parameters
    ----------
    there : PixelMap
        Target pixels to source pixels.
    shape : (int, int)
        Of the target.
    rows : (int, int)
        Of the source.
    """
    values, step = interpolated(lambda y, x: _asked(there, y, x), shape, _SPLINE_PX)
    nodes = values(*axes(shape, step))
    while step > FINEST_PX:
        y, x = axes(shape, step)
        middle = (nodes[1:, 1:] + nodes[:-1, 1:] + nodes[1:, :-1] + nodes[:-1, :-1]) / 4
        gap = np.abs(values(y[:-1] + step / 2, x[:-1] + step / 2) - middle)
        if not np.nanmax(gap, initial=0.0) > TOLERANCE_PX:
            break
        step //= 2
        nodes = values(*axes(shape, step))
    return Lookup(np.where(np.isfinite(nodes), nodes, _UNDEFINED), step, rows)


def _asked(there: PixelMap, y: FloatArray, x: FloatArray) -> FloatArray:
    def row(at: float) -> FloatArray:
        return there.forward(np.stack([x, np.full(len(x), at)], axis=-1))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.stack(list(pool.map(row, y.tolist())))


@contextmanager
def looked_up(name: str, warped: Any, lookup: Lookup) -> Iterator[Any]:
    """A warped raster whose pixels come from where a lattice says, open, resampled when read.

    Parameters
    ----------
    name : str
        Of the source, for GDAL; one of the program's own.
    warped : rasterio.vrt.WarpedVRT
        Of the same source on the same grid by a geotransform: what it says but for places is kept.
    lookup : Lookup
    """
    import rasterio.shutil
    from rasterio.io import MemoryFile

    with MemoryFile(ext=".vrt") as plain:
        rasterio.shutil.copy(warped, plain.name, driver="VRT")
        root = ElementTree.fromstring(plain.read())
    height, width = lookup.nodes.shape[:2]
    with MemoryFile(ext=".tif") as memory:
        profile = {"driver": "GTiff", "height": height, "width": width, "count": 2}
        placed = Affine.scale(lookup.step)  # without any rasterio warns
        with memory.open(**profile, dtype="float64", transform=placed) as array:
            array.write(np.moveaxis(lookup.nodes, -1, 0) - [[[0.0]], [[lookup.rows[0]]]])
        _look_up(root, name, memory.name, lookup, warped.src_dataset.shape)
        with opened_vrt(ElementTree.tostring(root, encoding="unicode")) as dataset:
            yield dataset


def _look_up(
    root: ElementTree.Element, source: str, array: str, lookup: Lookup, shape: tuple[int, int]
) -> None:
    """Make GDAL's warper take places from a geolocation array of the target."""
    options = root.find("GDALWarpOptions")
    assert options is not None
    for tag in ("SourceDataset", "Transformer"):
        for element in options.findall(tag):
            options.remove(element)
    first, last = lookup.rows
    if lookup.rows != (0, shape[0]):
        source = f"vrt://{source}?srcwin=0,{first},{shape[1]},{last - first}"
    _add(options, "SourceDataset", source, relativeToVRT="0")
    _add(options, "Option", "4", name="SOURCE_EXTRA")  # what bends may be widest within a block
    transformer = _add(_add(options, "Transformer"), "GenImgProjTransformer")
    _add(transformer, "SrcGeoTransform", "0,1,0,0,0,1")
    _add(transformer, "SrcInvGeoTransform", "0,1,0,0,0,1")
    places = _add(_add(transformer, "DstGeoLocTransformer"), "GeoLocTransformer")
    _add(places, "Reversed", "0")
    offset, step = str(-MARGIN * lookup.step), str(lookup.step)
    convention = {
        "X_DATASET": array,
        "X_BAND": "1",
        "Y_DATASET": array,
        "Y_BAND": "2",
        "PIXEL_OFFSET": offset,
        "LINE_OFFSET": offset,
        "PIXEL_STEP": step,
        "LINE_STEP": step,
        "GEOREFERENCING_CONVENTION": "TOP_LEFT_CORNER",
    }
    metadata = _add(places, "Metadata")
    for key, value in convention.items():
        _add(metadata, "MDI", value, key=key)


def _add(
    parent: ElementTree.Element, tag: str, text: str | None = None, **attributes: str
) -> ElementTree.Element:
    element = ElementTree.SubElement(parent, tag, attributes)
    element.text = text
    return element
