"""AROSICS: one global shift (default), or its local tie points and an affine through them (best).

Written for GDAL 3.6, which AROSICS needs two small additions to.  Its environment has Debian's GDAL
and no rasterio, so the geotransform is read from AROSICS itself.  Footprints of the valid pixels
are not computed (`calc_corners`): with GDAL 3.6 their GeoJSON cannot be parsed on ragged no-data.
"""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from osgeo import gdal, ogr

GREEN_BAND = 2
MAX_SHIFT_MS_PX = 20
FEWEST_POINTS = 6


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


def _global(ms: str, pan: str) -> list[float]:
    from arosics import COREG

    found = COREG(
        pan, ms, max_shift=MAX_SHIFT_MS_PX, s_b4match=GREEN_BAND, calc_corners=False, q=True
    )
    found.calculate_spatial_shifts()
    if not found.success:
        raise SystemExit("AROSICS reports no success")
    _, _, _, x, y, dx, dy, *_ = found.coreg_info["updated map info"]
    return [float(dx), 0.0, float(x), 0.0, -float(dy), float(y)]


def _local(ms: str, pan: str) -> list[float]:
    from arosics import COREG_LOCAL

    found = COREG_LOCAL(
        pan, ms, grid_res=24, window_size=(64, 64), max_shift=MAX_SHIFT_MS_PX,
        s_b4match=GREEN_BAND, calc_corners=False, q=True, CPUs=2,
    )  # fmt: skip
    found.calculate_spatial_shifts()
    table = found.CoRegPoints_table
    table = table[(table["ABS_SHIFT"] != -9999) & (table["OUTLIER"] == False)]  # noqa: E712
    if len(table) < FEWEST_POINTS:
        raise SystemExit(f"{len(table)} tie points, too few for an affine")
    header = gdal.Open(ms).GetGeoTransform()
    place = table[["X_MAP", "Y_MAP"]].to_numpy(float)
    true = place + table[["X_SHIFT_M", "Y_SHIFT_M"]].to_numpy(float)
    pixel = (place - (header[0], header[3])) / (header[1], header[5])
    design = np.column_stack([pixel, np.ones(len(pixel))])
    return [float(v) for v in np.linalg.lstsq(design, true, rcond=None)[0].T.ravel()]


def main() -> None:
    """Write the corrected geotransform."""
    parser = argparse.ArgumentParser()
    for name in ("--ms", "--pan", "--out"):
        parser.add_argument(name, required=True)
    parser.add_argument("--setting", choices=("default", "best"), default="default")
    args = parser.parse_args()
    _extend_gdal()
    find = _global if args.setting == "default" else _local
    Path(args.out).write_text(json.dumps({"transform": find(args.ms, args.pan)}))


if __name__ == "__main__":
    main()
