"""Alignments that clouds lead astray without a mask, and what is reported about masks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from scipy import ndimage

import geodelreg
from geodelreg import AlignOptions, align
from geodelreg.errors import AlignmentRefusedError, MaskError, NoDataError
from geodelreg.product.check import check_text
from geodelreg.product.report import report_dict, report_schema, summary_text
from geodelreg.values.result import CheckOutcome, Outcome
from tests.integration.align_scenes import (
    PAN_WINDOW,
    UTM18,
    Pixels,
    Recipe,
    Scene,
    centred,
    make_scene,
    write,
)

SIDE = 130
TO_GROUND = centred(4, SIDE)
PARALLAX_PX = (24.0, 16.0)
CLEAR, CLOUD = 21824, 22280


@dataclass(frozen=True)
class Clouded:
    """A scene under clouds that MS sees elsewhere, and where each image shows them."""

    scene: Scene
    ms_clouds: NDArray[np.bool_]
    pan_clouds: NDArray[np.bool_]

    def mask(self, folder: Path, name: str, values: NDArray[np.generic], of: str = "ms") -> Path:
        with rasterio.open(self.scene.ms if of == "ms" else self.scene.pan) as image:
            return write(folder / name, values[None], image.transform, UTM18)


def clouds() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Opacity and brightness of a broken layer with texture, on the pixels of PAN."""
    rng, shape = np.random.default_rng(5), PAN_WINDOW[3:1:-1]
    lumps = ndimage.gaussian_filter(rng.normal(size=shape), 30)
    lumps = (lumps - lumps.min()) / np.ptp(lumps)
    texture = ndimage.gaussian_filter(rng.normal(size=shape), 2)
    return np.clip((lumps - 0.6) * 12, 0, 1), 3000 + 250 * texture / texture.std()


def seen_by_ms(layer: NDArray[np.float64]) -> NDArray[np.float64]:
    """A layer over PAN as MS pixels show it, displaced by its height."""
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5
    x, y = TO_GROUND @ (columns, rows)
    x, y = x - PAN_WINDOW[0] - PARALLAX_PX[0], y - PAN_WINDOW[1] - PARALLAX_PX[1]
    smooth = ndimage.uniform_filter(layer, 4)
    return np.asarray(ndimage.map_coordinates(smooth, [y - 0.5, x - 0.5], order=1, mode="nearest"))


@pytest.fixture(scope="module")
def clouded(tmp_path_factory: pytest.TempPathFactory) -> Clouded:
    opacity, brightness = clouds()
    opacity_ms, brightness_ms = seen_by_ms(opacity), seen_by_ms(brightness)

    def cover(ms: Pixels, pan: Pixels) -> None:
        pan[:] = pan * (1 - opacity) + brightness * opacity
        ms[:] = ms * (1 - opacity_ms) + brightness_ms * opacity_ms

    folder = tmp_path_factory.mktemp("clouded")
    scene = make_scene(folder, Recipe(TO_GROUND, (SIDE, SIDE), change=cover))
    return Clouded(scene, opacity_ms > 0.02, opacity > 0.02)


def test_clouds_over_two_fifths_do_not_win_without_a_mask(clouded: Clouded) -> None:
    """Their layer is the clearest motion in this scene, 29 px from the ground.

    Without a mask a part that moves by itself may as well be torn ground, the clouds' place is
    contradicted by the keypoints of the ground, and at the ground's place the clouds are a rival:
    each is refused, and a mask is asked for.
    """
    with pytest.raises(AlignmentRefusedError, match="`mask`") as caught:
        align(clouded.scene.ms, clouded.scene.pan)
    reasons = caught.value.alignment.verdict.reasons
    (failed,) = [reason for reason in reasons if not reason.passed]
    assert failed.name in ("two_motions", "keypoints_apart", "rival")


def test_a_mask_of_either_image_lets_the_ground_speak(clouded: Clouded, tmp_path: Path) -> None:
    scene = clouded.scene
    qa = np.where(clouded.ms_clouds, CLOUD, CLEAR).astype(np.uint16)
    ms_mask = clouded.mask(tmp_path, "LC08_T1_QA_PIXEL.TIF", qa)
    pan_mask = clouded.mask(tmp_path, "clouds.tif", clouded.pan_clouds.astype(np.uint8), "pan")
    for options in (AlignOptions(masks=(str(ms_mask),)), AlignOptions(pan_masks=(str(pan_mask),))):
        alignment = align(scene.ms, scene.pan, options)
        assert alignment.verdict.outcome is Outcome.ALIGNED
        assert scene.rmse_px(alignment.correction.corrected) < 0.2


def test_no_tie_point_lies_under_a_mask(clouded: Clouded, tmp_path: Path) -> None:
    mask = clouded.mask(tmp_path, "clouds.tif", clouded.ms_clouds.astype(np.uint8))
    points = align(clouded.scene.ms, clouded.scene.pan, AlignOptions(masks=(str(mask),))).tie_points
    columns, rows = np.floor(points.source_px[points.kept]).astype(int).T
    # a patch may hold some hidden pixels; its centre must not lie deep under the mask
    deep = ndimage.binary_erosion(clouded.ms_clouds, iterations=5)
    assert not deep[rows, columns].any()


def test_output_pixels_under_a_mask_stay_as_they_are(clouded: Clouded, tmp_path: Path) -> None:
    mask = clouded.mask(tmp_path, "clouds.tif", clouded.ms_clouds.astype(np.uint8))
    alignment = align(clouded.scene.ms, clouded.scene.pan, AlignOptions(masks=(str(mask),)))
    geodelreg.write(alignment, tmp_path / "out.tif")
    with rasterio.open(clouded.scene.ms) as ms, rasterio.open(tmp_path / "out.tif") as out:
        assert np.array_equal(ms.read(), out.read())
        assert out.dataset_mask().all()


def test_the_report_names_the_masks_their_kinds_and_shares(
    clouded: Clouded, tmp_path: Path
) -> None:
    classes = np.where(clouded.ms_clouds, 9, 4).astype(np.uint8)
    mask = clouded.mask(tmp_path, "classes.tif", classes)
    alignment = align(clouded.scene.ms, clouded.scene.pan, AlignOptions(masks=(f"{mask}=8-10",)))
    report = report_dict(alignment)
    jsonschema.validate(report, report_schema())
    (use,) = report["masks"]
    assert use["image"] == "source"
    assert use["path"] == str(mask)
    assert (use["band"], use["kind"], use["hide"]) == (1, "values", [[8, 10]])
    assert use["covered_share"] == 1.0
    assert use["hidden_share"] == pytest.approx(clouded.ms_clouds.mean(), abs=0.02)
    assert report["options"]["masks"] == [f"{mask}=8-10"]
    share = f"{100 * use['hidden_share']:.1f}"
    assert f"Masks hide: classes.tif (values) {share} % of MS." in summary_text(alignment)


def test_a_quality_band_in_ms_masks_it_and_is_kept(clouded: Clouded, tmp_path: Path) -> None:
    scene = clouded.scene
    with rasterio.open(scene.ms) as ms:
        planes, profile = ms.read(), ms.profile | {"count": 5}
    path = tmp_path / "ms.tif"
    qa = np.where(clouded.ms_clouds, CLOUD, CLEAR).astype(np.uint16)
    with rasterio.open(path, "w", **profile) as stack:
        stack.write(np.concatenate([planes, qa[None]]))
        stack.descriptions = ("B1", "B2", "B3", "B4", "QA_PIXEL")
    alignment = align(path, scene.pan)
    assert scene.rmse_px(alignment.correction.corrected) < 0.2
    assert "QA_PIXEL" not in alignment.solution.band_weights
    assert [(use.band, use.kind) for use in alignment.masks] == [(5, "landsat-qa")]
    geodelreg.write(alignment, tmp_path / "out.tif")
    with rasterio.open(tmp_path / "out.tif") as out:
        assert np.array_equal(out.read(5), qa)


def test_a_quality_file_among_the_bands_masks_them_and_is_corrected(
    clouded: Clouded, tmp_path: Path
) -> None:
    scene = clouded.scene
    with rasterio.open(scene.ms) as ms:
        planes, header = ms.read(), ms.transform
    paths = [
        write(tmp_path / f"B{number}.tif", plane[None], header, UTM18)
        for number, plane in enumerate(planes, 1)
    ]
    # 2 × 2 pixels of MS to one of SCL, as bands of 10 m have it
    cells = clouded.ms_clouds.reshape(65, 2, 65, 2).any(axis=(1, 3))
    classes = np.where(cells, 9, 4).astype(np.uint8)[None]
    paths.append(write(tmp_path / "T18_SCL_20m.tif", classes, header @ Affine.scale(2), UTM18))
    alignment = align(paths, scene.pan)
    assert scene.rmse_px(alignment.correction.corrected) < 0.3
    assert [use.kind for use in alignment.masks] == ["sentinel2-scl"]
    geodelreg.write(alignment, tmp_path / "out")
    with rasterio.open(tmp_path / "out" / paths[-1].name) as out:
        assert out.transform.almost_equals(alignment.correction.corrected @ Affine.scale(2), 1e-6)


def test_check_measures_the_ground_and_says_what_was_hidden(
    clouded: Clouded, tmp_path: Path
) -> None:
    mask = clouded.mask(tmp_path, "clouds.tif", clouded.ms_clouds.astype(np.uint8))
    found = geodelreg.check(
        clouded.scene.ms, clouded.scene.pan, AlignOptions(masks=(str(mask),)), limit_px=1.0
    )
    assert found.outcome is CheckOutcome.MISALIGNED
    assert found.misalignment.distance_px == pytest.approx(clouded.scene.before_px, abs=0.5)
    assert "Masks hide: clouds.tif (binary)" in check_text(found)


@pytest.mark.parametrize("of", ["ms", "pan"])
def test_a_mask_that_leaves_nothing_is_named(clouded: Clouded, tmp_path: Path, of: str) -> None:
    shape = (clouded.ms_clouds if of == "ms" else clouded.pan_clouds).shape
    mask = clouded.mask(tmp_path, "valid.tif", np.full(shape, 255, dtype=np.uint8), of)
    names = (str(mask),)
    options = AlignOptions(masks=names) if of == "ms" else AlignOptions(pan_masks=names)
    with pytest.raises(NoDataError, match=r"masks hide 100 % by valid\.tif \(binary\)") as caught:
        align(clouded.scene.ms, clouded.scene.pan, options)
    assert "FILE=3,8-10" in caught.value.remedy


def test_a_mask_that_leaves_too_little_is_said_in_the_refusal(
    clouded: Clouded, tmp_path: Path
) -> None:
    values = np.ones((SIDE, SIDE), dtype=np.uint8)
    values[60:80, 60:80] = 0
    mask = clouded.mask(tmp_path, "much.tif", values)
    with pytest.raises(AlignmentRefusedError, match=r"masks hide 98 % of ms\.tif") as caught:
        align(clouded.scene.ms, clouded.scene.pan, AlignOptions(masks=(str(mask),)))
    assert caught.value.alignment is not None
    assert "much.tif" in summary_text(caught.value.alignment)


def test_each_image_is_masked_in_its_own_frame(clouded: Clouded, tmp_path: Path) -> None:
    """A mask that does not say where it lies must have the size of the image that it is of."""
    values = clouded.ms_clouds.astype(np.uint8)
    mask = write(tmp_path / "mask.tif", values[None], Affine.scale(4, -4), "")
    with pytest.raises(MaskError, match="does not have the size of the image"):
        align(clouded.scene.ms, clouded.scene.pan, AlignOptions(pan_masks=(str(mask),)))
