"""Maximisation of the enhanced correlation coefficient (OpenCV's findTransformECC) by itself.

Its expert setting starts at phase correlation; `opencv_expert.py` starts it at keypoints.
"""

from __future__ import annotations

import cv2
import numpy as np
from common import (
    FloatArray,
    Pair,
    arguments,
    ms_zoomed,
    on_band_mix,
    pan_as_ms,
    pan_on_ms_grid,
    read_pair,
    save_grid_correction,
)

STOP = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT
BLUR_PX = 5
ITERATIONS, FINE_ITERATIONS = 500, 200


def _corners(warp: np.ndarray, zoom: int) -> FloatArray:
    """(2, 3) between outer corners in MS pixels, of a warp between pixel centres."""
    matrix = warp.astype(np.float64)
    matrix[:, 2] += 0.5 - matrix[:, :2] @ (0.5, 0.5)
    matrix[:, 2] /= zoom
    return matrix


def _centres(matrix: FloatArray, zoom: int) -> np.ndarray:
    """The inverse of `_corners`."""
    warp = matrix.copy()
    warp[:, 2] *= zoom
    warp[:, 2] -= 0.5 - warp[:, :2] @ (0.5, 0.5)
    return warp.astype(np.float32)


def _found(
    pair: Pair, grey: np.ndarray, coarse: np.ndarray, fine: np.ndarray, zoom: int
) -> FloatArray:
    (dx, dy), _ = cv2.phaseCorrelate(np.float64(grey), np.float64(coarse))
    warp = np.eye(2, 3, dtype=np.float32)
    warp[:, 2] = dx, dy
    criteria = (STOP, ITERATIONS, 1e-8)
    _, warp = cv2.findTransformECC(grey, coarse, warp, cv2.MOTION_AFFINE, criteria, None, BLUR_PX)
    warp = _centres(_corners(warp, 1), zoom)
    _, warp = cv2.findTransformECC(
        ms_zoomed(pair, grey, zoom), fine, warp, cv2.MOTION_AFFINE,
        (STOP, FINE_ITERATIONS, 1e-8), None, BLUR_PX,
    )  # fmt: skip
    return _corners(warp, zoom)


def main() -> None:
    """Default: on the MS grid, from the header.  Expert: from phase correlation, at PAN size."""
    args = arguments("default", "expert")
    pair = read_pair(args)
    if args.setting == "default":
        # The warp maps pixel centres of the template (MS) to those of the input (PAN on its grid).
        _, warp = cv2.findTransformECC(
            pair.ms_grey(args.setting), pan_on_ms_grid(pair), np.eye(2, 3, dtype=np.float32),
            cv2.MOTION_AFFINE, (STOP, FINE_ITERATIONS, 1e-6), None, BLUR_PX,
        )  # fmt: skip
        save_grid_correction(args, pair, _corners(warp, 1))
        return
    zoom = max(1, round(pair.ratio))
    coarse, fine = pan_as_ms(pair), pan_as_ms(pair, zoom)
    matrix = on_band_mix(pair, lambda grey: _found(pair, grey, coarse, fine, zoom))
    save_grid_correction(args, pair, matrix)


if __name__ == "__main__":
    main()
