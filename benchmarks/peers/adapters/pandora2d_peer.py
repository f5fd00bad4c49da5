"""pandora2d: disparity maps on the MS grid, and a robust affine or a smooth field through them.

Expert: two passes, as its guide has it for large disparities.  The first, with a range that reaches
all shifts, on images of an eighth of the size; the second starts at its shift, with a range for
rotation and scale and a window of 21 pixels.  A third starts at the affine of the second.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from common import (
    FloatArray,
    Pair,
    arguments,
    check_points,
    on_band_mix,
    pan_as_ms,
    pan_on_ms_grid,
    read_pair,
    save_grid_correction,
    save_on_grid,
)
from rasterio.enums import Resampling
from rasterio.warp import reproject
from scattered import affine_without_outliers, smooth_field

INVALID = -9999
START = "from pandora2d.Pandora2d import main; main()"
DEFAULT_RANGE_PX, WIDE_RANGE_PX, NARROW_RANGE_PX = 4, 8, 2
COARSER = 8
WINDOW, WIDE_WINDOW = 11, 21
EVERY_PX = 8
"""Of a disparity map, where a field is laid through it: its windows overlap."""


class Pandora2d:
    """Runs the tool in a folder."""

    def __init__(self, folder: Path) -> None:
        """Files are written to `folder`."""
        self.folder, self.runs = folder, 0

    def points(
        self, left: np.ndarray, right: np.ndarray, window: int, reach: int, start: FloatArray
    ) -> list[FloatArray]:
        """Pixels of `left` and where they lie in `right`, both (N, 2).

        `start` is the (2, 3) affine about which is searched, by `reach` pixels.
        """
        self.runs += 1
        here = self.folder / f"run{self.runs}"
        here.mkdir()
        height, width = left.shape
        y, x = np.mgrid[:height, :width] + 0.5
        guess = np.tensordot(start, np.stack([x, y, np.ones_like(x)]), axes=1)
        first = [np.rint(guess[0] - x), np.rint(guess[1] - y)]
        for name, image in zip(("left", "right", "col", "row"), (left, right, *first), strict=True):
            self._write(here / f"{name}.tif", image)
        (here / "run.json").write_text(json.dumps(self._configuration(here, window, reach)))
        subprocess.run(
            [sys.executable, "-c", START, str(here / "run.json")],
            check=True, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        maps = []
        for axis in ("col", "row"):
            with rasterio.open(next((here / "result").rglob(f"{axis}_map.tif"))) as raster:
                maps.append(raster.read(1).astype(float))
        good = np.isfinite(maps).all(axis=0) & (np.array(maps) > INVALID + 1).all(axis=0)
        source = np.stack([x[good], y[good]], axis=1)
        return [source, source + np.stack([m[good] for m in maps], axis=1)]

    @staticmethod
    def _write(path: Path, image: np.ndarray) -> None:
        with rasterio.open(
            path, "w", driver="GTiff", dtype="float32", count=1, height=image.shape[0],
            width=image.shape[1],
        ) as raster:  # fmt: skip
            raster.write(image.astype(np.float32), 1)

    @staticmethod
    def _configuration(folder: Path, window: int, reach: int) -> dict[str, object]:
        def disparity(axis: str) -> dict[str, object]:
            return {"init": str(folder / f"{axis}.tif"), "range": reach}

        return {
            "input": {
                "left": {"nodata": INVALID, "img": str(folder / "left.tif")},
                "right": {"nodata": INVALID, "img": str(folder / "right.tif")},
                "col_disparity": disparity("col"),
                "row_disparity": disparity("row"),
            },
            "pipeline": {
                "matching_cost": {
                    "matching_cost_method": "zncc", "window_size": window,
                    "subpix": 2 if reach <= DEFAULT_RANGE_PX else 1, "spline_order": 3,
                },
                "disparity": {"disparity_method": "wta", "invalid_disparity": INVALID},
                "refinement": {
                    "refinement_method": "dichotomy", "iterations": 6,
                    "filter": {"method": "bicubic"},
                },
            },
            "output": {"path": str(folder / "result")},
        }  # fmt: skip


def _coarser(image: np.ndarray) -> np.ndarray:
    out = np.zeros([size // COARSER for size in image.shape], np.float32)
    reproject(
        image, out, src_transform=Affine.identity(), dst_transform=Affine.scale(COARSER),
        src_crs="EPSG:32631", dst_crs="EPSG:32631", resampling=Resampling.average,
    )  # fmt: skip
    return out


def _matched(tool: Pandora2d, pair: Pair) -> list[FloatArray]:
    """Points of the last pass, on the best mix of the bands."""
    pan = pan_as_ms(pair)
    found: list[list[FloatArray]] = []

    def find(grey: np.ndarray) -> FloatArray:
        if not found:
            small = [_coarser(image) for image in (grey, pan)]
            source, target = tool.points(*small, WINDOW, WIDE_RANGE_PX, np.eye(2, 3))
            start = np.eye(2, 3)
            start[:, 2] = COARSER * np.median(target - source, axis=0)
            found.append(tool.points(grey, pan, WIDE_WINDOW, WIDE_RANGE_PX, start))
        start = affine_without_outliers(*found[-1])
        found.append(tool.points(grey, pan, WIDE_WINDOW, NARROW_RANGE_PX, start))
        return affine_without_outliers(*found[-1])

    on_band_mix(pair, find)
    return found[-1]


def _thinned(points: list[FloatArray]) -> list[FloatArray]:
    chosen = (np.floor(points[0]) % EVERY_PX == 0).all(axis=1)
    return [place[chosen] for place in points]


def main() -> None:
    """Default: a window of 11 pixels, a range of 4.  Expert and local: see above."""
    args = arguments("default", "expert", "local")
    pair = read_pair(args)
    tool = Pandora2d(args.out.parent)
    if args.setting == "default":
        images = pair.ms_grey(args.setting), pan_on_ms_grid(pair)
        points = tool.points(*images, WINDOW, DEFAULT_RANGE_PX, np.eye(2, 3))
    else:
        points = _matched(tool, pair)
    if args.setting == "local":
        at = check_points(pair.ms.shape[1:])
        save_on_grid(args, pair, smooth_field(*_thinned(points), at))
        return
    save_grid_correction(args, pair, affine_without_outliers(*points))


if __name__ == "__main__":
    main()
