"""pandora2d: a disparity map on the MS grid, and a robust affine through it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import rasterio
from common import arguments, fit_affine, pan_on_ms_grid, read_pair, save_grid_correction

SEARCH_PX = 4
ROUNDS = 5
START = "from pandora2d.Pandora2d import main; main()"


def _configuration(folder: Path, window: int) -> dict[str, object]:
    image = {"nodata": -9999}
    disparity = {"init": 0, "range": SEARCH_PX}
    return {
        "input": {
            "left": {**image, "img": str(folder / "left.tif")},
            "right": {**image, "img": str(folder / "right.tif")},
            "col_disparity": disparity,
            "row_disparity": disparity,
        },
        "pipeline": {
            "matching_cost": {
                "matching_cost_method": "zncc", "window_size": window,
                "subpix": 2, "spline_order": 3,
            },
            "disparity": {"disparity_method": "wta", "invalid_disparity": -9999},
            "refinement": {
                "refinement_method": "dichotomy", "iterations": 5,
                "filter": {"method": "bicubic"},
            },
        },
        "output": {"path": str(folder / "result")},
    }  # fmt: skip


def main() -> None:
    """Default window of 11 pixels, best of 21."""
    args = arguments("default", "best")
    pair = read_pair(args)
    folder = args.out.parent
    images = {"left": pair.ms_grey(args.setting), "right": pan_on_ms_grid(pair)}
    for name, image in images.items():
        with rasterio.open(
            folder / f"{name}.tif", "w", driver="GTiff", dtype="float32", count=1,
            height=image.shape[0], width=image.shape[1],
        ) as raster:  # fmt: skip
            raster.write(image, 1)
    configuration = folder / "pandora2d.json"
    configuration.write_text(
        json.dumps(_configuration(folder, 11 if args.setting == "default" else 21))
    )
    subprocess.run([sys.executable, "-c", START, str(configuration)], check=True)
    maps = []
    for axis in ("col", "row"):
        with rasterio.open(next((folder / "result").rglob(f"{axis}_map.tif"))) as raster:
            maps.append(raster.read(1).astype(float))
    column, row = maps
    good = np.isfinite(column) & np.isfinite(row) & (column > -9000) & (row > -9000)
    y, x = np.nonzero(good)
    source = np.stack([x, y], axis=1) + 0.5
    target = source + np.stack([column[good], row[good]], axis=1)
    kept = np.ones(len(source), dtype=bool)
    for _ in range(ROUNDS):
        matrix = fit_affine(source[kept], target[kept])
        distance = np.hypot(*(source @ matrix[:, :2].T + matrix[:, 2] - target).T)
        kept = distance < max(0.1, 2.5 * float(np.median(distance[kept])))
    save_grid_correction(args, pair, matrix)


if __name__ == "__main__":
    main()
