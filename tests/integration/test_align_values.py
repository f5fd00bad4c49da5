"""What the pixels hold does not matter: units, types, undeclared fill, few or many bands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.enums import Resampling
from scipy import ndimage

from geodelreg import AlignOptions, align, check
from geodelreg.errors import AlignmentRefusedError
from geodelreg.values.result import CheckOutcome, Outcome
from tests.integration.align_scenes import (
    Pixels,
    Recipe,
    Scene,
    centred,
    make_scene,
    write,
)

STANDARD = Recipe(centred(4, 130), (130, 130))
Change = Callable[[Pixels], NDArray[np.generic]]


@pytest.fixture(scope="module")
def standard(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("standard"), STANDARD)


def changed(path: Path, folder: Path, change: Change, nodata: int | None = None) -> Path:
    with rasterio.open(path) as dataset:
        data, transform, crs = dataset.read(), dataset.transform, dataset.crs.to_wkt()
    return write(folder / path.name, change(data), transform, crs, nodata)


def same(data: Pixels) -> Pixels:
    return data


def tiny(data: Pixels) -> NDArray[np.generic]:
    """As night lights are, in W/cm²/sr."""
    return data * 1e-12


def huge(data: Pixels) -> NDArray[np.generic]:
    return data * 1e9


def negative(data: Pixels) -> NDArray[np.generic]:
    return (data.astype(np.int32) - 3000).astype(np.int16)


def eight_bit(data: Pixels) -> NDArray[np.generic]:
    return (data // 16).astype(np.uint8)


def filled(data: Pixels) -> NDArray[np.generic]:
    """Fill values that the header does not declare, NaN and infinity."""
    out = data.astype(np.float32)
    side = data.shape[1]
    out[:, : side // 10] = np.finfo(np.float32).min
    out[:, :, -side // 10 :] = 3e38
    out[:, side // 2, side // 3], out[:, side // 3, side // 2] = np.nan, np.inf
    return out


@pytest.mark.parametrize(
    ("of_ms", "of_pan"),
    [(tiny, tiny), (tiny, same), (same, tiny), (huge, same), (negative, eight_bit),
     (filled, filled), (filled, same)],
    ids=lambda change: change.__name__,
)  # fmt: skip
def test_values_of_any_size_are_matched(
    standard: Scene, tmp_path: Path, of_ms: Change, of_pan: Change
) -> None:
    ms, pan = (changed(p, tmp_path, c) for p, c in ((standard.ms, of_ms), (standard.pan, of_pan)))
    alignment = align(ms, pan)
    assert alignment.verdict.outcome is Outcome.ALIGNED
    assert standard.rmse_px(alignment.correction.corrected) < 0.02


def test_a_narrow_strip_is_enough(tmp_path: Path) -> None:
    """As the overlap of neighbouring swaths is."""
    place = Affine.translation(330, 100) @ Affine.scale(4)
    scene = make_scene(tmp_path, Recipe(place, (150, 26)))
    alignment = align(scene.ms, scene.pan)
    assert scene.rmse_px(alignment.correction.corrected) < 0.03


def test_of_very_many_bands_some_are_matched(standard: Scene, tmp_path: Path) -> None:
    """As a hyperspectral image has, some of them empty."""
    rng = np.random.default_rng(0)

    def many(data: Pixels) -> NDArray[np.generic]:
        weights = rng.dirichlet(np.ones(4), 90)
        bands = np.tensordot(weights, data.astype(np.float64), axes=1)
        bands[::7] = 0
        return (bands + rng.normal(0, 3, bands.shape)).clip(0).astype(np.uint16) * (bands > 0)

    ms = changed(standard.ms, tmp_path, many, 0)
    alignment = align(ms, standard.pan)
    assert standard.rmse_px(alignment.correction.corrected) < 0.1
    assert 6 < len(alignment.solution.band_weights) <= 12
    assert any("of 90 bands" in warning for warning in alignment.warnings)


def test_one_band_is_enough(standard: Scene, tmp_path: Path) -> None:
    alignment = align(changed(standard.ms, tmp_path, lambda data: data[1:2]), standard.pan)
    assert standard.rmse_px(alignment.correction.corrected) < 0.1
    assert list(alignment.solution.band_weights) == ["band 1"]


@pytest.mark.parametrize("resampling", [Resampling.nearest, Resampling.cubic])
@pytest.mark.parametrize("factor", [2, 4])
def test_enlarged_rasters_fit_as_well(
    standard: Scene, tmp_path: Path, factor: int, resampling: Resampling
) -> None:
    """MS that was resampled to PAN's grid, say, shows no more than it did before."""
    with rasterio.open(standard.ms) as dataset:
        shape = (dataset.count, factor * dataset.height, factor * dataset.width)
        data = dataset.read(out_shape=shape, resampling=resampling)
        header = dataset.transform @ Affine.scale(1 / factor)
        ms = write(tmp_path / "ms.tif", data, header, dataset.crs.to_wkt())
    alignment = align(ms, standard.pan)
    back = alignment.correction.corrected @ Affine.scale(factor)
    assert standard.rmse_px(back) < 0.03
    assert alignment.accuracy.sigma_corner_px < 0.06


@pytest.mark.parametrize("sigma", [0.7, 1.2])
def test_out_of_focus_rasters_fit(standard: Scene, tmp_path: Path, sigma: float) -> None:
    def blurred(data: Pixels) -> NDArray[np.generic]:
        return ndimage.gaussian_filter(data.astype(np.float32), (0, sigma, sigma))

    alignment = align(changed(standard.ms, tmp_path, blurred), standard.pan)
    assert standard.rmse_px(alignment.correction.corrected) < 0.1


def test_a_raster_lies_on_itself(standard: Scene) -> None:
    alignment = align(standard.pan, standard.pan)
    assert alignment.verdict.outcome is Outcome.ALREADY_ALIGNED
    assert alignment.accuracy.before_rmse_px < 0.0015


def test_inverted_contrast_is_aligned(standard: Scene, tmp_path: Path) -> None:
    """Near infrared against PAN over land and water, say."""
    ms = changed(standard.ms, tmp_path, lambda data: 4095 - data)
    alignment = align(ms, standard.pan)
    assert standard.rmse_px(alignment.correction.corrected) < 0.1


def test_undeclared_frames_do_not_lead(tmp_path: Path) -> None:
    """A black frame at the same pixels of both images is an edge that never moves."""

    def frame(ms: Pixels, pan: Pixels) -> None:
        ms[:, :20], ms[:, :, -20:] = 0, 0
        pan[:80], pan[:, -80:] = 0, 0

    scene = make_scene(tmp_path, replace(STANDARD, change=frame))
    alignment = align(scene.ms, scene.pan)
    assert scene.rmse_px(alignment.correction.corrected) < 0.05


def test_relief_is_not_passed_over_in_silence(tmp_path: Path) -> None:
    """Parallax bends MS by 1.2 PAN px RMS: no affine is written, and `check` says misaligned."""

    def parallax(ms: Pixels, _: Pixels) -> None:
        height = ndimage.gaussian_filter(np.random.default_rng(2).normal(size=ms.shape[1:]), 18)
        rows, columns = np.mgrid[: ms.shape[1], : ms.shape[2]]
        places = [rows, columns + 0.3 * height / height.std()]
        for band in ms:
            band[:] = ndimage.map_coordinates(band, places, mode="reflect").clip(0, 4095)

    scene = make_scene(tmp_path, replace(STANDARD, change=parallax))
    with pytest.raises(AlignmentRefusedError) as refused:
        align(scene.ms, scene.pan)
    assert refused.value.alignment is not None
    reasons = refused.value.alignment.verdict.reasons
    assert [reason.name for reason in reasons if not reason.passed] == ["local"]
    found = check(scene.ms, scene.pan)
    assert found.outcome is not CheckOutcome.ALIGNED
    assert found.affine_enough is not True


def test_as_many_keypoints_are_taken_as_are_allowed(tmp_path: Path) -> None:
    noise = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal((400, 400)), 1.0)
    data = (2000 + 3000 * noise).astype(np.uint16)[None]
    crs = CRS.from_epsg(32616).to_wkt()
    place = Affine(2.0, 0.0, 500_000.0, 0.0, -2.0, 1_000_000.0)
    ms = write(tmp_path / "ms.tif", data, place, crs)
    pan = write(tmp_path / "pan.tif", data, Affine.translation(4.0, -6.0) @ place, crs)
    counts = [
        align(ms, pan, AlignOptions(max_keypoints=most)).solution.step_counts["keypoints PAN"]
        for most in (1000, 6000)
    ]
    assert counts == [1000, 1500]
