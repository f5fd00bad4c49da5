"""Orfeo ToolBox's HomologousPointsExtraction (SIFT in bins) and an affine through its points."""

from __future__ import annotations

import subprocess

import cv2
import numpy as np
from common import apply_transform, arguments, fit_affine, read_pair, save_pixel_match

RED_BAND = 3
SETTINGS = {
    "default": ("-mode.geobins.binsize", "256", "-mode.geobins.binstep", "256"),
    "expert": (
        "-mode.geobins.binsize", "128", "-mode.geobins.binstep", "64", "-threshold", "0.8",
        "-backmatching", "true",
    ),
}  # fmt: skip


def main() -> None:
    """Default bins, or small overlapping ones; MAGSAC and least squares on what comes out."""
    args = arguments("default", "expert")
    points = args.out.with_suffix(".txt")
    subprocess.run(
        [
            "otbcli_HomologousPointsExtraction", "-in1", str(args.ms), "-band1", str(RED_BAND),
            "-in2", str(args.pan), "-algorithm", "sift", "-mode", "geobins", "-precision", "40",
            *SETTINGS[args.setting], "-out", str(points),
        ],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    pair = read_pair(args)
    rows = np.loadtxt(points, ndmin=2)
    source = np.stack(apply_transform(~pair.ms_transform, rows[:, :2]), axis=1)
    target = np.stack(apply_transform(~pair.pan_transform, rows[:, 2:4]), axis=1)
    _, inlier = cv2.estimateAffine2D(
        source, target, method=cv2.USAC_MAGSAC, ransacReprojThreshold=2.0, maxIters=20000
    )
    kept = inlier.ravel() > 0
    save_pixel_match(args, pair, fit_affine(source[kept], target[kept]))


if __name__ == "__main__":
    main()
