"""The paper's experiments: steps composed as the library does, and figures that add up."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from affine import Affine
from pyproj import CRS

from benchmarks.paper.ablation import ALL, NONE, compositions, interval
from benchmarks.paper.methods import (
    PRINTED,
    READ,
    SIFT,
    STEPS,
    STEPS_OF,
    Matched,
    Stage,
    distinct_right,
    fit_plainly,
    fit_robustly,
    match_plainly,
    run_mesh,
    run_steps,
    score_keypoints,
    set_stage,
    true_rmse,
)
from benchmarks.paper.scenes import crop_pan
from benchmarks.scenes.make import Scene
from benchmarks.scenes.truth import Truth
from geodelreg.paper.baseline import grey_keypoints
from geodelreg.paper.zhang2013 import AS_PRINTED, ZhangOptions, match_sift, match_zhang2013
from geodelreg.values.points import Status
from geodelreg.values.raster import Band, Float32Array, Grid, Window

UTM18 = CRS.from_epsg(32618).to_wkt()
PAN = Affine(10.0, 0.0, 500_000.0, 0.0, -10.0, 4_000_000.0)
SHIFT_PX = 3.0


class Reader:
    """One band from an array."""

    def __init__(self, data: Float32Array, transform: Affine) -> None:
        self.data, self.grid = data, Grid(transform, data.shape, UTM18)
        self.name, self.band_names, self.decimations = "array", ("band",), (1.0,)

    def read(
        self, bands: list[int], window: Window, shape: tuple[int, int] | None = None
    ) -> list[Band]:
        column, row, width, height = window
        part = self.data[row : row + height, column : column + width]
        assert shape in (None, part.shape)
        transform = self.grid.transform @ Affine.translation(column, row)
        good = np.ones(part.shape, dtype=bool)
        return [Band(part, good, Grid(transform, part.shape, UTM18), "band") for _ in bands]


@pytest.fixture(scope="module")
def stage() -> Stage:
    """One image and itself, three pixels apart, and a patch of one that lies elsewhere."""
    from scipy import ndimage

    rng = np.random.default_rng(4)
    ground = sum(ndimage.gaussian_filter(rng.standard_normal((260, 260)), s) * s for s in (1, 2, 5))
    pan = (1000 + 300 * ground).astype(np.float32)
    ms = pan[10:250, 10:250].copy()
    ms[:60, :60] = pan[150:210, 100:160]
    true = PAN @ Affine.translation(10, 10)
    header = true @ Affine.translation(SHIFT_PX, 0)
    truth = Truth(
        "T", "", "", UTM18, UTM18, tuple(header)[:6], tuple(true)[:6], tuple(PAN)[:6], ms.shape,
        pan.shape,
    )  # fmt: skip
    return set_stage(Reader(ms, header), Reader(pan, PAN), truth)


@pytest.fixture(scope="module")
def matched(stage: Stage) -> Matched:
    return match_plainly(stage)[0]


@pytest.mark.parametrize(
    ("method", "library", "options"),
    [
        (SIFT, match_sift, ZhangOptions()),
        (PRINTED, match_zhang2013, AS_PRINTED),
        (READ, match_zhang2013, ZhangOptions()),
    ],
)
def test_steps_of_each_method_are_the_librarys(
    stage: Stage, matched: Matched, method: str, library: Any, options: ZhangOptions
) -> None:
    points, counts = library(*grey_keypoints(stage.images), options)
    status, steps = run_steps(matched, STEPS_OF[method])
    assert np.array_equal(status, points.status)
    assert list(steps.values()) == list(counts.values())[1 : 1 + len(steps)]


def test_compositions_leave_out_and_add_each_step_once() -> None:
    found = compositions()
    assert len(found) == 2 + 2 * len(STEPS)
    assert found[ALL] == tuple(STEPS)
    assert found[NONE] == ()
    for name in STEPS:
        assert found[f"only {name}"] == (name,)
        assert set(found[f"without {name}"]) == set(STEPS) - {name}


def test_steps_run_in_the_papers_order_whatever_order_they_are_named_in(matched: Matched) -> None:
    forward, backward = run_steps(matched, tuple(STEPS)), run_steps(matched, tuple(STEPS)[::-1])
    assert np.array_equal(forward[0], backward[0])


def test_right_matches_are_those_near_the_truth(stage: Stage, matched: Matched) -> None:
    status, _ = run_steps(matched, ("3 one-to-one",))
    kept = status == Status.KEPT
    moved = matched.reference_px - matched.source_px - 10.0
    expected = np.hypot(*moved.T) <= 1.0
    assert np.array_equal(matched.right, expected)
    assert 0.6 < matched.right[kept].mean() < 0.99
    inside_patch = (matched.source_px[kept] < 50).all(axis=1)
    assert not matched.right[kept][inside_patch].any()


def test_score_tells_the_fits_residual_from_the_true_error(stage: Stage, matched: Matched) -> None:
    everything = run_steps(matched, ())[0] == Status.KEPT
    # the misplaced patch alone: a good fit of the wrong thing
    patch = everything & (matched.source_px < 50).all(axis=1)
    patch &= np.hypot(*(matched.reference_px - matched.source_px - [100, 150]).T) < 1.0
    score = score_keypoints(stage, matched, patch, {}, 0.0)
    assert score.right == 0
    assert score.kept == patch.sum()
    assert score.control_rmse_px < 0.5
    assert score.true_rmse_px > 50
    right = score_keypoints(stage, matched, everything & matched.right, {}, 0.0)
    assert right.right == right.kept
    assert right.true_rmse_px < 0.1
    assert right.e1 < 0.5 * score_keypoints(stage, matched, everything, {}, 0.0).e1


def test_robust_fit_and_our_filter_survive_the_misplaced_patch(
    stage: Stage, matched: Matched
) -> None:
    kept = run_steps(matched, ("3 one-to-one",))[0] == Status.KEPT
    assert true_rmse(stage, fit_plainly(stage, matched, kept)) > 1.0
    assert true_rmse(stage, fit_robustly(stage, matched, kept)) < 0.1
    mesh, counts = run_mesh(matched)
    assert counts["our filter"] == mesh.sum()
    assert true_rmse(stage, fit_plainly(stage, matched, mesh)) < 0.1
    assert np.isnan(true_rmse(stage, fit_plainly(stage, matched, np.zeros_like(mesh))))


def test_repeated_pairs_of_places_count_once(matched: Matched) -> None:
    twice = replace(
        matched,
        **{
            name: np.concatenate([getattr(matched, name)] * 2)
            for name in ("source_xy", "reference_xy", "ratio", "right")
        },
    )
    kept = run_steps(matched, ("3 one-to-one",))[0] == Status.KEPT
    once = int((kept & matched.right).sum())
    assert distinct_right(matched, kept) == once
    assert distinct_right(twice, np.concatenate([kept, kept])) == once


def test_interval_holds_the_median_and_widens_with_the_spread_between_sources() -> None:
    rng = np.random.default_rng(0)
    values = [*rng.normal(1, 0.1, 40), np.nan]
    groups = [*(["a", "b", "c", "d"] * 10), "a"]
    median, low, high = interval(values, groups)
    assert median == np.nanmedian(values)
    assert low < median < high
    apart = [v + {"a": 0, "b": 1, "c": 2, "d": 3}[g] for v, g in zip(values, groups, strict=True)]
    wide = interval(apart, groups)
    assert wide[2] - wide[1] > 3 * (high - low)
    assert np.isnan(interval([np.nan], ["a"])).all()


def test_cut_out_of_pan_moves_its_header_with_it() -> None:
    pan = np.arange(100, dtype=np.uint16).reshape(10, 10)
    truth = Truth("T", "", "", UTM18, UTM18, (0,) * 6, (0,) * 6, tuple(PAN)[:6], (4, 4), (10, 10))
    cut = crop_pan(Scene(pan[None], pan, truth), 3, 2, 5)
    assert cut.pan.shape == cut.truth.pan_shape == (5, 5)
    assert cut.pan[0, 0] == 23
    assert Affine(*cut.truth.pan) @ (0.0, 0.0) == PAN @ (3.0, 2.0)
