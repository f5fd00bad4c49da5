"""Accuracy does not get worse than twice what was recorded, on scenes of the sample pair."""

from __future__ import annotations

import math

import pytest

from benchmarks.accuracy.sweep import SAMPLE, run_case, sample_cases, worse_than_recorded
from benchmarks.scenes.imagery import Imagery, sample_imagery


@pytest.fixture(scope="module")
def imagery() -> Imagery:
    return sample_imagery()


@pytest.mark.parametrize("name", SAMPLE)
def test_scene_is_aligned_as_well_as_recorded(name: str, imagery: Imagery) -> None:
    row = run_case(sample_cases()[name], imagery)
    assert row.outcome == "aligned"
    assert not worse_than_recorded(name, row.rmse_px), f"{row.rmse_px:.4f} px"


@pytest.mark.parametrize("name", SAMPLE)
def test_what_is_worse_is_told_from_what_is_not(name: str) -> None:
    recorded = SAMPLE[name][2]
    assert not worse_than_recorded(name, 1.9 * recorded)
    assert worse_than_recorded(name, 2.1 * recorded)
    assert worse_than_recorded(name, math.nan)
