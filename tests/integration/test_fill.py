"""Fill that no file declares is left out, told, and never aligned on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window as RasterioWindow

import geodelreg
from benchmarks.gate.distortions import zero_fill
from benchmarks.scenes.imagery import sample_imagery
from benchmarks.scenes.make import HeaderError, Scene, SceneSpec, make_scene, write_scene
from benchmarks.scenes.truth import check_points
from geodelreg import AlignOptions
from geodelreg.raster.reader import open_raster

SPEC = SceneSpec("filled", "", HeaderError((5.3, -4.7)), (500, 500), (230, 230), ratio=2.0)


def filled(folder: Path, value: int = 0) -> Scene:
    scene = make_scene(SPEC, sample_imagery())
    images = scene.ms.copy(), scene.pan.copy()
    zero_fill(images, 0.35, np.random.default_rng(1))
    ms, pan = (np.where(image == 0, value, image).astype(np.uint16) for image in images)
    scene = replace(scene, ms=ms, pan=pan)
    write_scene(scene, folder)
    return scene


def off_px(alignment: geodelreg.Alignment, scene: Scene) -> float:
    spots = check_points(scene.truth.ms_shape)
    pan = ~rasterio.Affine(*scene.truth.pan)
    found, true = pan @ alignment.correction.corrected, pan @ rasterio.Affine(*scene.truth.ms_true)
    apart = np.array([np.subtract(found @ (x, y), true @ (x, y)) for x, y in spots.tolist()])
    return float(np.abs(apart).max())


@pytest.mark.parametrize("value", [0, 65535])
def test_fill_is_found_left_out_and_told(value: int, tmp_path: Path) -> None:
    scene = filled(tmp_path, value)
    alignment = geodelreg.align(tmp_path / "ms.tif", tmp_path / "pan.tif")
    assert off_px(alignment, scene) < 0.05
    for name in ("ms.tif", "pan.tif"):
        assert any(f"{name} is filled with {value}" in note for note in alignment.warnings)
    inside = alignment.tie_points.reference_px[alignment.tie_points.kept]
    assert (scene.pan[tuple(inside[:, ::-1].astype(int).T)] != value).all()


def test_a_value_that_is_told_is_taken_without_a_word(tmp_path: Path) -> None:
    scene = filled(tmp_path, 7)
    options = AlignOptions(ms_nodata=7, pan_nodata=7)
    alignment = geodelreg.align(tmp_path / "ms.tif", tmp_path / "pan.tif", options)
    assert off_px(alignment, scene) < 0.05
    assert not any("filled" in note for note in alignment.warnings)


def write(path: Path, data: np.ndarray, **tags: object) -> Path:
    bands, height, width = data.shape
    with rasterio.open(
        path, "w", driver="GTiff", count=bands, height=height, width=width, dtype=data.dtype, **tags
    ) as out:
        out.write(data)
    return path


@pytest.mark.parametrize(
    ("corner", "fill", "expected"),
    [
        ("none", 0, None),
        ("one band", 0, None),
        ("left", 0, 0.0),
        ("left", 255, 255.0),
        ("left", 9, None),
        ("everywhere", 0, None),
    ],
)
def test_fill_is_a_constant_corner_of_all_bands(
    corner: str, fill: int, expected: float | None, tmp_path: Path
) -> None:
    data = np.random.default_rng(0).integers(1, 250, (2, 200, 200)).astype(np.uint8)
    window = RasterioWindow(0, 150, 60, 50).toslices()
    if corner == "everywhere":
        data[:] = fill
    elif corner != "none":
        data[: 1 if corner == "one band" else 2, *window] = fill
    place = {"crs": "EPSG:32618", "transform": rasterio.Affine(10, 0, 4e5, 0, -10, 4e6)}
    with open_raster(write(tmp_path / "a.tif", data, **place)) as reader:
        told = reader.leave_out(None)
    assert bool(told) == (expected is not None)
    assert told == "" or f"filled with {expected:g}" in told
