"""Dense optical flow (OpenCV's DIS) at PAN size, smoothed as flow of rigid ground may be."""

from __future__ import annotations

import cv2
import numpy as np
from common import (
    FloatArray,
    arguments,
    band_mix,
    check_points,
    ms_zoomed,
    pan_as_ms,
    read_pair,
    sampled,
    save_on_grid,
    to_uint8,
)

SMOOTH_MS_PX = 8.0


def main() -> None:
    """The preset for quality, down to the finest scale, on a band mix."""
    args = arguments("local")
    pair = read_pair(args)
    zoom = max(1, round(pair.ratio))
    pan = to_uint8(pan_as_ms(pair, zoom))
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)

    def flow(grey: np.ndarray) -> FloatArray:
        raw = dis.calc(to_uint8(ms_zoomed(pair, grey, zoom)), pan, None)
        return cv2.GaussianBlur(raw, (0, 0), SMOOTH_MS_PX * zoom).astype(float) / zoom

    at = check_points(pair.ms.shape[1:])
    first = np.eye(2, 3)
    first[:, 2] = np.median(flow(pair.ms_grey("expert")), axis=(0, 1))
    save_on_grid(args, pair, at + sampled(flow(band_mix(pair, first)), at, zoom))


if __name__ == "__main__":
    main()
