"""What an expert writes with OpenCV: SIFT at the MS resolution and MAGSAC, then ECC on a band mix.

Settings that did best on the scenes of the project: descriptors compared with ratio 0.8, MAGSAC at
one MS pixel, weights of the bands by least squares against PAN, PAN low-passed at 0.45 MS pixels
(the blur of a pixel and its optics), twice, for better weights need a better place.
"""

from __future__ import annotations

import cv2
import numpy as np
from common import PIXEL_SIGMA, FloatArray, arguments, read_pair, save_pixel_match, to_uint8

KEYPOINTS, RATIO, MAGSAC_PX = 8000, 0.8, 1.0
TURNS = 2
CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-8)


def first_guess(grey: np.ndarray, pan: np.ndarray, ratio: float) -> FloatArray:
    """(2, 3) affine from MS pixel centres to those of PAN."""
    size = [max(1, round(n / ratio)) for n in pan.shape[::-1]]
    coarse = cv2.resize(pan, size, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(nfeatures=KEYPOINTS, enable_precise_upscale=True)
    (mine, mine_like), (theirs, theirs_like) = (
        sift.detectAndCompute(to_uint8(image), None) for image in (grey, coarse)
    )
    pairs = cv2.BFMatcher().knnMatch(mine_like, theirs_like, k=2)
    good = [first for first, second in pairs if first.distance < RATIO * second.distance]
    a = np.array([mine[m.queryIdx].pt for m in good])
    scale = np.array(pan.shape[::-1]) / size
    b = (np.array([theirs[m.trainIdx].pt for m in good]) + 0.5) * scale - 0.5
    matrix, _ = cv2.estimateAffine2D(
        a, b, method=cv2.USAC_MAGSAC, ransacReprojThreshold=MAGSAC_PX * ratio, maxIters=10_000
    )
    return np.asarray(matrix, dtype=np.float64)


def band_mix(ms: np.ndarray, pan: np.ndarray, matrix: FloatArray) -> np.ndarray:
    """The bands weighted as PAN sees them, by least squares where both are known."""
    height, width = ms.shape[1:]
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpAffine(pan, matrix, (width, height), flags=how, borderValue=np.nan)
    known = np.isfinite(seen)
    design = np.column_stack([*ms[:, known], np.ones(int(known.sum()))])
    weights = np.linalg.lstsq(design, seen[known], rcond=None)[0]
    return np.asarray(np.tensordot(weights[:-1], ms, axes=1), dtype=np.float32)


def main() -> None:
    """Find the affine and save the geotransform."""
    args = arguments("expert")
    pair = read_pair(args)
    cv2.setRNGSeed(0)
    sigma = PIXEL_SIGMA * pair.ratio
    pan = cv2.GaussianBlur(pair.pan, (0, 0), sigma)
    matrix = first_guess(pair.ms.mean(axis=0), pair.pan, pair.ratio)
    for _ in range(TURNS):
        mix = band_mix(pair.ms, pan, matrix)
        _, found = cv2.findTransformECC(
            mix, pan, matrix.astype(np.float32), cv2.MOTION_AFFINE, CRITERIA, None, 1
        )
        matrix = found.astype(np.float64)
    matrix[:, 2] += 0.5 - matrix[:, :2] @ (0.5, 0.5)
    save_pixel_match(args, pair, matrix)


if __name__ == "__main__":
    main()
