"""The standard error where PAN shows what MS lacks: all patches are pulled alike, unseen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

import geodelreg
from benchmarks.scenes.ground import fractal
from benchmarks.scenes.imagery import Imagery, sample_imagery
from benchmarks.scenes.make import HeaderError, Scene, SceneSpec, make_scene, write_scene
from benchmarks.scenes.truth import grid_rmse
from geodelreg.values.result import Accuracy

SPEC = SceneSpec(
    "unshared", "", HeaderError((2.3, -1.7)), pan_shape=(640, 640), ms_shape=(145, 145)
)  # fmt: skip
UNSEEN = replace(SPEC, pan_weights=(0.05, 0.3, 0.3, 0.35), ms_bands=(0, 1, 2))
COARSER_PX = SPEC.ratio
USUAL_PX = 0.0012 * COARSER_PX  # of sampling, docs/uncertainty.md


def with_infrared(imagery: Imagery) -> Imagery:
    """Its infrared shows other fields, and shadows beside what the other bands show."""
    rng = np.random.default_rng(3)
    seen = imagery.bands[:3].mean(axis=0)
    beside = ndimage.shift(seen, (0.4, -0.8), order=1, mode="nearest")
    fields = seen.mean() + seen.std() * fractal(seen.shape, 1.0, rng)
    infrared = np.clip(0.5 * (beside + fields), 1.0, None)
    return replace(imagery, bands=np.concatenate([imagery.bands[:3], [infrared]]))


def figures(folder: Path, scene: Scene) -> tuple[float, Accuracy]:
    """True error in PAN pixels, and what the tool says of it."""
    write_scene(scene, folder)
    found = geodelreg.align(folder / "ms.tif", folder / "pan.tif")
    return grid_rmse(found.correction.corrected, scene.truth)["rmse_px"], found.accuracy


def noisy(image: NDArray[np.uint16], sigma: float) -> NDArray[np.uint16]:
    errors = sigma * np.random.default_rng(4).standard_normal(image.shape)
    return np.clip(np.rint(image + errors), 1, 4095).astype(np.uint16)


def test_light_that_ms_did_not_see_is_in_the_standard_error(tmp_path: Path) -> None:
    error_px, accuracy = figures(tmp_path, make_scene(UNSEEN, with_infrared(sample_imagery())))
    assert error_px > 0.05
    assert error_px < 2.5 * accuracy.sigma_corner_px < 2.0
    assert accuracy.systematic_px > 0.5 * accuracy.sigma_corner_px


def test_noise_is_not_taken_for_light_that_ms_did_not_see(tmp_path: Path) -> None:
    scene = make_scene(SPEC, sample_imagery())
    _, clean = figures(tmp_path / "clean", scene)
    rough = replace(scene, ms=noisy(scene.ms, 0.15 * float(scene.ms[1].std())))
    error_px, accuracy = figures(tmp_path / "noisy", rough)
    assert clean.systematic_px < 1.3 * USUAL_PX
    assert accuracy.systematic_px < 3 * USUAL_PX
    assert error_px < 2.5 * accuracy.sigma_corner_px
