"""The verdict: every reason refuses by itself, and says what it measured."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import stats

import geodelreg
from geodelreg.errors import AlignmentRefusedError
from geodelreg.fit.chance import log10_binomial_tail, signed_ranks
from geodelreg.judge.verdict import Evidence, is_worthwhile, judge, nothing_agrees, verdict
from geodelreg.options import AlignOptions
from geodelreg.values.result import Outcome
from tests.unit.alignment_sample import refused

GOOD = Evidence(
    points=100,
    log_nfa=-200.0,
    log_chance=-30.0,
    coverage=0.8,
    sigma_px=0.01,
    disagreement_px=0.02,
    rival=0.2,
    shading=0.1,
    shift_px=8.0,
    rotation_deg=1.5,
    scale=1.01,
    rival_motion=0.0,
    support=0.95,
    bands_apart=0.1,
    keypoints_apart=0.0,
    residual_low_px=0.0,
    moved=0.0,
    bands=0.3,
)
# as docs/method.md tells them
UPPER = {
    "log_nfa": -2.0,
    "log_chance": -2.0,
    "sigma_px": 0.7,
    "disagreement_px": 1.0,
    "rival": 0.85,
    "shading": 0.3,
    "rival_motion": 0.67,
    "bands_apart": 0.5,
    "keypoints_apart": 2.0,
    "residual_low_px": 0.5,
    "moved": 0.02,
    "bands": 1.0,
}
LOWER = {"points": 8, "coverage": 0.05, "support": 0.5}
ASKED = {
    "shift_px": AlignOptions(max_shift_px=9.0),
    "rotation_deg": AlignOptions(max_rotation_deg=2.0),
    "scale": AlignOptions(max_scale=1.05),
}


def outcome(evidence: Evidence, options: AlignOptions | None = None) -> Outcome:
    return verdict(judge(evidence, options or AlignOptions()), moves=True).outcome


@pytest.mark.parametrize(("log_nfa", "log_chance"), [(-5.0, -2.9), (-2.5, -5.0)])
def test_two_weak_kinds_of_evidence_are_not_enough(log_nfa: float, log_chance: float) -> None:
    weak = replace(GOOD, log_nfa=log_nfa, log_chance=log_chance)
    assert [r.name for r in judge(weak, AlignOptions()) if not r.passed] == ["log_together"]
    assert outcome(replace(weak, log_nfa=-30.0 - log_chance)) is Outcome.ALIGNED


def test_good_evidence_passes_every_reason() -> None:
    reasons = judge(GOOD, AlignOptions())
    assert all(reason.passed for reason in reasons)
    assert len({reason.name for reason in reasons}) == len(reasons)
    assert len(reasons) == len(UPPER) + len(LOWER) + 1  # log_together is the sum of two
    assert outcome(GOOD) is Outcome.ALIGNED
    assert verdict(reasons, moves=False).outcome is Outcome.ALREADY_ALIGNED


@pytest.mark.parametrize("name", [*UPPER, *LOWER])
def test_each_reason_refuses_by_itself(name: str) -> None:
    limit = {**UPPER, **LOWER}[name]
    worse = 1 if name in UPPER else -1
    step = worse * (1 if name == "points" else 1e-6)
    assert outcome(replace(GOOD, **{name: limit})) is Outcome.ALIGNED
    beyond = replace(GOOD, **{name: limit + step})
    assert outcome(beyond) is Outcome.REFUSED
    failed = [reason for reason in judge(beyond, AlignOptions()) if not reason.passed]
    assert [(reason.value, reason.limit) for reason in failed] == [(limit + step, limit)]
    assert f"{limit + step:.4g} " in failed[0].message
    assert f"{limit:g}" in failed[0].message


@pytest.mark.parametrize("name", [*UPPER, *LOWER])
def test_what_was_not_measured_does_not_pass(name: str) -> None:
    assert outcome(replace(GOOD, **{name: math.nan})) is Outcome.REFUSED


@pytest.mark.parametrize("name", ASKED)
def test_limits_that_were_asked_for_refuse(name: str) -> None:
    far = replace(GOOD, **{name: 1000.0})
    assert outcome(GOOD, ASKED[name]) is Outcome.ALIGNED
    assert outcome(far, ASKED[name]) is Outcome.REFUSED
    assert outcome(far) is Outcome.ALIGNED


def test_nothing_found_is_a_refusal() -> None:
    refused = verdict((nothing_agrees(),), moves=True)
    assert refused.outcome is Outcome.REFUSED
    assert not refused.accepted


@settings(max_examples=300)
@given(st.integers(1, 3000), st.floats(0, 1), st.floats(0.02, 0.9))
@example(192, 0.9765625, 0.02)
def test_binomial_tail_is_scipys(trials: int, share: float, probability: float) -> None:
    """An upper bound, and a tight one where it counts."""
    successes = round(share * trials)
    exact = stats.binom.logsf(successes - 1, trials, probability) / math.log(10)
    found = log10_binomial_tail(successes, trials, probability)
    assert found <= 0
    if exact < -300:
        return  # a subnormal number to scipy, with few digits
    assert found >= exact - 1e-6 * max(1, abs(exact))
    if exact < -4:
        assert found == pytest.approx(exact, abs=0.15)


def test_no_trials_prove_nothing() -> None:
    assert log10_binomial_tail(0, 0, 0.25) == 0.0


@pytest.mark.parametrize(
    ("move_px", "sigma_px", "moves"),
    [
        (0.0, 0.001, False),
        (0.014, 0.001, False),
        (0.018, 0.001, True),
        (0.018, 0.02, False),
        (0.03, 0.5, True),
    ],
    ids=["none", "within the systematic error", "significant", "insignificant", "large"],
)
def test_small_insignificant_corrections_are_not_worthwhile(
    move_px: float, sigma_px: float, moves: bool
) -> None:
    move, sigma = np.zeros(25), np.full(25, sigma_px)
    move[-1] = move_px
    assert is_worthwhile(move, sigma, tolerance_px=0.02) is moves


def test_of_a_refused_alignment_nothing_is_written(tmp_path: Path) -> None:
    out, points = tmp_path / "out.tif", tmp_path / "out.points"
    with pytest.raises(AlignmentRefusedError):
        geodelreg.write(refused(), out)
    with pytest.raises(AlignmentRefusedError):
        geodelreg.write_in_place(refused())
    with pytest.raises(AlignmentRefusedError) as caught:
        geodelreg.export_gcps(refused(), points)
    assert "`search_radius_px`" in caught.value.remedy
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("names", "word"),
    [
        ({"moved": 0.3}, "`mask`"),
        ({"moved": 0.3, "residual_low_px": 2.0}, "`mask`"),
        ({"residual_low_px": 2.0}, "`on_local='warn'`"),
        ({"bands": 3.0}, "`band=N`"),
        ({"rival": 0.99}, "repeated texture"),
        ({"sigma_px": 2.0}, "simpler `model`"),
        ({"support": 0.1}, "same ground"),
        ({"rival_motion": 0.9}, "`warp=True`"),
        ({"rival_motion": 0.9}, "a part is displaced"),
    ],
)
def test_a_refusal_says_what_can_be_done_here(names: dict[str, float], word: str) -> None:
    evidence = replace(GOOD, **names)  # type: ignore[arg-type]
    assert word in verdict(judge(evidence, AlignOptions()), moves=True).remedy


@pytest.mark.parametrize(
    ("points", "rival", "said"),
    [
        (1, 1.0, {"1 tie point agrees (needs ≥ 8)", "1 patch agrees"}),
        (
            5,
            0.9,
            {"5 tie points agree (needs ≥ 8)", "0.9 patches agree"},
        ),
    ],
)
def test_one_is_singular(points: int, rival: float, said: set[str]) -> None:
    reasons = judge(replace(GOOD, points=points, rival_motion=rival), AlignOptions())
    messages = [reason.message.partition(" on another")[0] for reason in reasons]
    assert said <= set(messages)


def test_a_correction_beyond_what_was_allowed_names_the_limits() -> None:
    far = replace(GOOD, shift_px=40.0)
    found = verdict(judge(far, AlignOptions(max_shift_px=9.0)), moves=True)
    assert "`max_shift_px`" in found.remedy


@pytest.mark.parametrize("shift", [-0.5, 0.0, 0.5, 2.0])
def test_signed_rank_tail_is_scipys(shift: float) -> None:
    values = np.random.default_rng(3).normal(shift, 1.0, 40)
    expected = stats.wilcoxon(
        values, alternative="greater", correction=False, method="approx"
    ).pvalue
    assert signed_ranks(values)[0] == pytest.approx(math.log10(expected), rel=1e-6)
