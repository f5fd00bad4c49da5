"""Names of masks, and what the values of quality bands mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geodelreg.errors import UsageError
from geodelreg.masking import (
    MaskSpec,
    flag_bands,
    is_old_landsat,
    parse_mask,
    quality_bands,
    quality_kind,
)
from geodelreg.options import AlignOptions
from geodelreg.raster.quality import hidden_values, impossible_values

# USGS, Landsat 8-9 Collection 2 Level 2 Science Product Guide (LSDS-1619), table 6-3, and for
# Landsat 4-7 (LSDS-1618), table 5-3: value, and whether ground is seen
COLLECTION_2 = {
    1: False,  # fill
    21824: True,  # clear
    21826: False,  # dilated cloud over land
    21888: True,  # water
    21890: False,  # dilated cloud over water
    22080: False,  # mid confidence cloud
    22144: False,  # ... over water
    22280: False,  # high confidence cloud
    23888: False,  # cloud shadow
    23952: False,  # ... over water
    24088: False,  # mid confidence cloud with shadow
    24216: False,
    24344: False,
    24472: False,
    30048: True,  # snow
    54596: False,  # cirrus
    54852: False,
    55052: False,
    56856: False,
    56984: False,
    57240: False,
    5440: True,  # Landsat 4-7: clear
    5442: False,  # dilated cloud
    5504: True,  # water
    5896: False,  # high confidence cloud
    7440: False,  # cloud shadow
    13664: True,  # snow
    256: True,  # MSS: clear
    776: False,  # cloud
}
# clear, cloud, cirrus, shadow and snow in BQA of Landsat 8, clear and cloud in that of Landsat 4-7
COLLECTION_1 = [2720, 2800, 6816, 2976, 3744, 672, 752]
PIXEL_QA = [322, 324, 328, 336, 352, 66, 68, 72, 96, 224]


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("clouds.tif", MaskSpec("clouds.tif")),
        ("clouds.tif=binary", MaskSpec("clouds.tif", "binary")),
        ("clouds.tif=auto", MaskSpec("clouds.tif")),
        ("qa.tif=landsat-qa", MaskSpec("qa.tif", "landsat-qa")),
        ("scl.jp2=sentinel2-scl", MaskSpec("scl.jp2", "sentinel2-scl")),
        ("c.tif=0", MaskSpec("c.tif", "values", ((0, 0),))),
        ("c.tif=3,8-10", MaskSpec("c.tif", "values", ((3, 3), (8, 10)))),
        ("c.tif=-9999,0-0", MaskSpec("c.tif", "values", ((-9999, -9999), (0, 0)))),
        ("C:/day=3/c.tif=255", MaskSpec("C:/day=3/c.tif", "values", ((255, 255),))),
        ("/vsicurl/https://host/c.tif?key=7=auto", MaskSpec("/vsicurl/https://host/c.tif?key=7")),
        ("day=3/c.tif", MaskSpec("day=3/c.tif")),
        ("c.tif=clouds", MaskSpec("c.tif=clouds")),
        ("c.tif=3,", MaskSpec("c.tif=3,")),
        ("=3", MaskSpec("=3")),
    ],
)
def test_names_are_taken_apart(text: str, spec: MaskSpec) -> None:
    assert parse_mask(text) == spec


def test_a_backward_range_is_wrong_usage() -> None:
    with pytest.raises(UsageError, match="asks for the values 9-3"):
        parse_mask("c.tif=1,9-3")
    with pytest.raises(UsageError, match="9-3"):
        AlignOptions(masks=("c.tif=9-3",))


def test_options_take_paths_and_no_single_name() -> None:
    made = AlignOptions(masks=(Path("a.tif"), "b.tif=3"), pan_masks=[Path("c.tif")])  # type: ignore[arg-type]
    assert made.masks == ("a.tif", "b.tif=3")
    assert made.pan_masks == ("c.tif",)
    with pytest.raises(UsageError, match=r"`masks='a\.tif'` is one name"):
        AlignOptions(masks="a.tif")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="pan_masks"):
        AlignOptions(pan_masks=Path("a.tif"))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("LC08_L2SP_016035_20210608_20210615_02_T1_QA_PIXEL", "landsat-qa"),
        ("QA_PIXEL", "landsat-qa"),
        ("qa_pixel", "landsat-qa"),
        ("scene_QA_PIXEL_clip", "landsat-qa"),
        ("T18SUF_20210608T155819_SCL_20m", "sentinel2-scl"),
        ("SCL", "sentinel2-scl"),
        ("LC08_..._QA_RADSAT", None),
        ("LC08_..._BQA", None),
        ("LC08_..._pixel_qa", None),
        ("MUSCLE", None),
        ("SCL2", None),
        ("clouds", None),
    ],
)
def test_quality_bands_are_known_by_name(name: str, kind: str | None) -> None:
    assert quality_kind(name) == kind
    assert is_old_landsat(name) == name.lower().endswith(("_bqa", "_pixel_qa"))


def test_in_a_raster_descriptions_tell_and_of_one_band_the_file_name() -> None:
    assert quality_bands("x.tif", ("B2", None, "QA_PIXEL", "SCL")) == {
        3: "landsat-qa",
        4: "sentinel2-scl",
    }
    assert quality_bands("a/SCL.tif", (None,)) == {1: "sentinel2-scl"}
    assert quality_bands("a/SCL.tif", ("QA_PIXEL",)) == {1: "landsat-qa"}
    assert quality_bands("SCL/b.tif", (None,)) == {}
    assert quality_bands("a/SCL.tif", (None, None)) == {}


def test_bands_of_flags_are_also_those_that_make_no_masks() -> None:
    names = ("B2", None, "QA_PIXEL", "SCL", "QA_RADSAT", "pixel_qa", "SR_QA_AEROSOL", "ST_QA")
    assert flag_bands("LC08_BQA.tif", names) == (3, 4, 5, 6, 7)
    assert flag_bands("a/LC08_BQA.tif", (None,)) == (1,)
    assert flag_bands("a/LC08_BQA.tif", ("x",)) == (1,)
    assert flag_bands("QA60/B2.tif", ("x",)) == ()


@pytest.mark.parametrize("dtype", ["uint16", "int32", "float32"])
def test_landsat_hides_what_is_not_ground(dtype: str) -> None:
    raw = np.array([list(COLLECTION_2)]).astype(dtype)
    seen = [
        ground or value in (22080, 22144)  # no flag but medium confidence: USGS calls it clear
        for value, ground in COLLECTION_2.items()
    ]
    assert (~hidden_values(raw, "landsat-qa")[0]).tolist() == seen
    assert not impossible_values(raw, "landsat-qa").any()


def test_landsat_zero_is_nothing_seen() -> None:
    zero = np.zeros((1, 1), dtype=np.uint16)
    assert hidden_values(zero, "landsat-qa").all()
    assert not impossible_values(zero, "landsat-qa").any()


@pytest.mark.parametrize("values", [COLLECTION_1, PIXEL_QA], ids=["BQA", "pixel_qa"])
def test_older_landsat_bands_are_seen_through(values: list[int]) -> None:
    bad = impossible_values(np.array([values], dtype=np.uint16), "landsat-qa")[0]
    assert dict(zip(values, bad.tolist(), strict=True)) == dict.fromkeys(values, True)


@pytest.mark.parametrize("value", [-1.0, 70_000.0, 21824.5, np.inf])
def test_what_fits_no_quality_band_is_impossible(value: float) -> None:
    for kind in ("landsat-qa", "sentinel2-scl"):
        assert impossible_values(np.array([[value]]), kind).all()


def test_scl_hides_clouds_shadows_and_what_was_not_seen() -> None:
    raw = np.arange(14, dtype=np.uint8)[None]
    assert np.flatnonzero(hidden_values(raw, "sentinel2-scl")).tolist() == [0, 1, 3, 8, 9, 10]
    assert np.flatnonzero(impossible_values(raw, "sentinel2-scl")).tolist() == [12, 13]
    assert not impossible_values(np.full((1, 1), 255, np.uint8), "sentinel2-scl", 255.0).any()
    assert hidden_values(np.full((1, 1), 255, np.uint8), "sentinel2-scl", nodata=255.0).all()


def test_binary_uses_zero_no_data_and_nan() -> None:
    raw = np.array([[0, 1, 255, -3]], dtype=np.int16)
    assert hidden_values(raw, "binary").tolist() == [[False, True, True, True]]
    assert hidden_values(raw, "binary", nodata=255).tolist() == [[False, True, False, True]]
    assert hidden_values(np.array([[np.nan, 0.5, 0.0]]), "binary").tolist() == [
        [False, True, False]
    ]


def test_listed_values_hide_even_when_they_are_no_data() -> None:
    raw = np.arange(12, dtype=np.uint8)[None]
    hidden = hidden_values(raw, "values", ((3, 3), (8, 10)), nodata=3)
    assert np.flatnonzero(hidden).tolist() == [3, 8, 9, 10]
