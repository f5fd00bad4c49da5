"""``--mask`` and ``--pan-mask`` on the command line: exit codes, streams, files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio
from affine import Affine

from geodelreg.product.report import report_schema
from tests.cli.helpers import Command, snapshot


def write_mask(folder: Path, name: str, like: str, share: float, hide: int = 1) -> Path:
    """A mask that hides the upper part of an image."""
    with rasterio.open(folder / like) as image:
        profile = image.profile | {"count": 1, "dtype": np.uint16, "nodata": None}
    values = np.zeros((profile["height"], profile["width"]), dtype=np.uint16)
    values[: round(share * len(values))] = hide
    with rasterio.open(folder / name, "w", **profile) as mask:
        mask.write(values, 1)
    return folder / name


def test_masks_are_used_reported_and_said(geodelreg: Command, pair: Path) -> None:
    write_mask(pair, "clouds.tif", "ms.tif", 0.25)
    write_mask(pair, "classes.tif", "pan.tif", 0.1, hide=9)
    done = geodelreg(
        *("align", "ms.tif", "pan.tif", "-o", "out.tif", "--report", "out.json", "-v"),
        *("--mask", "clouds.tif", "--pan-mask", "classes.tif=8-10"),
        cwd=pair,
    )
    assert done.returncode == 0, done.stderr
    assert "Masks hide: clouds.tif (binary) 2" in done.stderr
    assert "classes.tif (values) " in done.stderr
    assert "mask clouds.tif, read as binary, hides 2" in done.stderr
    report = json.loads((pair / "out.json").read_text(encoding="utf-8"))
    jsonschema.validate(report, report_schema())
    assert [use["image"] for use in report["masks"]] == ["source", "reference"]
    assert report["options"]["masks"] == ["clouds.tif"]
    assert report["options"]["pan_masks"] == ["classes.tif=8-10"]
    with rasterio.open(pair / "ms.tif") as ms, rasterio.open(pair / "out.tif") as out:
        assert np.array_equal(ms.read(), out.read())
        assert out.tags()["GEODELREG_MASKS"] == "clouds.tif (binary); classes.tif (values)"


def test_check_takes_masks_too(geodelreg: Command, pair: Path) -> None:
    write_mask(pair, "clouds.tif", "ms.tif", 0.25)
    done = geodelreg(
        *("check", "ms.tif", "pan.tif", "--mask", "clouds.tif", "--mask", "clouds.tif=7"), cwd=pair
    )
    assert done.returncode == 4, done.stderr
    assert "clouds.tif (binary) 2" in done.stdout
    assert "clouds.tif (values) 0.0 % of MS" in done.stdout


def test_a_partial_mask_is_a_warning(geodelreg: Command, pair: Path) -> None:
    path = write_mask(pair, "part.tif", "ms.tif", 0.0)
    with rasterio.open(path, "r+") as mask:
        mask.transform = mask.transform @ Affine.translation(mask.width / 2, 0)
    done = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", "--mask", "part.tif", cwd=pair)
    assert done.returncode == 0, done.stderr
    assert "the mask part.tif covers 50 % of ms.tif" in done.stderr


FAILURES = {
    "missing": ("no.tif", "the mask no.tif does not exist"),
    "no mask": ("text.tif", "the mask text.tif is not a raster"),
    "vector": ("text.geojson", "the mask text.geojson is not GeoJSON"),
    "many bands": ("ms.tif", "the mask ms.tif has 4 bands"),
    "Collection 1": ("LC08_BQA.tif", "before Collection 2"),
    "nothing left": ("all.tif", "masks hide 100 % by all.tif (binary)"),
}


@pytest.mark.parametrize(("mask", "message"), FAILURES.values(), ids=FAILURES.keys())
@pytest.mark.parametrize("option", ["--mask", "--pan-mask"])
def test_masks_that_cannot_be_used_are_exit_1_and_touch_nothing(
    geodelreg: Command, pair: Path, option: str, mask: str, message: str
) -> None:
    for name in ("text.tif", "text.geojson"):
        (pair / name).write_text("neither")
    like = "ms.tif" if option == "--mask" else "pan.tif"
    write_mask(pair, "LC08_BQA.tif", like, 1.0, hide=2720)
    write_mask(pair, "all.tif", like, 1.0)
    before = snapshot(pair)
    done = geodelreg("align", "ms.tif", "pan.tif", "-o", "out.tif", option, mask, cwd=pair)
    assert done.returncode == 1
    assert done.stderr.startswith("geodelreg: error: ")
    assert message in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert snapshot(pair) == before


def test_a_backward_range_is_exit_2(geodelreg: Command, pair: Path) -> None:
    done = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", "--mask", "c.tif=9-3", cwd=pair)
    assert done.returncode == 2
    assert "asks for the values 9-3" in done.stderr


def test_a_mask_is_never_overwritten(geodelreg: Command, pair: Path) -> None:
    write_mask(pair, "clouds.tif", "ms.tif", 0.25)
    before = snapshot(pair)
    done = geodelreg(
        *("align", "ms.tif", "pan.tif", "-o", "clouds.tif", "--overwrite"),
        *("--mask", "clouds.tif=1"),
        cwd=pair,
    )
    assert done.returncode == 2
    assert "clouds.tif" in done.stderr
    assert snapshot(pair) == before


def test_rios_plugin_takes_masks(pair: Path) -> None:
    write_mask(pair, "clouds.tif", "ms.tif", 0.25)
    rio = [sys.executable, "-c", "from rasterio.rio.main import main_group; main_group()"]
    done = subprocess.run(
        [*rio, "geodelreg-align", "ms.tif", "pan.tif", "--dry-run", "--mask", "clouds.tif"],
        capture_output=True,
        text=True,
        cwd=pair,
    )
    assert done.returncode == 0, done.stderr
    assert "clouds.tif (binary)" in done.stderr


def test_without_masks_nothing_of_them_is_loaded(pair: Path) -> None:
    code = (
        "import sys, geodelreg; geodelreg.check('ms.tif', 'pan.tif');"
        "print([m for m in sys.modules if '.raster.mask_' in m or m == 'geodelreg.raster.masks'],"
        " 'pyogrio' in sys.modules, 'rasterio.features' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=pair)
    assert done.stdout.strip() == "['geodelreg.raster.mask_report'] False False", done.stderr
