"""What moves together, what chance makes of it, and when clouds explain it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from geodelreg.fine.clouds import cloud_look, height_parallax
from geodelreg.fine.ground import find_ground, other_motion
from geodelreg.fine.motions import layers, second_motion
from geodelreg.judge.words import region

Array = NDArray[np.float64]
SPACING = 20.0


def lattice(count: int = 20) -> Array:
    axis = (np.arange(count) + 0.5) * SPACING
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def noisy(move: Array, rng: np.random.Generator, sigma: float = 0.03) -> Array:
    return np.asarray(move + sigma * rng.normal(size=move.shape))


def test_waves_are_one_layer() -> None:
    xy = lattice()
    move = 0.35 * np.sin(2 * np.pi * xy[:, ::-1] / 80.0)
    label = layers(xy, noisy(move, np.random.default_rng(0)), np.full(len(xy), 0.04))
    assert (label == 0).mean() > 0.98


@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_a_tear_makes_two(slope: float) -> None:
    xy = lattice()
    torn = xy[:, 1] + slope * xy[:, 0] > (0.7 if slope == 0.0 else 1.3) * 400
    move = np.where(torn[:, None], [[4.0, -3.0]], 0.0)
    label = layers(xy, noisy(move, np.random.default_rng(1)), np.full(len(xy), 0.04))
    assert (label[~torn] == 0).mean() > 0.95
    assert (label[torn] == 1).mean() > 0.9


def test_tiles_with_gaps_between_them_are_one_layer() -> None:
    inside = np.stack(np.meshgrid(np.arange(3), np.arange(3)), axis=-1).reshape(-1, 2) * SPACING
    corners = np.stack(np.meshgrid(np.arange(7), np.arange(7)), axis=-1).reshape(-1, 2) * 140.0
    xy = (corners[:, None] + inside[None]).reshape(-1, 2)
    label = layers(xy, noisy(np.zeros_like(xy), np.random.default_rng(2)), np.full(len(xy), 0.04))
    assert (label == 0).mean() > 0.98


def test_patches_that_fit_to_nobody_belong_to_no_layer() -> None:
    rng, xy = np.random.default_rng(3), lattice()
    wrong = rng.random(len(xy)) < 0.1
    move = noisy(np.zeros_like(xy), rng)
    move[wrong] += rng.uniform(3, 9, (int(wrong.sum()), 2))
    label = layers(xy, move, np.full(len(xy), 0.04))
    assert (label[~wrong] == 0).mean() > 0.95
    assert (label[wrong] != 0).all()


@given(st.integers(0, 3))
@settings(max_examples=4, deadline=None)
def test_a_handful_of_points_is_no_reason_to_fail(count: int) -> None:
    xy = lattice()[:count]
    assert len(layers(xy, np.zeros_like(xy), np.ones(count))) == count


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_chance_makes_no_second_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    radius, angle = 22 * np.sqrt(rng.random(60)), rng.uniform(0, 2 * np.pi, 60)
    move = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    found = second_motion(move, np.ones(60, dtype=bool), radius_px=1.0, reach_px=22.0)
    assert found is None or found.member.sum() < 8


def test_a_second_motion_is_found_among_patches_placed_anywhere() -> None:
    rng = np.random.default_rng(4)
    move = rng.uniform(-15, 15, (80, 2))
    move[:12] = [9.0, -4.0] + 0.2 * rng.normal(size=(12, 2))
    found = second_motion(move, np.ones(80, dtype=bool), radius_px=1.0, reach_px=22.0)
    assert found is not None
    assert found.member[:12].all()
    assert np.hypot(*(found.move - [9.0, -4.0])) < 0.3


@pytest.mark.parametrize(
    ("where", "words"),
    [
        (lambda x, y: y > 220, "the lower 45 %"),
        (lambda x, y: y < 100, "the upper 25 %"),
        (lambda x, y: x > 320, "the right 20 %"),
        (lambda x, y: x < 80 and y > 320, "4 % in the lower left"),
        (lambda x, y: max(abs(x - 200), abs(y - 200)) < 40, "4 % in the middle"),
    ],
)
def test_a_region_is_named(where: object, words: str) -> None:
    xy = lattice()
    member = np.array([where(x, y) for x, y in xy])  # type: ignore[operator]
    assert region(xy, member, (400.0, 400.0)) == words


def brightest(
    moves: NDArray[np.bool_], brighter: float, rng: np.random.Generator, noise: float = 1.0
) -> Array:
    return np.asarray(noise * rng.normal(size=len(moves)) + brighter * moves)


def test_patches_that_outshine_the_still_ones_beside_them_are_clouds() -> None:
    rng, xy = np.random.default_rng(5), lattice()
    moves = rng.random(len(xy)) < 0.3
    assert cloud_look(xy, moves, brightest(moves, 1.5, rng)).explains


def test_what_moves_and_is_no_brighter_is_none() -> None:
    rng, xy = np.random.default_rng(6), lattice()
    moves = rng.random(len(xy)) < 0.3
    assert not cloud_look(xy, moves, brightest(moves, 0.0, rng)).explains
    assert not cloud_look(xy, moves, brightest(moves, -1.5, rng)).explains


def test_many_patches_that_are_hardly_brighter_are_no_clouds() -> None:
    """However unlikely by chance: a cloud is brighter than the ground beside it, not a little."""
    rng, xy = np.random.default_rng(8), lattice(30)
    moves = rng.random(len(xy)) < 0.3
    assert not cloud_look(xy, moves, brightest(moves, 0.5, rng)).explains


def test_the_ground_between_more_clouds_is_where_the_correction_puts_it() -> None:
    rng, xy = np.random.default_rng(9), lattice(8)
    moves = rng.random(len(xy)) < 0.65
    shift = np.where(moves[:, None], (-1.7, 1.1), (0.0, 0.0)) + rng.normal(0, 0.01, xy.shape)
    ground = find_ground(xy, xy + shift, np.full(len(xy), 1e-4), brightest(moves, 8.0, rng))
    assert ground.look.explains
    assert ground.moving == pytest.approx(moves.mean(), abs=0.05)


@pytest.mark.parametrize("torn", [True, False])
def test_a_part_that_a_line_cuts_off_is_told_from_bright_patches_here_and_there(torn: bool) -> None:
    rng, xy = np.random.default_rng(10), lattice(6)
    moves = xy.sum(axis=1) > 150.0 if torn else rng.random(len(xy)) < 0.4
    shift = np.where(moves[:, None], (-1.0, 0.4), (0.0, 0.0)) + rng.normal(0, 0.01, xy.shape)
    ground = find_ground(xy, xy + shift, np.full(len(xy), 1e-4), brightest(moves, 8.0, rng))
    assert ground.is_torn == torn
    assert ground.moving == pytest.approx(moves.mean())


def test_snowy_hills_look_like_clouds_and_are_one_layer_of_ground() -> None:
    rng, xy = np.random.default_rng(9), lattice()
    gap = xy[:, None] - np.array([(100.0, 90.0), (290.0, 130.0), (120.0, 300.0), (300.0, 310.0)])
    height = np.exp(-((gap / 30.0) ** 2).sum(axis=2) / 2).sum(axis=1)
    there = xy + noisy(height[:, None] * (0.5, 0.3), rng, 0.01)
    doubt, shown = np.full(len(xy), 1e-4), brightest(height > 0.1, 8.0, rng)
    ground = find_ground(xy, there, doubt, shown)
    assert ground.look.explains
    assert ground.member.all()


def test_a_scene_that_is_brighter_at_the_end_that_moves_shows_no_clouds() -> None:
    rng, xy = np.random.default_rng(7), lattice()
    moves = (xy[:, 1] > 160) & (rng.random(len(xy)) < 0.9)
    slope = xy[:, 1] / 40.0
    assert not cloud_look(xy, moves, brightest(moves, 0.0, rng, 0.3) + slope).explains


def test_a_bright_part_that_is_torn_off_is_no_cloud() -> None:
    rng, xy = np.random.default_rng(7), lattice()
    moves = xy[:, 1] > 220
    assert not cloud_look(xy, moves, brightest(moves, 5.0, rng)).explains


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_where_nothing_moves_or_everything_there_is_nothing_to_compare(share: float) -> None:
    xy = lattice(7)
    moves = np.full(len(xy), share > 0.5)
    assert not cloud_look(xy, moves, np.arange(len(xy), dtype=float)).explains


def test_height_shows_in_the_bands_and_what_does_not_differ_is_ground() -> None:
    rng = np.random.default_rng(9)
    height = np.where(rng.random(300) < 0.5, rng.uniform(0.5, 2.0, 300), 0.0)
    direction = np.array([[-0.4, 0.9]])
    sigma = np.full(300, 0.15)
    move = noisy(height[:, None] * direction, rng, 0.1)
    difference = noisy(1.4 * height[:, None] * direction, rng, 0.1)
    found = height_parallax(move, difference, sigma)
    assert found.explains
    assert found.share == pytest.approx((height > 0).mean(), abs=0.05)


def test_bands_that_move_together_over_a_bent_ground_say_nothing_of_height() -> None:
    rng, xy = np.random.default_rng(10), lattice()
    move = noisy(0.5 * np.sin(2 * np.pi * xy / 150.0), rng, 0.05)
    difference = noisy(np.zeros_like(xy), rng, 0.1)
    assert not height_parallax(move, difference, np.full(len(xy), 0.15)).explains


@pytest.mark.parametrize("brighter", [0.0, 5.0])
def test_another_layer_counts_unless_it_is_a_cloud(brighter: float) -> None:
    rng, xy = np.random.default_rng(11), lattice()
    cloud = np.abs(xy - 210.0).max(axis=1) < 55
    move = noisy(np.where(cloud[:, None], [[4.0, -3.0]], 0.0), rng)
    label = layers(xy, move, np.full(len(xy), 0.04))
    found = other_motion(xy, move, label, brightest(cloud, brighter, rng), len(xy), 22.0)
    assert (found is None) == bool(brighter)
    if found is not None:
        assert found.member.mean() == pytest.approx(0.06, abs=0.02)
        assert found.move == pytest.approx([4.0, -3.0], abs=0.1)


def test_a_strip_one_patch_wide_counts_and_scattered_patches_do_not() -> None:
    rng, xy = np.random.default_rng(12), lattice(12)
    last, scattered = xy[:, 1] > 225, rng.permutation(len(xy)) < 12
    for moves, counts in ((last, True), (scattered, False)):
        move = noisy(np.where(moves[:, None], [[8.0, -3.0]], 0.0), rng)
        label = layers(xy, move, np.full(len(xy), 0.04))
        found = other_motion(xy, move, label, brightest(moves, 0.0, rng), len(xy), 22.0)
        assert (found is not None) == counts
        assert found is None or (found.member == moves).all()


def test_less_of_what_a_line_cuts_off_counts_than_of_what_lies_amid_the_ground() -> None:
    rng, xy = np.random.default_rng(13), lattice(20)
    low, x = np.sort(np.unique(xy[:, 1]))[-1], xy[:, 0]
    corner = xy.sum(axis=1) > np.sort(xy.sum(axis=1))[-13]
    amid = np.abs(xy - np.median(xy, axis=0)).max(axis=1) < 45
    strip = (xy[:, 1] >= low) & (x < np.quantile(x, 0.7))
    for moves, counts in ((corner, True), (amid, False), (strip, False), (xy[:, 1] >= low, True)):
        assert 0.02 < moves.mean() <= 0.05
        move = noisy(np.where(moves[:, None], [[8.0, -3.0]], 0.0), rng)
        label = layers(xy, move, np.full(len(xy), 0.04))
        found = other_motion(xy, move, label, brightest(moves, 0.0, rng), len(xy), 22.0)
        assert (found is not None) == counts
