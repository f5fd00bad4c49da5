"""Nearest descriptors, ratio, one-to-one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from geodelreg.coarse.descriptors import (
    match_descriptors,
    one_to_one,
    ratio_test,
)
from geodelreg.values.points import Keypoints


def keypoints(count: int, seed: int) -> Keypoints:
    rng = np.random.default_rng(seed)
    descriptors = rng.integers(0, 120, (count, 128)).astype(np.float32)
    return Keypoints(rng.uniform(0, 100, (count, 2)), descriptors)


@pytest.mark.parametrize(("sources", "references"), [(1, 2), (300, 257), (2500, 40)])
def test_agrees_with_brute_force_matcher(sources: int, references: int) -> None:
    source, reference = keypoints(sources, 1), keypoints(references, 2)
    matches = match_descriptors(source, reference)
    oracle = cv2.BFMatcher(cv2.NORM_L2).knnMatch(source.descriptors, reference.descriptors, 2)
    assert (matches.source_index == np.arange(sources)).all()
    assert [m[0].trainIdx for m in oracle] == matches.reference_index.tolist()
    np.testing.assert_allclose(
        matches.ratio, [m[0].distance / m[1].distance for m in oracle], rtol=1e-6
    )


def test_equal_descriptors_have_ratio_zero() -> None:
    source = keypoints(50, 1)
    matches = match_descriptors(source, source)
    assert (matches.reference_index == np.arange(50)).all()
    assert (matches.ratio == 0).all()


def test_ambiguous_descriptor_has_ratio_one() -> None:
    reference = keypoints(10, 1)
    reference.descriptors[3] = reference.descriptors[7]
    matches = match_descriptors(reference, reference)
    assert matches.ratio[3] == matches.ratio[7] == 1.0
    assert not ratio_test(matches.ratio, 1.0)[[3, 7]].any()


@pytest.mark.parametrize(("sources", "references"), [(0, 5), (5, 0), (5, 1)])
def test_too_few_keypoints_give_no_matches(sources: int, references: int) -> None:
    matches = match_descriptors(keypoints(sources, 1), keypoints(references, 2))
    assert len(matches) == 0
    assert len(matches.xy(keypoints(sources, 1), keypoints(references, 2))[0]) == 0


def test_one_to_one_keeps_the_best_ratio_of_repeated_and_many_to_one_matches() -> None:
    source = np.array([[10.0, 10], [10.0, 10], [50, 50], [70, 70], [90, 90]])
    reference = np.array([[20.0, 20], [20.0, 20], [60, 60], [60, 60], [99, 99]])
    ratio = np.array([0.5, 0.4, 0.6, 0.3, 0.7])
    keep = one_to_one(source, reference, ratio)
    assert keep.tolist() == [False, True, False, True, True]


def test_one_to_one_leaves_no_shared_place_and_is_maximal() -> None:
    rng = np.random.default_rng(5)
    source = rng.integers(0, 12, (300, 2)).astype(float)
    reference = rng.integers(0, 12, (300, 2)).astype(float)
    ratio = rng.random(300)
    keep = one_to_one(source, reference, ratio)
    assert len(np.unique(source[keep], axis=0)) == keep.sum()
    assert len(np.unique(reference[keep], axis=0)) == keep.sum()
    for i in np.flatnonzero(~keep):
        rival = (source[keep] == source[i]).all(1) | (reference[keep] == reference[i]).all(1)
        assert (ratio[keep][rival] < ratio[i]).any()


def test_one_to_one_of_nothing() -> None:
    assert len(one_to_one(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))) == 0


def test_select_by_mask_and_by_index_agree() -> None:
    matches = match_descriptors(keypoints(20, 1), keypoints(20, 2))
    mask = ratio_test(matches.ratio, 0.97)
    by_mask, by_index = matches.take(mask), matches.take(np.flatnonzero(mask))
    assert 0 < len(by_mask) < 20
    assert by_mask.ratio.tolist() == by_index.ratio.tolist()
    assert by_mask.source_index.tolist() == by_index.source_index.tolist()
