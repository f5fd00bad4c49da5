"""How far a correction moves every place, as a raster: for other programs, and to look at.

The convention, which the file's tags repeat: the raster lies where MS lies by its *original*
header.  At the centre of each of its pixels stands how far what MS shows there must move to lie
where it belongs: bands 1 and 2 in metres, along the axes of the map (east and north), bands 3 and 4
in pixels of PAN, along its columns (right) and rows (down), band 5 the standard error in these.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from affine import Affine

from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geo.pixel import pixel_centres
from geodelreg.geotiff.atomic import staged
from geodelreg.product.motion import metres_per_unit
from geodelreg.product.pixels import geotiff_on
from geodelreg.product.provenance import provenance_tags
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import Alignment, Outcome

BANDS = ("east_m", "north_m", "right_px", "down_px", "sigma_px")
_MOST_PLACES = 512  # along either axis: a field bends over many more pixels than lie between
_CONVENTION = (
    "At a place by the original header: how far its content must move; metres along the map's "
    "axes, pixels of PAN along its columns and rows, standard error in pixels of PAN"
)
_METRES = "GEODELREG_METRES_PER_UNIT"


def write_grid(alignment: Alignment, path: Path, overwrite: bool = False) -> None:
    """Write the displacement of a believed alignment as a GeoTIFF.

    Parameters
    ----------
    alignment : Alignment
    path : Path
    overwrite : bool

    Raises
    ------
    OutputExistsError, OutputUnwritableError, CrsTransformError
    """
    import rasterio

    source = alignment.source.grid
    height, width = (min(size, _MOST_PLACES) for size in source.shape)
    step = Affine.scale(source.shape[1] / width, source.shape[0] / height)
    columns, rows = np.meshgrid(pixel_centres(np.arange(width)), pixel_centres(np.arange(height)))
    at = apply_affine(step, np.stack([columns, rows], axis=-1)).reshape(-1, 2)
    metres = metres_per_unit(source, apply_affine(source.transform, at.mean(axis=0)))
    data = displacement(alignment, at, metres).reshape(height, width, len(BANDS))
    profile = geotiff_on(Grid(source.transform @ step, (height, width), source.crs_wkt))
    profile |= {"count": len(BANDS), "dtype": "float64", "compress": "DEFLATE", "predictor": 3}
    with staged(path, overwrite=overwrite) as out, rasterio.open(out, "w", **profile) as dataset:
        dataset.write(np.moveaxis(data, -1, 0))
        dataset.descriptions = BANDS
        dataset.units = ("metre", "metre", "pixel", "pixel", "pixel")
        tags = {"GEODELREG_CONVENTION": _CONVENTION, _METRES: " ".join(map(repr, metres.tolist()))}
        dataset.update_tags(**provenance_tags(alignment), **tags)


def displacement(alignment: Alignment, at: FloatArray, metres: FloatArray) -> FloatArray:
    """(N, 5) values of the bands at (N, 2) MS pixels.

    Parameters
    ----------
    alignment : Alignment
    at : (N, 2) float64
    metres : (2,) float64
        To a unit of the map, along x and y.
    """
    source, reference = alignment.source.grid, alignment.reference.grid
    moved, sigma = at, np.zeros(len(at))
    if alignment.verdict.outcome is Outcome.ALIGNED:
        moved = alignment.solution.map.forward(at)
        sigma = alignment.solution.map.sigma_at(at)
    before, after = (apply_affine(source.transform, xy) for xy in (at, moved))
    one, other = (
        apply_affine(~reference.transform, map_points(xy, source.crs_wkt, reference.crs_wkt))
        for xy in (before, after)
    )
    side = apply_affine(source.transform, at + np.array([1.0, 0.0]))
    wide = apply_affine(~reference.transform, map_points(side, source.crs_wkt, reference.crs_wkt))
    unit = np.hypot(*(wide - one).T)
    sigma_px = np.hypot(sigma * unit, alignment.accuracy.systematic_px if sigma.any() else 0.0)
    return np.column_stack([(after - before) * metres, other - one, sigma_px])
