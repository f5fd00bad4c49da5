"""Upsampled phase correlation (scikit-image): one shift for the whole image."""

from __future__ import annotations

import numpy as np
from common import (
    FloatArray,
    arguments,
    ms_zoomed,
    on_band_mix,
    pan_as_ms,
    pan_on_ms_grid,
    read_pair,
    save_grid_correction,
)
from skimage.registration import phase_cross_correlation


def main() -> None:
    """Default: on the MS grid.  Expert: MS magnified to PAN, correlated without whitening.

    Magnified MS has nothing but noise above its own Nyquist frequency, which whitening lets win.
    """
    args = arguments("default", "expert")
    pair = read_pair(args)
    expert = args.setting == "expert"
    zoom = max(1, round(pair.ratio)) if expert else 1
    pan = pan_as_ms(pair, zoom) if expert else pan_on_ms_grid(pair)

    def find(grey: np.ndarray) -> FloatArray:
        shift, *_ = phase_cross_correlation(
            pan, ms_zoomed(pair, grey, zoom), upsample_factor=100,
            normalization=None if expert else "phase",
        )  # fmt: skip
        matrix = np.eye(2, 3)
        matrix[:, 2] = shift[1] / zoom, shift[0] / zoom
        return matrix

    matrix = on_band_mix(pair, find) if expert else find(pair.ms_grey(args.setting))
    save_grid_correction(args, pair, matrix)


if __name__ == "__main__":
    main()
