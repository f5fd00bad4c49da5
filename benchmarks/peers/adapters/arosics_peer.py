"""AROSICS: one global shift (default), or its local tie points after a global shift.

Written for GDAL 3.6, which AROSICS needs two small additions to.  Its environment has Debian's GDAL
and no rasterio, so the geotransform is read from AROSICS itself.  Footprints of the valid pixels
are not computed (`calc_corners`): with GDAL 3.6 their GeoJSON cannot be parsed on ragged no-data.

Expert: ``max_shift`` beyond any shift of the scenes, with the window of 256 pixels that holds it,
then tie points every 12 pixels in windows of 64, what its outlier filters leave, on the bands
weighted as PAN sees them (the weights need a place, so all of it is done twice).
"""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal, ogr
from scattered import affine_without_outliers, smooth_field

FloatArray = NDArray[np.float64]

GREEN_BAND = 2
MAX_SHIFT_MS_PX = 80
WIDE_WINDOW, WINDOW = (256, 256), (64, 64)
LOCAL_SHIFT_MS_PX = 10
EVERY_MS_PX = 12
FEWEST_POINTS = 6
CHECK_POINTS_PER_SIDE = 21


@contextlib.contextmanager
def _config_options(options: dict[str, str], thread_local: bool = True) -> Iterator[None]:
    old = {key: gdal.GetConfigOption(key) for key in options}
    for key, value in options.items():
        gdal.SetConfigOption(key, value)
    try:
        yield
    finally:
        for key, value in old.items():
            gdal.SetConfigOption(key, value)


def _extend_gdal() -> None:
    if not hasattr(gdal, "config_options"):
        gdal.config_options = _config_options
    for handle in (gdal.Dataset, ogr.DataSource):
        if not hasattr(handle, "__enter__"):
            handle.__enter__ = lambda self: self
            handle.__exit__ = lambda self, *error: None


def _global(ms: str, pan: str, **settings: object) -> list[float]:
    """Geotransform of MS moved by the one shift found, as the affine's six coefficients."""
    from arosics import COREG

    found = COREG(pan, ms, calc_corners=False, q=True, **settings)
    found.calculate_spatial_shifts()
    if not found.success:
        raise SystemExit("AROSICS reports no success")
    _, _, _, x, y, dx, dy, *_ = found.coreg_info["updated map info"]
    return [float(dx), 0.0, float(x), 0.0, -float(dy), float(y)]


def _copy(ms: str, out: Path, transform: list[float], grey: FloatArray | None = None) -> str:
    """MS, or one band of its size, with another geotransform."""
    source = gdal.Open(ms)
    count = source.RasterCount if grey is None else 1
    raster = gdal.GetDriverByName("GTiff").Create(
        str(out), source.RasterXSize, source.RasterYSize, count, gdal.GDT_Float32
    )
    raster.SetProjection(source.GetProjection())
    a, b, c, d, e, f = transform
    raster.SetGeoTransform((c, a, b, f, d, e))
    for band in range(count):
        pixels = source.GetRasterBand(band + 1).ReadAsArray() if grey is None else grey
        raster.GetRasterBand(band + 1).WriteArray(pixels.astype(np.float32))
    raster.FlushCache()
    return str(out)


def _header(path: str) -> list[float]:
    c, a, b, f, d, e = gdal.Open(path).GetGeoTransform()
    return [a, b, c, d, e, f]


def _tie_points(ms: str, pan: str, band: int) -> tuple[FloatArray, FloatArray]:
    """Pixels of MS (N, 2) and where they belong on the grid of its header."""
    from arosics import COREG_LOCAL

    found = COREG_LOCAL(
        pan, ms, grid_res=EVERY_MS_PX, window_size=WINDOW, max_shift=LOCAL_SHIFT_MS_PX,
        s_b4match=band, calc_corners=False, q=True, CPUs=2,
    )  # fmt: skip
    found.calculate_spatial_shifts()
    table = found.CoRegPoints_table
    table = table[(table["ABS_SHIFT"] != -9999) & (table["OUTLIER"] == False)]  # noqa: E712
    if len(table) < FEWEST_POINTS:
        raise SystemExit(f"{len(table)} tie points, too few for an affine")
    place = table[["X_MAP", "Y_MAP"]].to_numpy(float)
    true = place + table[["X_SHIFT_M", "Y_SHIFT_M"]].to_numpy(float)
    a, _, c, _, e, f = _header(ms)
    return (place - (c, f)) / (a, e), (true - (c, f)) / (a, e)


def _on_grid(header: list[float], matrix: FloatArray) -> list[float]:
    """Geotransform of a north-up header after a (2, 3) correction of its grid."""
    a, _, c, _, e, f = header
    (m, n, o), (p, q, r) = matrix.tolist()
    return [a * m, a * n, a * o + c, e * p, e * q, e * r + f]


def _band_mix(ms: str, pan: str, transform: list[float], folder: Path) -> FloatArray:
    """The bands weighted as PAN sees them, by least squares under a geotransform of MS."""
    moved = gdal.Open(_copy(ms, folder / "moved.tif", transform))
    seen = gdal.GetDriverByName("MEM").Create(
        "", moved.RasterXSize, moved.RasterYSize, 1, gdal.GDT_Float32
    )
    seen.SetProjection(moved.GetProjection())
    seen.SetGeoTransform(moved.GetGeoTransform())
    gdal.Warp(seen, pan, resampleAlg="average")
    bands, reference = moved.ReadAsArray().astype(float), seen.ReadAsArray().astype(float)
    known = (reference > 0) & (bands > 0).all(axis=0)
    design = np.column_stack([*bands[:, known], np.ones(int(known.sum()))])
    weights = np.linalg.lstsq(design, reference[known], rcond=None)[0]
    return np.asarray(np.tensordot(weights[:-1], bands, axes=1))


def _expert(ms: str, pan: str, folder: Path) -> tuple[list[float], FloatArray, FloatArray]:
    """A shifted header, pixels of MS and where they belong on its grid.

    Tie points are sought on the mean of the visible bands, then on the band mix that these allow.
    """
    grey = gdal.Open(ms).ReadAsArray()[:3].astype(float).mean(axis=0)
    one = _copy(ms, folder / "grey.tif", _header(ms), grey)
    header = _global(one, pan, max_shift=MAX_SHIFT_MS_PX, ws=WIDE_WINDOW)
    points = _tie_points(_copy(ms, folder / "shifted.tif", header, grey), pan, 1)
    first = _on_grid(header, affine_without_outliers(*points))
    grey = _band_mix(ms, pan, first, folder)
    return header, *_tie_points(_copy(ms, folder / "mixed.tif", header, grey), pan, 1)


def main() -> None:
    """Write the corrected geotransform, or where the check points lie in PAN."""
    parser = argparse.ArgumentParser()
    for name in ("--ms", "--pan", "--out"):
        parser.add_argument(name, required=True)
    parser.add_argument("--setting", choices=("default", "expert", "local"), default="default")
    args = parser.parse_args()
    _extend_gdal()
    out = Path(args.out)
    if args.setting == "default":
        bands = gdal.Open(args.ms).RasterCount
        result = _global(args.ms, args.pan, s_b4match=min(GREEN_BAND, bands))
        out.write_text(json.dumps({"transform": result}))
        return
    header, source, target = _expert(args.ms, args.pan, out.parent)
    if args.setting == "expert":
        result = _on_grid(header, affine_without_outliers(source, target))
        out.write_text(json.dumps({"transform": result}))
        return
    raster = gdal.Open(args.ms)
    sides = (
        np.linspace(0, size, CHECK_POINTS_PER_SIDE)
        for size in (raster.RasterXSize, raster.RasterYSize)
    )
    at = np.stack([axis.ravel() for axis in np.meshgrid(*sides)], axis=1)
    a, _, c, _, e, f = header
    ground = smooth_field(source, target, at) * (a, e) + (c, f)
    a, _, c, _, e, f = _header(args.pan)
    out.write_text(json.dumps({"points": ((ground - (c, f)) / (a, e)).tolist()}))


if __name__ == "__main__":
    main()
