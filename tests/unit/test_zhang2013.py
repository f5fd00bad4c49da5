"""The paper's steps, one by one and together."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from geodelreg.coarse.keypoints import detect
from geodelreg.geo.triangulation import incircle_sine, interior_edges, relative_altitude
from geodelreg.paper.zhang2013 import (
    AS_PRINTED,
    Pairs,
    ZhangOptions,
    initial_status,
    lowe_options,
    match_sift,
    match_zhang2013,
    reject_ambiguous,
    reject_cocircular,
    reject_collinear,
    reject_duplicates,
    reject_unshared,
    triangulate_kept,
)
from geodelreg.values.points import Keypoints, Status
from geodelreg.values.raster import FloatArray

TRUTH = np.array([[0.97, -0.12, 40.0], [0.11, 1.02, -25.0]])


def homologous(count: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    source = rng.uniform(0, 1000, (count, 2))
    reference = source @ TRUTH[:, :2].T + TRUTH[:, 2] + 0.3 * rng.standard_normal((count, 2))
    return source, reference, rng.uniform(0.4, 0.8, count)


def test_ratio_step_rejects_at_the_limit_and_above() -> None:
    source, reference, _ = homologous(4, 1)
    ratio = np.array([0.5, 0.79, 0.8, 0.95])
    status = reject_ambiguous(Pairs(source, reference, ratio), initial_status(ratio), 0.8)
    assert status.tolist() == [Status.KEPT, Status.KEPT, Status.RATIO, Status.RATIO]


def test_duplicates_step_leaves_one_to_one_matches_and_looks_at_kept_ones_only() -> None:
    source = np.array([[1.0, 1], [1, 1], [5, 5], [9, 9], [9, 9]])
    reference = np.array([[2.0, 2], [2, 2], [6, 6], [6, 6], [7, 7]])
    ratio = np.array([0.6, 0.5, 0.4, 0.3, 0.7])
    status = initial_status(ratio)
    status[3] = Status.RATIO
    after = reject_duplicates(Pairs(source, reference, ratio), status)
    assert after.tolist() == [Status.DUPLICATE, Status.KEPT, Status.KEPT, Status.RATIO, 0]


@pytest.mark.parametrize("in_source", [True, False])
def test_collinear_step_drops_the_worst_ratio_of_a_flat_triangle(in_source: bool) -> None:
    flat = np.array([[0.0, 0], [50, 0.5], [100, 0], [50, 80]])
    round_ = np.array([[0.0, 0], [50, 30], [100, 0], [50, 80]])
    ratio = np.array([0.5, 0.4, 0.7, 0.75])
    source, reference = (flat, round_) if in_source else (round_, flat)
    status = reject_collinear(Pairs(source, reference, ratio), initial_status(ratio), 0.02)
    assert status.tolist() == [0, 0, Status.COLLINEAR, 0]


def test_cocircular_step_drops_the_worst_ratio_of_a_square() -> None:
    square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    ratio = np.array([0.5, 0.7, 0.6, 0.4])
    status = reject_cocircular(Pairs(square, square, ratio), initial_status(ratio), 0.01)
    assert status.tolist() == [0, Status.COCIRCULAR, 0, 0]


def test_degeneracy_steps_leave_no_group_whole() -> None:
    lattice = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), -1).reshape(-1, 2)
    ratio = np.random.default_rng(2).uniform(0.3, 0.8, len(lattice))
    status = initial_status(ratio)
    before = interior_edges(triangulate_kept(lattice, status))
    quads = np.concatenate([before.ends, before.opposite], axis=1)
    degenerate = incircle_sine(lattice, before) < 0.01
    assert degenerate.sum() > 100
    after = reject_cocircular(Pairs(lattice, lattice, ratio), status, 0.01)
    assert (after[quads[degenerate]] != Status.KEPT).any(axis=1).all()


def test_tolerances_are_free_of_scale() -> None:
    source, reference, ratio = homologous(300, 3)
    for step, limit in ((reject_collinear, 0.03), (reject_cocircular, 0.03)):
        first = step(Pairs(source, reference, ratio), initial_status(ratio), limit)
        scaled = step(Pairs(1000 * source, 1000 * reference, ratio), initial_status(ratio), limit)
        assert (first != Status.KEPT).any()
        assert (first == scaled).all()


def test_kept_triangulation_ignores_rejected_points() -> None:
    source, _, ratio = homologous(50, 4)
    status = initial_status(ratio)
    status[::2] = Status.RATIO
    triangles = triangulate_kept(source, status)
    assert (triangles % 2 == 1).all()
    assert (relative_altitude(source, triangles) > 0).all()


def test_correspondence_step_rejects_displaced_points_and_keeps_homologous_ones() -> None:
    source, reference, ratio = homologous(200, 5)
    wrong = np.arange(200) % 10 == 0
    reference[wrong] = np.random.default_rng(6).uniform(0, 1000, (20, 2))
    status = reject_unshared(Pairs(source, reference, ratio), initial_status(ratio), 0.2)
    assert (status[wrong] == Status.TOPOLOGY).sum() >= 17
    assert (status[~wrong] == Status.KEPT).mean() > 0.95


def test_correspondence_step_does_not_mind_translation_rotation_or_scale() -> None:
    source, _, ratio = homologous(200, 7)
    c, s = math.cos(2.0), math.sin(2.0)
    reference = 1.7 * source @ np.array([[c, s], [-s, c]]) + 300
    assert (reject_unshared(Pairs(source, reference, ratio), initial_status(ratio), 1.0) == 0).all()


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_points_pass_through_every_step(count: int) -> None:
    source, reference, ratio = homologous(count, 8)
    status = reject_duplicates(Pairs(source, reference, ratio), initial_status(ratio))
    for step in (reject_collinear, reject_cocircular, reject_unshared):
        status = step(Pairs(source, reference, ratio), status, 0.01)
    assert status.tolist() == [0] * count


@pytest.fixture(scope="module")
def scene_keypoints() -> tuple[Keypoints, Keypoints]:
    """Keypoints of a textured image and of its copy under TRUTH, with other noise."""
    rng = np.random.default_rng(9)
    source = sum(
        w * cv2.GaussianBlur(rng.standard_normal((600, 600)), (0, 0), w) for w in (2.0, 4.0, 8.0)
    )
    assert isinstance(source, np.ndarray)
    source = 128 + 35 * source / source.std()
    matrix = TRUTH.copy()
    matrix[:, 2] += TRUTH[:, :2] @ [0.5, 0.5] - 0.5  # OpenCV warps between pixel centres
    reference = cv2.warpAffine(source, matrix, (600, 600), flags=cv2.INTER_LINEAR)
    keypoints = []
    for image in (source, reference):
        noisy = np.clip(image + 4 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)
        keypoints.append(detect(noisy, np.ones(noisy.shape, np.bool_), lowe_options(1500)))
    return keypoints[0], keypoints[1]


@pytest.mark.parametrize("shape", [(300, 300), (150, 600)])
def test_of_too_many_keypoints_the_strongest_stay_wherever_they_are(
    shape: tuple[int, int],
) -> None:
    """OpenCV's own selection, on an image whose right half has most of the contrast."""
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 2.0)
    image[:, : shape[1] // 2] *= 0.6
    grey = np.clip(128 + 40 * image / image.std(), 0, 255).astype(np.uint8)
    sift = cv2.SIFT.create(nfeatures=100, contrastThreshold=0.09, enable_precise_upscale=True)
    strongest = sorted(sift.detect(grey, None), key=lambda point: -point.response)[:100]
    found = detect(grey, np.ones(shape, np.bool_), lowe_options(100))
    assert len(found) == 100
    assert np.allclose(
        sorted(found.xy.tolist()), sorted((np.array([p.pt for p in strongest]) + 0.5).tolist())
    )


def test_whole_method_on_images(scene_keypoints: tuple[Keypoints, Keypoints]) -> None:
    tie_points, counts = match_zhang2013(*scene_keypoints)
    assert list(counts) == [
        "nearest", "ratio", "one_to_one", "not_collinear", "not_cocircular", "final_ratio",
        "corresponding",
    ]  # fmt: skip
    values = list(counts.values())
    assert values == sorted(values, reverse=True)
    assert values[0] == len(tie_points)
    assert values[-1] == tie_points.kept.sum() > 50
    for status, before, after in (
        (Status.DUPLICATE, "ratio", "one_to_one"),
        (Status.COLLINEAR, "one_to_one", "not_collinear"),
        (Status.COCIRCULAR, "not_collinear", "not_cocircular"),
        (Status.TOPOLOGY, "final_ratio", "corresponding"),
    ):
        assert (tie_points.status == status).sum() == counts[before] - counts[after]
    kept = tie_points.kept
    moved = tie_points.source_px[kept] @ TRUTH[:, :2].T + TRUTH[:, 2]
    error = np.hypot(*(moved - tie_points.reference_px[kept]).T)
    assert (error < 1.5).mean() > 0.98
    assert np.median(error) < 0.3
    assert tie_points.sigma_px[0].tolist() == [0.3, 0.3]
    assert np.isnan(tie_points.residual_px).all()


def test_traditional_sift_is_the_ratio_test_alone(
    scene_keypoints: tuple[Keypoints, Keypoints],
) -> None:
    tie_points, counts = match_sift(*scene_keypoints)
    _, zhang_counts = match_zhang2013(*scene_keypoints)
    assert list(counts) == ["nearest", "ratio"]
    assert counts["ratio"] == zhang_counts["ratio"] == tie_points.kept.sum()
    assert set(tie_points.status.tolist()) == {Status.KEPT, Status.RATIO}


def test_as_printed_stops_after_step_5(scene_keypoints: tuple[Keypoints, Keypoints]) -> None:
    tie_points, counts = match_zhang2013(*scene_keypoints, AS_PRINTED)
    _, read = match_zhang2013(*scene_keypoints)
    assert tie_points.kept.sum() == counts["corresponding"] == read["not_cocircular"]
    assert read["corresponding"] < read["not_cocircular"]


def test_each_step_can_be_switched_off(scene_keypoints: tuple[Keypoints, Keypoints]) -> None:
    off = ZhangOptions(min_altitude=0, min_incircle=0, final_ratio=1, min_shared_edges=0)
    _, counts = match_zhang2013(*scene_keypoints, off)
    assert counts["one_to_one"] == counts["corresponding"]
