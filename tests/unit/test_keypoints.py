"""SIFT keypoints: positions, masks, spread, determinism."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from geodelreg.coarse.keypoints import KeypointOptions, detect
from geodelreg.values.points import Keypoints


def texture(height: int, width: int, seed: int = 0, contrast: float = 40.0) -> NDArray[np.uint8]:
    """Smooth random texture with structure at several scales."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width))
    for sigma in (1.5, 3.0, 6.0):
        layer = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), sigma)
        image += layer / layer.std()
    return np.clip(128 + contrast * image / image.std(), 0, 255).astype(np.uint8)


def blobs(centres: NDArray[np.float64], shape: tuple[int, int], sigma: float) -> NDArray[np.uint8]:
    """Gaussian blobs around outer-corner positions, pixel values sampled at pixel centres."""
    row, column = np.mgrid[: shape[0], : shape[1]] + 0.5
    image = np.full(shape, 20.0)
    for x, y in centres:
        image += 200 * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.fixture
def opencv_threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


def as_opencv(image: NDArray[np.uint8], found: Keypoints) -> list[list[cv2.KeyPoint]]:
    """OpenCV's own keypoints at each place that was found."""
    sift = cv2.SIFT.create(contrastThreshold=0.01, enable_precise_upscale=True)
    points = list(sift.detect(image, None))
    near = KDTree(np.array([point.pt for point in points]) + 0.5).query_ball_point(found.xy, 1e-4)
    return [[points[i] for i in some] for some in near]


def everywhere(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return np.ones(image.shape, dtype=np.bool_)


@pytest.mark.parametrize("sigma", [3.0, 5.0])
def test_positions_of_blobs_are_unbiased_outer_corner(sigma: float) -> None:
    steps = np.arange(6)
    column, row = np.meshgrid(40.5 + 60 * steps, 40.5 + 60 * steps)
    phases = np.arange(36) / 9  # 4 px: one period of the grid of the coarsest octave they are in
    centres = np.stack([column.ravel(), row.ravel()], 1) + phases[:, None]
    image = blobs(centres, (400, 400), sigma)
    found = detect(image, everywhere(image)).xy
    gap = found[:, None, :] - centres[None, :, :]
    nearest = np.abs(gap).sum(2).argmin(0)
    offsets = found[nearest] - centres
    assert np.abs(offsets).max() < 0.1
    assert np.abs(offsets.mean(0)).max() <= 0.01


def test_opencv_without_precise_upscaling_would_be_biased() -> None:
    """The trap itself: if this stops failing in OpenCV, the option is no longer needed."""
    centres = np.array([[100.5, 100.5], [200.5, 150.5], [150.5, 250.5]])
    image = blobs(centres, (300, 300), 4.0)
    biased = np.array([k.pt for k in cv2.SIFT.create().detect(image, None)]) + 0.5
    offsets = np.array([biased[np.abs(biased - c).sum(1).argmin()] - c for c in centres])
    assert np.abs(offsets.mean(0)).min() > 0.2


def test_no_keypoints_beside_invalid_pixels() -> None:
    image = texture(300, 300)
    valid = everywhere(image)
    valid[100:200, 100:200] = False
    found = detect(image, valid)
    assert len(found) > 50
    outside = np.maximum(np.abs(found.xy - 150).max(1) - 50, 0)
    size = [min(point.size for point in places) for places in as_opencv(image, found)]
    assert (outside > np.array(size)).all()
    assert len(found) < len(detect(image, everywhere(image)))


def test_cap_keeps_keypoints_in_every_part() -> None:
    image = texture(400, 400)
    image[:, 200:] = 128 + (image[:, 200:].astype(np.int16) - 128) // 4
    found = detect(image, everywhere(image), KeypointOptions(max_keypoints=200))
    assert len(found) == 200
    assert 20 <= (found.xy[:, 0] > 200).sum() <= 100


def test_leading_part_is_the_strongest_of_each_cell() -> None:
    image = texture(400, 400)
    found = detect(image, everywhere(image), KeypointOptions(max_keypoints=400, per_cell=4))
    first = found.xy[:80] // 40
    assert len(np.unique(first, axis=0)) >= 60


def test_low_contrast_scene_still_gets_keypoints() -> None:
    image = texture(300, 300, contrast=3.0)
    strict = KeypointOptions(low_contrast=0.04)
    assert len(detect(image, everywhere(image))) > 5 * max(
        1, len(detect(image, everywhere(image), strict))
    )


def test_strong_keypoints_come_before_weak_ones() -> None:
    image = texture(300, 300)
    options = KeypointOptions(max_keypoints=150)
    found = detect(image, everywhere(image), options)
    for places in as_opencv(image, found)[:100]:
        assert max(point.response for point in places) * 3 >= options.contrast


@pytest.mark.usefixtures("opencv_threads")
def test_same_result_for_any_thread_count() -> None:
    image = texture(500, 500, seed=3)
    results: list[Keypoints] = []
    for threads in (1, 2, 4):
        cv2.setNumThreads(threads)
        results.append(detect(image, everywhere(image), KeypointOptions(max_keypoints=700)))
    for other in results[1:]:
        for name in ("xy", "descriptors"):
            assert getattr(other, name).tobytes() == getattr(results[0], name).tobytes()


@pytest.mark.parametrize("root", [False, True])
def test_descriptors_are_integers_of_constant_norm(root: bool) -> None:
    image = texture(300, 300)
    descriptors = detect(image, everywhere(image), KeypointOptions(root=root)).descriptors
    assert descriptors.dtype == np.float32
    assert descriptors.shape[1] == 128
    assert (descriptors == np.rint(descriptors)).all()
    norm = np.linalg.norm(descriptors, axis=1)
    assert np.abs(norm / 512 - 1).max() < 0.05


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (3, 3), (40, 40)])
def test_featureless_image_gives_none(shape: tuple[int, int]) -> None:
    image = np.full(shape, 7, dtype=np.uint8)
    found = detect(image, everywhere(image))
    assert len(found) == 0
    assert found.descriptors.shape == (0, 128)
    assert found.xy.shape == (0, 2)


def test_large_images_are_looked_at_in_parts_and_lose_nothing() -> None:
    image = texture(900, 1150, seed=8)
    parts = detect(image, everywhere(image), KeypointOptions(max_keypoints=4000))
    at_once = KeypointOptions(max_keypoints=4000, whole_px=image.size)
    whole = detect(image, everywhere(image), at_once)
    assert len(parts) == len(whole) == 4000
    near, which = KDTree(whole.xy).query(parts.xy, k=4)  # one place may have several orientations
    same = near[:, 0] < 0.02
    assert same.mean() > 0.98
    apart = np.abs(whole.descriptors[which][same] - parts.descriptors[same][:, None])
    assert np.median(apart.max(axis=2).min(axis=1)) == 0
