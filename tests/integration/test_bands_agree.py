"""Bands are held against each other, whether they look like PAN or not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

import geodelreg
from benchmarks.scenes.imagery import sample_imagery
from benchmarks.scenes.make import HeaderError, SceneSpec, make_scene, write_scene
from geodelreg import AlignOptions
from geodelreg.errors import AlignmentRefusedError, BandNumberError, UsageError

SPEC = SceneSpec("agree", "", HeaderError((2.3, -1.7)), (560, 560), (126, 126), ratio=4.0)
STILL = (0.0, 0.0)


def made(folder: Path, infrared: tuple[float, float]) -> tuple[Path, Path]:
    """MS whose infrared, which PAN does not hold, lies elsewhere by so many PAN pixels."""
    scene = make_scene(SPEC, sample_imagery(), band_shifts=(STILL, STILL, STILL, infrared))
    write_scene(scene, folder)
    return folder / "ms.tif", folder / "pan.tif"


def warned(alignment: geodelreg.Alignment) -> bool:
    return any("bands do not agree" in warning for warning in alignment.warnings)


@pytest.mark.parametrize("inverted", [False, True])
def test_a_band_is_held_against_the_others_whatever_it_looks_like(
    inverted: bool, tmp_path: Path
) -> None:
    ms, pan = made(tmp_path, (-1.2, -1.6))
    if inverted:
        with rasterio.open(ms, "r+") as dataset:
            infrared = dataset.read(4).astype(np.int32)
            dataset.write((infrared.max() + 100 - infrared).astype(np.uint16), 4)
    for named in ((), (2, 4)):  # PAN holds nothing of band 4
        with pytest.raises(
            AlignmentRefusedError, match=r"band 4 lies 1\.\d px right and 1\.\d px down"
        ):
            geodelreg.align(ms, pan, agreeing_bands=named)
    assert not warned(geodelreg.align(ms, pan, agreeing_bands=(1, 2)))
    one = geodelreg.check(ms, pan, agreeing_bands=(2, 4))
    assert one.outcome.value == "cannot_tell"
    assert one.remedy == one.alignment.verdict.remedy
    assert "`per_band=True`" in one.remedy


def test_between_half_a_pixel_and_one_the_bands_are_named_in_a_warning(tmp_path: Path) -> None:
    ms, pan = made(tmp_path, (0.9, 0.0))
    alignment = geodelreg.align(ms, pan, agreeing_bands=[2, 4])
    (text,) = (warning for warning in alignment.warnings if "bands do not agree" in warning)
    assert "band 4 lies" in text
    assert "of band 2" in text
    assert "not right for both: `per_band=True`" in text
    alignment = geodelreg.align(ms, pan, per_band=True)
    (text,) = (warning for warning in alignment.warnings if "bands do not agree" in warning)
    assert text.endswith("; `per_band=True` finds a place for each")


def test_a_band_that_only_looks_unlike_pan_is_not_apart(tmp_path: Path) -> None:
    ms, pan = made(tmp_path, STILL)
    assert not warned(geodelreg.align(ms, pan))


def test_a_band_that_need_not_agree_may_lie_anywhere(tmp_path: Path) -> None:
    scene = make_scene(SPEC, sample_imagery(), band_shifts=((8.0, 0.0), STILL, STILL, STILL))
    write_scene(scene, tmp_path)
    pair = tmp_path / "ms.tif", tmp_path / "pan.tif"
    with pytest.raises(AlignmentRefusedError, match="band 1 lies 8"):
        geodelreg.align(*pair)
    alignment = geodelreg.align(*pair, agreeing_bands=(2, 3, 4))
    assert not warned(alignment)
    (said,) = (warning for warning in alignment.warnings if "lie elsewhere" in warning)
    assert said.startswith("only bands 2, 3, 4 of MS were asked")
    assert "moves 1 more" in said


def test_bands_that_move_with_the_one_that_was_matched_are_told_of(tmp_path: Path) -> None:
    scene = make_scene(SPEC, sample_imagery(), band_shifts=((8.0, 0.0), STILL, STILL, STILL))
    write_scene(scene, tmp_path)
    pair = tmp_path / "ms.tif", tmp_path / "pan.tif"
    for found in (geodelreg.align(*pair, band=2), geodelreg.check(*pair, band=2).alignment):
        (said,) = found.to_dict()["warnings"]
        assert said.startswith("only band 2 of MS was matched on; the correction moves 3 more")
        assert "(without `band` " in said
    with rasterio.open(pair[0]) as dataset:
        second, profile = dataset.read(2), dataset.profile | {"count": 1}
    with rasterio.open(tmp_path / "one.tif", "w", **profile) as dataset:
        dataset.write(second, 1)
    assert geodelreg.align(tmp_path / "one.tif", pair[1], band=1).warnings == ()


def test_bands_to_agree_exist_and_are_more_than_one() -> None:
    with pytest.raises(UsageError, match="one band"):
        AlignOptions(agreeing_bands=(3,))
    with pytest.raises(UsageError, match="are no bands"):
        AlignOptions(agreeing_bands=(0, 1))
    with pytest.raises(UsageError, match="ask for another"):
        AlignOptions(agreeing_bands=(1, 2), band=1)
    samples = Path(__file__).parents[2] / "sample_tiles"
    with pytest.raises(BandNumberError):
        geodelreg.align(samples / "ms.tif", samples / "pan.tif", agreeing_bands=(1, 9))
