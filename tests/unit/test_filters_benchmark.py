"""The filters' benchmark finds the share up to which a target is met."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.accuracy import filters
from benchmarks.accuracy.filters import FILTERS, Case, Row, draw_matches, measure, reach

CASE = Case(100, 2.0, 0.3, 0.0, 0.0)


def _rows(recalls: dict[float, float]) -> list[Row]:
    return [
        Row(replace(CASE, outlier_share=share), name, 0.995, recall, 1.0)
        for share, recall in recalls.items()
        for name in FILTERS
    ]


@pytest.mark.parametrize(
    ("recalls", "expected"),
    [
        ({0.0: 1.0, 0.5: 0.98, 0.9: 0.97}, "90 %"),
        ({0.0: 1.0, 0.5: 0.98, 0.9: 0.96}, "50 %"),
        ({0.0: 1.0, 0.5: 0.96, 0.9: 0.98}, "0 %"),
        ({0.0: 0.9, 0.5: 0.98}, "–"),
    ],
)
def test_reach_ends_where_the_target_is_first_missed(
    recalls: dict[float, float], expected: str
) -> None:
    assert reach(_rows(recalls)).splitlines()[2].split(" | ")[-1].rstrip(" |") == expected


def test_drawn_matches_are_wrong_as_often_as_asked() -> None:
    case = replace(CASE, outlier_share=0.3)
    _, _, _, right = draw_matches(case, 0)
    assert right.sum() == 70


def test_page_has_the_tables_and_the_plot(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    rows = [
        row
        for share in (0.0, 0.4)
        for row in measure(replace(CASE, count=60, outlier_share=share), 1)
    ]
    filters.draw(rows, tmp_path / "filters.png")
    assert (tmp_path / "filters.png").stat().st_size > 5000
