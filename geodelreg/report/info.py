"""What geodelreg knows of one raster before it looks at any pixel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from geodelreg.door.names import LOCAL
from geodelreg.door.opening import open_raster as open_dataset
from geodelreg.errors import CrsTransformError, shown
from geodelreg.geo.grid import gsd_px_m, is_north_up
from geodelreg.geo.lonlat import footprint
from geodelreg.masking import quality_bands
from geodelreg.product.provenance import written_tags
from geodelreg.product.report import plain
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Grid


def info(path: str, allow: str = LOCAL) -> dict[str, Any]:
    """Grid, ground sampling distance, CRS, footprint, bands and provenance, as plain JSON values.

    Parameters
    ----------
    path : str
    allow : str
        What may be opened, `AlignOptions.allow`.

    Raises
    ------
    GeodelregError
        The raster cannot be used, and why.
    """
    with open_raster(path, allow=allow) as reader, open_dataset(path, allow=allow) as dataset:
        grid, decimations = reader.grid, reader.decimations
        quality = quality_bands(path, dataset.descriptions)
        bands = [
            {
                "number": number,
                "name": dataset.descriptions[number - 1],
                "dtype": dataset.dtypes[number - 1],
                "colour": dataset.colorinterp[number - 1].name,
                "nodata": dataset.nodatavals[number - 1],
                "quality": quality.get(number),
            }
            for number in dataset.indexes
        ]
        profile = dataset.profile
        driver, block = dataset.driver, dataset.block_shapes[0]
    height, width = grid.shape
    return dict(
        plain(
            {
                "path": path,
                "driver": driver,
                "width": width,
                "height": height,
                "geotransform": grid.transform.to_gdal(),
                "north_up": is_north_up(grid),
                "gsd_m": _gsd(grid),
                "crs": _crs(grid),
                "footprint": footprint(grid, grid.transform),
                "bands": bands,
                "block": [block[1], block[0]],
                "compression": profile.get("compress"),
                "overviews": decimations[1:],
                "provenance": dict(sorted(written_tags(Path(path)).items())),
            }
        )
    )


def _gsd(grid: Grid) -> tuple[float, float]:
    try:
        return gsd_px_m(grid)
    except CrsTransformError:
        return math.nan, math.nan


def _crs(grid: Grid) -> dict[str, Any]:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        crs = CRS.from_wkt(grid.crs_wkt)
        code = crs.to_authority(min_confidence=70)
    except CRSError:
        return {"name": None, "code": None, "wkt": grid.crs_wkt}
    return {"name": crs.name, "code": ":".join(code) if code else None, "wkt": grid.crs_wkt}


def info_text(found: Mapping[str, Any]) -> str:
    """The same in a few lines for people."""
    count = len(found["bands"])
    size = f"{found['width']} × {found['height']} pixels, {count} band{'s' if count > 1 else ''}"
    lines = [
        f"{found['path']}: {found['driver']}, {size}",
        _grid_line(found),
        _crs_line(found["crs"]),
        _footprint_line(found["footprint"]),
        _storage_line(found),
        *map(_band_line, found["bands"]),
        *(f"{name.removeprefix('GEODELREG_').lower().replace('_', ' ')}: {text}"
          for name, text in found["provenance"].items()),
    ]  # fmt: skip
    return "\n".join(shown(line) for line in lines if line)


def _grid_line(found: Mapping[str, Any]) -> str:
    right, down = found["gsd_m"]
    size = "unknown" if right is None else f"{right:.6g} × {down:.6g} m"
    x, y = found["geotransform"][0], found["geotransform"][3]
    turned = "north-up" if found["north_up"] else "rotated or south-up"
    return f"grid: pixels of {size}, {turned}, upper-left corner at {x:.10g}, {y:.10g}"


def _crs_line(crs: Mapping[str, Any]) -> str:
    code = f" ({crs['code']})" if crs["code"] else ""
    return f"CRS: {crs['name'] or 'not understood by PROJ'}{code}"


def _footprint_line(geometry: Mapping[str, Any] | None) -> str:
    if geometry is None:
        return "footprint: unknown"
    many = geometry["type"] == "MultiPolygon"
    polygons = geometry["coordinates"] if many else [geometry["coordinates"]]
    x, y = zip(*(point for polygon in polygons for point in polygon[0]), strict=True)
    return (
        f"footprint: longitude {min(x):.5f} to {max(x):.5f}, latitude {min(y):.5f} to {max(y):.5f}"
    )


def _storage_line(found: Mapping[str, Any]) -> str:
    width, height = found["block"]
    overviews = ", ".join(f"{factor:.4g}" for factor in found["overviews"]) or "none"
    packed = found["compression"] or "not compressed"
    return f"stored: blocks of {width} × {height}, {packed}, overviews: {overviews}"


def _band_line(band: Mapping[str, Any]) -> str:
    parts = [band["dtype"], band["colour"]]
    parts += [] if band["nodata"] is None else [f"no data {band['nodata']:g}"]
    parts += [f"quality band ({band['quality']}), a mask of the others"] if band["quality"] else []
    name = f" {band['name']}" if band["name"] else ""
    return f"band {band['number']}{name}: {', '.join(parts)}"
