"""What looks as if something else had been meant is asked, and done unless it is beyond doubt."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio

import geodelreg
from geodelreg.errors import AlignmentRefusedError, UsageError
from geodelreg.values.result import CheckOutcome

SAMPLE = Path(__file__).resolve().parents[2] / "sample_tiles"
MS, PAN = SAMPLE / "ms.tif", SAMPLE / "pan.tif"


def questions(ms: Path, pan: Path, **options: object) -> list[str]:
    found = geodelreg.align(ms, pan, geodelreg.AlignOptions(**options))  # type: ignore[arg-type]
    return [warning for warning in found.warnings if "?" in warning]


def test_the_right_way_round_nothing_is_asked() -> None:
    assert questions(MS, PAN) == []


def test_rasters_in_the_wrong_order_are_refused_unless_it_is_said_that_they_are_not() -> None:
    for ask in (geodelreg.align, geodelreg.check):
        with pytest.raises(UsageError, match=r"MS and PAN are swapped.*: ms\.tif pan\.tif\."):
            ask(PAN, MS)
    meant = geodelreg.align(PAN, MS, band=1)
    assert meant.correction.corrected != meant.correction.original
    assert not any("swapped" in warning for warning in meant.warnings)
    assert geodelreg.check(PAN, MS, pan_band=2).outcome is CheckOutcome.MISALIGNED


def test_pixels_a_little_smaller_than_those_of_many_bands_are_asked_about(tmp_path: Path) -> None:
    reference = tmp_path / "reference.tif"
    with rasterio.open(PAN) as raster:
        shape, finer = raster.shape, raster.transform
        wider = finer @ rasterio.Affine.scale(1.25)
        data = raster.read(1, out_shape=tuple(int(side / 1.25) for side in shape))
        profile = raster.profile | {"transform": wider, "count": 3}
    height, width = data.shape
    with rasterio.open(reference, "w", **profile | {"height": height, "width": width}) as out:
        out.write(np.stack([data] * 3))
    assert any("swapped?" in question for question in questions(PAN, reference))


@pytest.mark.parametrize("px", [5, 40])
def test_a_side_that_lies_too_far_off_to_be_found_is_told_of(px: int, tmp_path: Path) -> None:
    with rasterio.open(MS) as raster:
        image, profile = raster.read(), raster.profile
    half = image.shape[1] // 2
    image[:, half:] = np.roll(image, px, axis=2)[:, half:]
    with rasterio.open(tmp_path / "torn.tif", "w", **profile) as out:
        out.write(image)
    try:
        told = "; ".join(geodelreg.align(tmp_path / "torn.tif", PAN).warnings)
    except AlignmentRefusedError as refusal:
        told = refusal.cause
    assert re.search(
        r"\d+ of \d+ patches that show something match nothing near .*: the (upp|low)er", told
    )


def test_a_reference_of_many_bands_is_asked_about_unless_one_was_named() -> None:
    (question,) = questions(MS, MS)
    assert "`pan_band=N`" in question
    assert questions(MS, MS, pan_band=2) == []


def test_one_file_in_both_places_proves_nothing() -> None:
    (said,) = geodelreg.align(PAN, PAN).warnings
    assert "the same file" in said


def test_of_a_reference_of_many_bands_the_one_most_like_the_others_is_taken(tmp_path: Path) -> None:
    pan = tmp_path / "pan.tif"
    with rasterio.open(PAN) as raster:
        image, profile = raster.read(1), raster.profile
    noise = np.random.default_rng(0).normal(0, image.std(), (3, *image.shape))
    layers = [noise[0] + image.mean(), image + noise[1] / 4, image, image + noise[2] / 4]
    with rasterio.open(pan, "w", **profile | {"count": 4}) as out:
        out.write(np.clip(np.stack(layers), 0, 65535).astype(profile["dtype"]))
    alignment = geodelreg.align(MS, pan, pan_band=0)
    (said,) = (note for note in alignment.warnings if "PAN has" in note)
    assert "band 3" in said
    assert alignment.options.pan_band == 3
    alone = geodelreg.align(MS, PAN, pan_band=0)
    assert alone.options.pan_band == 1
    assert not any("PAN has" in note for note in alone.warnings)


def test_the_first_band_is_not_asked_about_when_it_was_chosen(tmp_path: Path) -> None:
    pan = tmp_path / "pan.tif"
    with rasterio.open(PAN) as raster:
        image, profile = raster.read(1), raster.profile
    with rasterio.open(pan, "w", **profile | {"count": 2}) as out:
        out.write(np.stack([image, image]))
    (said,) = (n for n in geodelreg.align(MS, pan, pan_band=0).warnings if "PAN has" in n)
    assert "band 1" in said
    assert "?" not in said


def test_a_wrong_zone_is_asked_about_with_the_distance(tmp_path: Path) -> None:
    ms = tmp_path / "ms.tif"
    shutil.copy(MS, ms)
    with rasterio.open(ms, "r+") as raster:
        assert raster.crs.to_epsg() == 32618
        raster.crs = "EPSG:32619"
    (question,) = questions(ms, PAN)
    assert "UTM zone" in question
    assert "529 km" in question
