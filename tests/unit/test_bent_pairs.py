"""Bent, torn and framed pairs: their truth is true, and faults are called by their names."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from scipy.ndimage import gaussian_filter

from benchmarks.gate.bent import faults, table
from benchmarks.gate.bent_cases import KINDS, SOURCES_HELD_OUT, BentPair, bent_cases
from benchmarks.gate.distortions import Tear, frame, waves
from benchmarks.scenes.imagery import sample_imagery
from benchmarks.scenes.make import HeaderError, SceneSpec, make_scene
from geodelreg.fine.overlay import Overlay
from geodelreg.fine.survey import survey

SPEC = SceneSpec("bent", "", HeaderError((1.3, -0.7)), (400, 400), (160, 160), ratio=2.0)
ROW = {"kind": "tear", "before_px": 4.0, "best_px": 3.0, "outcome": "aligned", "warned": ["!"]}


def test_waves_are_as_high_and_as_steep_as_they_say() -> None:
    bend = waves(2.0, 600.0, np.random.default_rng(0))
    spots = np.random.default_rng(1).uniform(0, 4000, (20000, 2))
    move = bend(spots)
    assert np.hypot(*move.T).max() == pytest.approx(2.0, rel=0.01)
    steep = np.abs(bend(spots + np.array([1.0, 0.0])) - move).max()
    assert steep == pytest.approx(2 * np.pi * np.sqrt(2) / 600, rel=0.05)


@pytest.mark.parametrize("angle", [0.0, 35.0])
def test_a_tear_moves_its_share_and_nothing_else(angle: float) -> None:
    tear = Tear((9.0, -4.0), 0.3, angle, (500, 700))
    rows, columns = np.mgrid[:500, :700]
    spots = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float)
    assert tear.inside(spots).mean() == pytest.approx(0.3, abs=0.02)
    assert (tear(spots)[tear.inside(spots)] == [9.0, -4.0]).all()
    assert (tear(spots)[~tear.inside(spots)] == 0.0).all()


def test_the_content_lies_where_the_truth_says() -> None:
    shift = np.array([3.0, -2.0])
    bent = make_scene(SPEC, sample_imagery(), lambda xy: np.broadcast_to(shift, xy.shape))
    plain = make_scene(SPEC, sample_imagery())
    full = np.ones(plain.ms.shape[1:], dtype=bool)
    one, other = (
        gaussian_filter(ms.astype(np.float32).mean(axis=0), 1) for ms in (bent.ms, plain.ms)
    )
    found = survey(Overlay(one, other, full, full))
    assert np.median(found.move, axis=0) == pytest.approx(shift / SPEC.ratio, abs=0.1)
    pair = BentPair(bent, lambda xy: np.broadcast_to(shift, xy.shape))
    assert pair.errors(Affine(*bent.truth.ms_true)) == pytest.approx(np.tile(-shift, (441, 1)))
    assert np.abs(pair.errors(pair.best_affine())).max() < 1e-9


def test_a_frame_is_the_same_on_both_grids() -> None:
    ms, pan = np.full((4, 100, 100), 500, np.uint16), np.full((400, 400), 500, np.uint16)
    frame((ms, pan), "labels", np.random.default_rng(3))
    coarse = (pan == 4000).reshape(100, 4, 100, 4).mean(axis=(1, 3)) > 0.5
    assert 0.005 < (ms[0] == 4000).mean() < 0.3
    assert (coarse == (ms[0] == 4000)).mean() > 0.98


def test_every_kind_has_cases_and_held_out_sources_stay_apart() -> None:
    tuning, held_out = (bent_cases(4 * len(KINDS), part) for part in ("tuning", "held out"))
    assert {case.kind for case in tuning} == set(KINDS)
    assert {case.source for case in held_out} <= set(SOURCES_HELD_OUT)
    assert not {case.source for case in tuning} & set(SOURCES_HELD_OUT)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"written_px": 3.0}, ["silently wrong"]),
        ({"written_px": None}, ["silently wrong"]),
        ({"written_px": 0.7}, []),
        ({"written_px": 0.7, "warned": []}, ["not warned of"]),
        ({"written_px": 0.4}, ["residual wrong"]),
        ({"written_px": 0.4, "said_px": 0.5}, []),
        ({"written_px": 0.4, "said_px": 0.1, "said_low_px": 0.0, "said_high_px": 0.5}, []),
        ({"outcome": "refused"}, []),
        ({"outcome": "refused", "kind": "fill"}, ["refused for nothing"]),
        ({"outcome": "refused", "checked": "aligned"}, ["checked wrongly"]),
        ({"outcome": "refused", "checked": "aligned", "before_px": None}, ["checked wrongly"]),
    ],
)
def test_faults_are_called_by_their_names(changes: dict[str, object], expected: list[str]) -> None:
    assert faults(ROW | changes) == expected


def test_the_table_counts_faults_by_kind() -> None:
    rows = [ROW | {"written_px": 3.0}, ROW | {"outcome": "refused"}]
    assert "| tear | 2 | 1 | 1 | 0 | 0 | 0 | 0 | 0 |" in table(rows)
