"""SIFT, ratio test and RANSAC as one writes them by hand with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from common import (
    FloatArray,
    arguments,
    fit_affine,
    read_pair,
    save_pixel_match,
    to_uint8,
)

RATIO = 0.75


def _match(
    sift: cv2.SIFT, source: np.ndarray, reference: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Matched positions (N, 2), outer-corner pixels of the two images."""
    points_a, descriptors_a = sift.detectAndCompute(source, None)
    points_b, descriptors_b = sift.detectAndCompute(reference, None)
    index = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 64})
    pairs = index.knnMatch(descriptors_a, descriptors_b, k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < RATIO * p[1].distance]
    a = np.array([points_a[m.queryIdx].pt for m in good]) + 0.5
    b = np.array([points_b[m.trainIdx].pt for m in good]) + 0.5
    return a, b


def main() -> None:
    """Default: MS magnified to PAN, RANSAC.  Expert: both at the MS GSD, no SIFT bias, MAGSAC."""
    args = arguments("default", "expert")
    cv2.setRNGSeed(0)
    pair = read_pair(args)
    height, width = pair.ms.shape[1:]
    if args.setting == "default":
        size = (round(width * pair.ratio), round(height * pair.ratio))
        source = cv2.resize(
            to_uint8(pair.ms_grey(args.setting)), size, interpolation=cv2.INTER_CUBIC
        )
        a, b = _match(cv2.SIFT.create(), source, to_uint8(pair.pan))
        a *= (width / size[0], height / size[1])
        _, inlier = cv2.estimateAffine2D(a * pair.ratio, b, method=cv2.RANSAC)
    else:
        rows, columns = pair.pan.shape
        size = (round(columns / pair.ratio), round(rows / pair.ratio))
        reference = cv2.resize(pair.pan, size, interpolation=cv2.INTER_AREA)
        sift = cv2.SIFT.create(nfeatures=20000, enable_precise_upscale=True)
        a, b = _match(sift, to_uint8(pair.ms_grey(args.setting)), to_uint8(reference))
        _, inlier = cv2.estimateAffine2D(
            a, b, method=cv2.USAC_MAGSAC, ransacReprojThreshold=1.0, maxIters=20000,
            confidence=0.9999,
        )  # fmt: skip
        b *= (columns / size[0], rows / size[1])
    kept = inlier.ravel() > 0
    save_pixel_match(args, pair, fit_affine(a[kept], b[kept]))


if __name__ == "__main__":
    main()
