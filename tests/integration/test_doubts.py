"""What looks as if something else had been meant is asked, and done all the same."""

from __future__ import annotations

import shutil
from pathlib import Path

import rasterio

import geodelreg

SAMPLE = Path(__file__).resolve().parents[2] / "sample_tiles"
MS, PAN = SAMPLE / "ms.tif", SAMPLE / "pan.tif"


def questions(ms: Path, pan: Path, **options: object) -> list[str]:
    found = geodelreg.align(ms, pan, geodelreg.AlignOptions(**options))  # type: ignore[arg-type]
    return [warning for warning in found.warnings if "?" in warning]


def test_the_right_way_round_nothing_is_asked() -> None:
    assert questions(MS, PAN) == []


def test_swapped_rasters_are_asked_about() -> None:
    (question,) = questions(PAN, MS)
    assert "swapped?" in question
    assert "4 bands" in question or "PAN 4" in question


def test_a_reference_of_many_bands_is_asked_about_unless_one_was_named() -> None:
    (question,) = questions(MS, MS)
    assert "`pan_band=N`" in question
    assert questions(MS, MS, pan_band=2) == []


def test_a_wrong_zone_is_asked_about_with_the_distance(tmp_path: Path) -> None:
    ms = tmp_path / "ms.tif"
    shutil.copy(MS, ms)
    with rasterio.open(ms, "r+") as raster:
        assert raster.crs.to_epsg() == 32618
        raster.crs = "EPSG:32619"
    (question,) = questions(ms, PAN)
    assert "UTM zone" in question
    assert "529 km" in question
