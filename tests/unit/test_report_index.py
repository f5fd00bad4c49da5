"""The page of a batch: its table, its map and its links."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from geodelreg.report.index import MOST_ROWS, Row, index
from tests.cli.pages import Page


def square(lon: float, lat: float, side: float = 0.5) -> dict[str, object]:
    ring = [(lon, lat), (lon + side, lat), (lon + side, lat + side), (lon, lat + side), (lon, lat)]
    return {"type": "Polygon", "coordinates": [ring]}


def row(number: int, outcome: str = "aligned", **changes: object) -> Row:
    values: dict[str, object] = {
        "ms": f"ms_{number}.tif",
        "pan": f"pan_{number}.tif",
        "reason": "",
        "figures": {"offset_px": float(number), "tie_points": 90},
        "footprint": square(10.0 + number, 45.0),
        "page": f"pairs/{number:06}.html",
    }
    return Row(number=number, outcome=outcome, **(values | changes))  # type: ignore[arg-type]


def page_of(tmp_path: Path, rows: list[Row]) -> Page:
    (tmp_path / "index.html").write_text(index(rows), encoding="utf-8")
    return Page(tmp_path / "index.html")


def test_each_pair_has_a_row_a_shape_and_a_link(tmp_path: Path) -> None:
    rows = [row(1), row(2, "refused", reason="too few tie points"), row(3, "failed", page="")]
    page = page_of(tmp_path, rows)
    outcomes = [a["data-outcome"] for _, a in page.elements if "data-outcome" in a]
    assert outcomes == ["aligned", "refused", "failed"]
    assert [a["data-pair"] for _, a in page.elements if "data-pair" in a] == ["1", "2", "3"]
    assert [a["href"] for a in page.all("a")] == ["pairs/000001.html", "pairs/000002.html"]
    assert "too few tie points" in page.text
    assert "1 failed, 1 refused, 1 aligned." in page.text


def test_the_map_has_true_proportions(tmp_path: Path) -> None:
    page = page_of(tmp_path, [row(0), row(3)])
    one, other = (
        [tuple(map(float, point.split())) for point in re.split("[MLz]+", shape["d"]) if point]
        for shape in page.all("path")
        if "data-pair" in shape
    )
    (west, south), (east, north) = one[0], one[2]
    assert (east - west) / (south - north) == pytest.approx(math.cos(math.radians(45.25)), rel=0.02)
    assert (other[0][0] - west) / (east - west) == pytest.approx(6.0, rel=0.01)


def test_names_and_reasons_are_shown_and_not_run(tmp_path: Path) -> None:
    name = "</td><script>alert(1)</script>\u202e'\".tif"
    page = page_of(tmp_path, [row(1, ms=name, reason='<img src=x onerror="x">')])
    assert len(page.all("script")) == 1
    assert not page.all("img")
    assert "</td><script>alert(1)</script>\\u202e'\".tif" in page.text
    assert '<img src=x onerror="x">' in page.text
    assert "\u202e" not in page.source


def test_of_very_many_pairs_the_worst_are_listed(tmp_path: Path) -> None:
    rows = [row(n, "failed" if n % 7 == 0 else "aligned") for n in range(1, MOST_ROWS + 11)]
    page = page_of(tmp_path, rows)
    listed = [a["data-outcome"] for _, a in page.elements if "data-outcome" in a]
    assert len(listed) == MOST_ROWS
    assert listed.count("failed") == sum(r.outcome == "failed" for r in rows)
    assert f"This page lists the {MOST_ROWS} worst" in page.text


@pytest.mark.parametrize("footprint", [None, {"type": "MultiPolygon", "coordinates": [
    square(179.5, 0.0)["coordinates"], square(-180.0, 0.0)["coordinates"]]}])  # fmt: skip
def test_pairs_without_a_footprint_and_across_the_antimeridian(
    tmp_path: Path, footprint: dict[str, object] | None
) -> None:
    page = page_of(tmp_path, [row(1, footprint=footprint)])
    shapes = [a for a in page.all("path") if "data-pair" in a]
    assert len(shapes) == (footprint is not None)
    assert "ms_1.tif" in page.text
