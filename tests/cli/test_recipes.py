"""The recipes of docs/recipes.md, run as they stand there."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

import geodelreg
from tests.cli.helpers import SAMPLES

PAGE = Path(__file__).resolve().parents[2] / "docs" / "recipes.md"
PYTHON = shlex.quote(sys.executable)
PRELUDE = f"""set -e
geodelreg() {{ {PYTHON} -m geodelreg_cli "$@"; }}
rio() {{ {PYTHON} -c 'from rasterio.rio.main import main_group; main_group()' "$@"; }}
"""


def run_recipe(title: str, folder: Path) -> None:
    text = PAGE.read_text(encoding="utf-8").partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    blocks = re.findall(r"^```(sh|python)\n(.*?)^```", text, re.M | re.S)
    assert blocks
    for language, block in blocks:
        command = ["bash", "-c", PRELUDE + block]
        if language == "python":
            command = [sys.executable, "-W", "ignore", "-c", block]
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=300, env=os.environ
        )
        assert done.returncode == 0, done.stderr


def write_as(path: Path, model: str, data: NDArray[Any], **profile: Any) -> None:
    """Pixels on the grid of a sample."""
    with rasterio.open(SAMPLES / model) as dataset:
        kept = {name: dataset.profile[name] for name in ("crs", "transform", "width", "height")}
    shape = {"driver": "GTiff", "count": len(data), "dtype": data.dtype}
    with rasterio.open(path, "w", **(kept | shape | profile)) as dataset:
        dataset.write(data)


def pixels(name: str) -> NDArray[Any]:
    with rasterio.open(SAMPLES / name) as dataset:
        return np.asarray(dataset.read())


def is_aligned(ms: Path, pan: Path, pan_band: int = 1) -> bool:
    return geodelreg.check(ms, pan, pan_band=pan_band).outcome.value == "aligned"


def test_every_recipe_is_tested() -> None:
    titles = re.findall(r"^## (.*)$", PAGE.read_text(encoding="utf-8"), re.M)
    tests = Path(__file__).read_text(encoding="utf-8")
    assert all(f'run_recipe("{title}"' in tests for title in titles)


def test_landsat(tmp_path: Path) -> None:
    scene = tmp_path / "LC09_L1TP_014034_20240612_20240612_02_T1"
    for number, band in enumerate(pixels("ms.tif")[:3], start=2):
        write_as(Path(f"{scene}_B{number}.TIF"), "ms.tif", band[None])
    write_as(Path(f"{scene}_B8.TIF"), "pan.tif", pixels("pan.tif"))
    clear = np.full((1, 200, 200), 21824, dtype=np.uint16)
    clear[:, :40] = 22280
    write_as(Path(f"{scene}_QA_PIXEL.TIF"), "ms.tif", clear)
    run_recipe("Landsat 8 and 9", tmp_path)
    with rasterio.open(tmp_path / "sharp.tif") as dataset:
        assert (dataset.count, dataset.shape) == (3, (800, 800))
        assert "landsat-qa" in dataset.tags()["GEODELREG_MASKS"]
    assert is_aligned(tmp_path / "sharp.tif", SAMPLES / "pan.tif")


def test_sentinel2(tmp_path: Path) -> None:
    pan = pixels("pan.tif")
    write_as(tmp_path / "bands_20m.tif", "ms.tif", pixels("ms.tif"))
    write_as(tmp_path / "bands_10m.tif", "pan.tif", np.concatenate([pan * 0 + 7] * 3 + [pan]))
    run_recipe("Sentinel-2, 20 m on 10 m", tmp_path)
    assert is_aligned(tmp_path / "bands_20m_aligned.tif", tmp_path / "bands_10m.tif", 4)
    with rasterio.open(tmp_path / "bands_20m_sharp.tif") as dataset:
        assert (dataset.count, dataset.shape) == (4, (800, 800))


def test_worldview(tmp_path: Path) -> None:
    write_as(tmp_path / "ms.tif", "ms.tif", pixels("ms.tif") // 2)
    write_as(tmp_path / "pan.tif", "pan.tif", pixels("pan.tif") // 2)
    run_recipe("WorldView", tmp_path)
    with rasterio.open(tmp_path / "sharp.tif") as dataset:
        assert dataset.read().max() <= 2047


def test_undeclared_no_data(tmp_path: Path) -> None:
    framed = pixels("ms.tif")
    framed[:, :, :50] = 0
    write_as(tmp_path / "framed.tif", "ms.tif", framed)
    write_as(tmp_path / "pan.tif", "pan.tif", pixels("pan.tif"))
    run_recipe("No-data that is not declared", tmp_path)
    with rasterio.open(tmp_path / "sharp.tif") as dataset:
        assert dataset.nodata == 0
        assert 0.2 < (dataset.read(1) == 0).mean() < 0.3


def test_control_points(pair: Path) -> None:
    run_recipe("A warp through control points", pair)
    with rasterio.open(pair / "spline.tif") as spline, rasterio.open(pair / "pan.tif") as pan:
        assert spline.transform == pan.transform
    assert is_aligned(pair / "spline.tif", pair / "pan.tif")


def test_xarray(pair: Path) -> None:
    run_recipe("xarray", pair)
    assert is_aligned(pair / "aligned.tif", pair / "pan.tif")
    assert (pair / "tie_points.gpkg").exists()


@pytest.mark.parametrize(("blank", "outcome"), [(False, "aligned"), (True, "not aligned")])
def test_script(pair: Path, blank: bool, outcome: str) -> None:
    if blank:
        noise = np.random.default_rng(1).integers(1, 4000, (4, 200, 200)).astype(np.uint16)
        write_as(pair / "ms.tif", "ms.tif", noise)
    run_recipe("A shell script", pair)
    assert (pair / "outcome.txt").read_text().strip() == outcome
    with rasterio.open(pair / "onto_pan.tif") as dataset:
        assert dataset.shape == (800, 800)
