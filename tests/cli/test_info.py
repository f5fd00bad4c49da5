"""``geodelreg info``, and what ``align`` says of its inputs, its outputs and its way."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import rasterio
from rasterio.warp import transform_bounds

from tests.cli.helpers import Command, write_noise


def test_info_says_what_rasterio_says(geodelreg: Command, pair: Path) -> None:
    done = geodelreg("info", "ms.tif", "pan.tif", "--json", cwd=pair)
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert [item["path"] for item in found] == ["ms.tif", "pan.tif"]
    with rasterio.open(pair / "ms.tif") as ms:
        assert found[0]["geotransform"] == list(ms.transform.to_gdal())
        assert (found[0]["width"], found[0]["height"]) == (ms.width, ms.height)
        assert [band["dtype"] for band in found[0]["bands"]] == list(ms.dtypes)
        assert found[0]["crs"]["code"] == ms.crs.to_string()
        assert found[0]["gsd_m"] == [ms.transform.a, -ms.transform.e]
        bounds = transform_bounds(ms.crs, "EPSG:4326", *ms.bounds, densify_pts=21)
    ring = found[0]["footprint"]["coordinates"][0]
    west, east = (pick(x for x, _ in ring) for pick in (min, max))
    south, north = (pick(y for _, y in ring) for pick in (min, max))
    assert (west, south, east, north) == pytest.approx(bounds, abs=1e-5)
    assert found[0]["provenance"] == {}


def test_info_of_a_corrected_raster_tells_where_it_is_from(geodelreg: Command, pair: Path) -> None:
    assert geodelreg("align", "ms.tif", "pan.tif", "-o", "out.tif", cwd=pair).returncode == 0
    done = geodelreg("info", "out.tif", cwd=pair)
    assert "out.tif: GTiff, 100 × 100 pixels, 4 bands" in done.stdout
    assert "CRS: WGS 84 / UTM zone 18N (EPSG:32618)" in done.stdout
    assert "verdict: aligned" in done.stdout
    assert "pan: pan.tif" in done.stdout


def test_info_names_quality_bands_and_hides_no_mark(geodelreg: Command, pair: Path) -> None:
    with rasterio.open(pair / "ms.tif", "r+") as dataset:
        dataset.descriptions = ("red \u202eevil", "green", "nir", "QA_PIXEL")
    done = geodelreg("info", "ms.tif", cwd=pair)
    assert "quality band (landsat-qa), a mask of the others" in done.stdout
    assert "red \\u202eevil" in done.stdout
    as_json = geodelreg("info", "ms.tif", "--json", cwd=pair)
    assert "\u202e" not in done.stdout + as_json.stdout
    assert json.loads(as_json.stdout)["bands"][0]["name"] == "red \u202eevil"


def test_info_of_what_cannot_be_aligned_is_the_error_of_align(
    geodelreg: Command, pair: Path
) -> None:
    (pair / "text.tif").write_text("no raster")
    said = geodelreg("info", "text.tif", cwd=pair)
    assert said.returncode == 1
    aligned = geodelreg("align", "text.tif", "pan.tif", "--dry-run", cwd=pair)
    assert said.stderr == aligned.stderr


def test_align_names_what_it_read_and_wrote(geodelreg: Command, pair: Path) -> None:
    done = geodelreg(
        "align", "ms.tif", "pan.tif", "-o", "out.tif", "--gcps", "out.points", cwd=pair
    )
    lines = done.stderr.splitlines()
    assert lines[0] == "MS ms.tif, PAN pan.tif"
    assert lines[-1] == "Written: out.tif, out.points"
    dry = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", cwd=pair)
    assert dry.stderr.splitlines()[-1] == "Written: nothing (dry run)"


def test_verbose_tells_the_story_of_a_refusal(geodelreg: Command, pair: Path) -> None:
    done = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", "-v", "--max-shift", "3", cwd=pair)
    assert done.returncode == 3
    with rasterio.open(pair / "ms.tif") as ms:
        assert f"MS: ms.tif, {ms.width} × {ms.height} pixels" in done.stderr
    assert "geodelreg: guess from header overlap: " in done.stderr
    assert "PAN px shift (needs ≤ 3)" in done.stderr.partition("geodelreg: not believed: ")[2]
    assert "geodelreg: seconds: " in done.stderr
    assert "geodelreg: versions: geodelreg " in done.stderr


def test_verbose_of_noise_tells_what_was_looked_for(geodelreg: Command, pair: Path) -> None:
    write_noise(pair / "noise.tif", like=pair / "pan.tif", seed=1)
    done = geodelreg("align", "ms.tif", "noise.tif", "--dry-run", "-v", cwd=pair)
    assert done.returncode == 3
    assert "geodelreg: reading, " in done.stderr
