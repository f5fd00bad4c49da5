"""Upsampled phase correlation (scikit-image): one shift for the whole image."""

from __future__ import annotations

import numpy as np
from common import arguments, ms_zoomed, pan_on_ms_grid, read_pair, save_grid_correction
from skimage.registration import phase_cross_correlation


def main() -> None:
    """Default: on the MS grid.  Best: MS magnified to PAN, correlated without whitening.

    Magnified MS has nothing but noise above its own Nyquist frequency, which whitening lets win.
    """
    args = arguments("default", "best")
    pair = read_pair(args)
    zoom = 1 if args.setting == "default" else max(1, round(pair.ratio))
    shift, *_ = phase_cross_correlation(
        pan_on_ms_grid(pair, zoom),
        ms_zoomed(pair, args.setting, zoom),
        upsample_factor=100,
        normalization="phase" if args.setting == "default" else None,
    )
    matrix = np.eye(2, 3)
    matrix[:, 2] = shift[1] / zoom, shift[0] / zoom
    save_grid_correction(args, pair, matrix)


if __name__ == "__main__":
    main()
