"""Maximisation of the enhanced correlation coefficient (OpenCV's findTransformECC)."""

from __future__ import annotations

import cv2
import numpy as np
from common import arguments, ms_zoomed, pan_on_ms_grid, read_pair, save_grid_correction


def main() -> None:
    """Default: on the MS grid, from the header.  Best: from phase correlation, then at PAN size."""
    args = arguments("default", "best")
    pair = read_pair(args)
    reference = pan_on_ms_grid(pair)
    warp = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    if args.setting == "default":
        criteria = (criteria[0], 200, 1e-6)
    else:
        (dx, dy), _ = cv2.phaseCorrelate(
            np.float64(pair.ms_grey(args.setting)), np.float64(reference)
        )
        warp[:, 2] = dx, dy
        criteria = (criteria[0], 500, 1e-8)
    # The warp maps pixel centres of the template (MS) to those of the input (PAN on its grid).
    _, warp = cv2.findTransformECC(
        pair.ms_grey(args.setting), reference, warp, cv2.MOTION_AFFINE, criteria, None, 5
    )
    zoom = 1
    if args.setting == "best":
        zoom = max(1, round(pair.ratio))
        warp = _zoomed(warp, zoom)
        _, warp = cv2.findTransformECC(
            ms_zoomed(pair, args.setting, zoom),
            pan_on_ms_grid(pair, zoom),
            warp,
            cv2.MOTION_AFFINE,
            (criteria[0], 200, 1e-8),
            None,
            5,
        )
    matrix = warp.astype(np.float64)
    matrix[:, 2] += 0.5 - matrix[:, :2] @ (0.5, 0.5)
    matrix[:, 2] /= zoom
    save_grid_correction(args, pair, matrix)


def _zoomed(warp: np.ndarray, zoom: int) -> np.ndarray:
    """The same warp between pixel centres of grids `zoom` times finer."""
    corner = warp.astype(np.float64)
    corner[:, 2] += 0.5 - corner[:, :2] @ (0.5, 0.5)
    corner[:, 2] *= zoom
    corner[:, 2] -= 0.5 - corner[:, :2] @ (0.5, 0.5)
    return corner.astype(np.float32)


if __name__ == "__main__":
    main()
