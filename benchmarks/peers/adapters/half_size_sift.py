"""The dozen lines that one writes first: SIFT on PAN at half its size, RANSAC, a new header.

It stands for the time that a quick script takes.  PAN is averaged to half its size, MS is the mean
of its bands, and a copy of MS gets the new transform, as geodelreg's output does.  Nothing is
loaded that such a script does without.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import rasterio

KEYPOINTS, RATIO, RANSAC_PX = 4000, 0.8, 2.0


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Stretch between the 1st and the 99th percentile."""
    low, high = np.percentile(image, [1, 99])
    return np.clip((image - low) / (high - low) * 255, 0, 255).astype(np.uint8)


def main() -> None:
    """Match, fit, write the copy and, for the benchmark, the geotransform."""
    parser = argparse.ArgumentParser()
    for name in ("--ms", "--pan", "--out"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument("--setting", choices=("default",), default="default")
    args = parser.parse_args()
    cv2.setRNGSeed(0)
    with rasterio.open(args.ms) as ms, rasterio.open(args.pan) as pan:
        source = ms.read().mean(axis=0)
        rows, columns = pan.height // 2, pan.width // 2
        half = cv2.resize(
            pan.read(1).astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA
        )
        to_map = pan.transform @ rasterio.Affine.scale(pan.width / columns, pan.height / rows)
        same = ms.crs == pan.crs
        crs, ms_crs, shape = pan.crs, ms.crs, ms.shape
    sift = cv2.SIFT.create(nfeatures=KEYPOINTS)
    points_a, descriptors_a = sift.detectAndCompute(to_uint8(source), None)
    points_b, descriptors_b = sift.detectAndCompute(to_uint8(half), None)
    pairs = cv2.BFMatcher().knnMatch(descriptors_a, descriptors_b, k=2)
    good = [first for first, second in pairs if first.distance < RATIO * second.distance]
    a = np.array([points_a[m.queryIdx].pt for m in good]) + 0.5
    b = np.array([points_b[m.trainIdx].pt for m in good]) + 0.5
    matrix, _ = cv2.estimateAffine2D(a, b, method=cv2.RANSAC, ransacReprojThreshold=RANSAC_PX)
    transform = to_map @ rasterio.Affine(*matrix.ravel())
    copy = args.out.with_suffix(".tif")
    shutil.copy(args.ms, copy)
    with rasterio.open(copy, "r+") as out:
        out.transform, out.crs = transform, crs
    if not same:  # only the benchmark asks for the header's CRS
        from common import FloatArray, apply_transform, fit_affine
        from pyproj import Transformer

        corners: FloatArray = np.array(
            [(x, y) for x in (0, shape[1]) for y in (0, shape[0])], float
        )
        there = Transformer.from_crs(crs, ms_crs, always_xy=True)
        mapped = there.transform(*apply_transform(transform, corners))
        transform = rasterio.Affine(*fit_affine(corners, np.stack(mapped, axis=1)).ravel())
    args.out.write_text(json.dumps({"transform": [float(v) for v in tuple(transform)[:6]]}))


if __name__ == "__main__":
    main()
