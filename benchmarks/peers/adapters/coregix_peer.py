"""coregix: it resamples, so bands that hold their own column and row reveal what it did."""

from __future__ import annotations

import numpy as np
import rasterio
from common import arguments, fit_affine, read_pair, save_grid_correction
from coregix import align_image_pair

EDGE_PX = 12
OUTSIDE = -1000.0


def main() -> None:
    """Default: as it comes.  Expert: from coarse to fine, for large offsets."""
    args = arguments("default", "expert")
    pair = read_pair(args)
    height, width = pair.ms.shape[1:]
    row, column = np.mgrid[:height, :width] + 0.5
    moving, aligned = args.out.parent / "moving.tif", args.out.parent / "aligned.tif"
    with rasterio.open(
        moving, "w", driver="GTiff", dtype="float32", count=3, height=height, width=width,
        crs=pair.ms_crs, transform=pair.ms_transform, nodata=OUTSIDE,
    ) as raster:  # fmt: skip
        raster.write(np.stack([pair.ms_grey(args.setting), column, row]).astype(np.float32))
    steps = {}
    if args.setting == "expert":
        size = abs(pair.pan_transform.a)
        steps = {"solve_resolutions": [16 * size, 4 * size, size], "split_factor": 1}
    align_image_pair(str(moving), str(args.pan), str(aligned), **steps)
    with rasterio.open(aligned) as raster:
        _, from_column, from_row = raster.read().astype(np.float64)
        if raster.shape != (height, width) or raster.transform != pair.ms_transform:
            raise SystemExit("the result is on another grid")
    inside = (from_column > EDGE_PX) & (from_column < width - EDGE_PX)
    inside &= (from_row > EDGE_PX) & (from_row < height - EDGE_PX)
    source = np.stack([from_column[inside], from_row[inside]], axis=1)
    target = np.stack([column[inside], row[inside]], axis=1)
    save_grid_correction(args, pair, fit_affine(source, target))


if __name__ == "__main__":
    main()
