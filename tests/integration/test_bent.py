"""Pairs that one affine does not align are refused in words, or warned of; calm ones are not."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray

import geodelreg
from benchmarks.batch.pairs import SAMPLE, crop
from benchmarks.gate.bent_cases import BentPair
from benchmarks.gate.distortions import (
    Tear,
    fade,
    frame,
    gradient_contrast,
    relief_shading,
    waves,
)
from benchmarks.scenes.imagery import sample_imagery
from benchmarks.scenes.make import Bend, HeaderError, SceneSpec, make_scene, write_scene
from benchmarks.scenes.truth import apply
from geodelreg import Alignment, AlignOptions
from geodelreg.errors import AlignmentRefusedError
from geodelreg.product.check import check_dict
from geodelreg.product.report import report_dict, report_schema
from geodelreg.values.result import CheckOutcome

SHAPE = (640, 640)
SPEC = SceneSpec("bent", "", HeaderError((1.3, -0.7)), SHAPE, (300, 300), ratio=2.0)
SMALL = replace(SPEC, pan_shape=(400, 400), ms_shape=(190, 190))
CLOUDY = replace(SMALL, name="cloudy 1", variant="clouds")


def still(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.zeros_like(xy)


@dataclass(frozen=True)
class Made:
    """Two files, and what is true of them."""

    ms: Path
    pan: Path
    pair: BentPair

    def rms_px(self, transform: Affine) -> float:
        return float(np.sqrt((self.pair.errors(transform) ** 2).sum(axis=1).mean()))


def made(folder: Path, bend: Bend, spec: SceneSpec = SPEC) -> Made:
    return written(folder, BentPair(make_scene(spec, sample_imagery(), bend), bend))


def written(folder: Path, pair: BentPair) -> Made:
    write_scene(pair.scene, folder)
    return Made(folder / "ms.tif", folder / "pan.tif", pair)


@pytest.fixture(scope="module")
def wavy(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return made(tmp_path_factory.mktemp("wavy"), waves(2.0, 400.0, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Made:
    tear = Tear((16.0, -12.0), 0.4, 0.0, SMALL.pan_shape)
    return made(tmp_path_factory.mktemp("torn"), tear, SMALL)


def refusal(of: Made, **options: object) -> tuple[AlignmentRefusedError, Alignment]:
    with pytest.raises(AlignmentRefusedError) as caught:
        geodelreg.align(of.ms, of.pan, AlignOptions(**options))  # type: ignore[arg-type]
    assert caught.value.alignment is not None
    return caught.value, caught.value.alignment


def failed(alignment: Alignment) -> set[str]:
    return {reason.name for reason in alignment.verdict.reasons if not reason.passed}


def test_waves_are_refused_with_what_they_leave_and_what_helps(wavy: Made) -> None:
    error, alignment = refusal(wavy)
    assert failed(alignment) == {"local"}
    assert "`on_local='warn'`" in error.remedy
    assert "`max_residual_px`" in error.remedy
    accuracy, true = alignment.accuracy, wavy.rms_px(wavy.pair.best_affine())
    assert accuracy.residual_rms_px == pytest.approx(true, rel=0.15)
    low, high = accuracy.residual_interval_px
    assert 0.5 < low <= accuracy.residual_rms_px <= high
    assert accuracy.residual_p95_px > accuracy.residual_rms_px
    jsonschema.validate(report_dict(alignment), report_schema())


def test_what_is_left_is_that_of_the_best_affine_where_a_part_alone_agrees(tmp_path: Path) -> None:
    wavy = made(tmp_path, waves(3.0, 565.0, np.random.default_rng(0)))
    _, alignment = refusal(wavy)
    assert failed(alignment) == {"local"}
    best = wavy.rms_px(wavy.pair.best_affine())
    assert alignment.accuracy.residual_rms_px == pytest.approx(best, rel=0.1)


def test_waves_are_written_when_told_by_the_best_affine_of_the_whole(
    wavy: Made, tmp_path: Path
) -> None:
    alignment = geodelreg.align(wavy.ms, wavy.pan, AlignOptions(on_local="warn"))
    assert any("of the ground's bend" in warning for warning in alignment.warnings)
    geodelreg.write(alignment, tmp_path / "out.tif")
    best = wavy.rms_px(wavy.pair.best_affine())
    assert wavy.rms_px(alignment.correction.corrected) < 1.1 * best


def test_the_limit_of_the_residual_is_the_users(wavy: Made) -> None:
    alignment = geodelreg.align(wavy.ms, wavy.pan, AlignOptions(max_residual_px=5.0))
    assert alignment.verdict.accepted


def hills(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...,) height of four hills, 1 at the top, at (..., 2) PAN pixels."""
    tops = np.array([(160, 150), (460, 210), (190, 470), (480, 500)])
    return np.exp(-(((xy[..., None, :] - tops) / 60.0) ** 2).sum(axis=-1) / 2).sum(axis=-1)


def displaced(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return hills(xy)[..., None] * (3.0, 2.0)


@pytest.fixture(scope="module")
def hilly(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Hills lie off what stays, and are so bright that they could be clouds."""
    scene = make_scene(replace(SPEC, ms_shape=(145, 145), ratio=4.0), sample_imagery(), displaced)
    to_pan = ~Affine(*scene.truth.pan) @ Affine(*scene.truth.ms_true)
    seen = centres(scene.ms.shape[-2:], to_pan)
    bright = [
        np.rint(image * (1 + hills(xy))).astype(np.uint16)
        for image, xy in (
            (scene.ms, seen + displaced(seen)),
            (scene.pan, centres(SHAPE, Affine.identity())),
        )
    ]
    pair = BentPair(replace(scene, ms=bright[0], pan=bright[1]), displaced)
    return written(tmp_path_factory.mktemp("hilly"), pair)


def centres(shape: tuple[int, ...], to_pan: Affine) -> NDArray[np.float64]:
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    return np.stack(apply(to_pan, columns, rows), axis=-1)


def test_bright_hills_that_bend_are_no_clouds_whatever_may_be_written(hilly: Made) -> None:
    assert failed(refusal(hilly)[1]) == {"local"}
    told = geodelreg.align(hilly.ms, hilly.pan, AlignOptions(on_local="warn"))
    assert not any("clouds" in warning for warning in told.warnings)
    best = hilly.rms_px(hilly.pair.best_affine())
    assert hilly.rms_px(told.correction.corrected) < 1.1 * best


def test_a_second_motion_is_refused_and_its_place_is_told(torn: Made) -> None:
    error, alignment = refusal(torn, on_local="warn")
    assert failed(alignment) == {"two_motions"}
    assert "16 px left and 12 px down of the rest" in str(error)
    share = re.search(r"the lower (\d+) %", str(error))
    assert share is not None
    assert int(share[1]) == pytest.approx(40, abs=4)
    assert "`mask`" in error.remedy


def test_check_calls_both_misaligned(torn: Made, tmp_path: Path) -> None:
    wavy = made(tmp_path, waves(2.0, 300.0, np.random.default_rng(0)), SMALL)
    for of in (wavy, torn):
        found = geodelreg.check(of.ms, of.pan)
        assert found.outcome is CheckOutcome.MISALIGNED
        jsonschema.validate(check_dict(found), report_schema())
    assert "16 px left and 12 px down of the rest" in found.reason


def test_no_field_follows_clouds(tmp_path: Path) -> None:
    cloudy = written(tmp_path, BentPair(make_scene(CLOUDY, sample_imagery())))
    error, alignment = refusal(cloudy, model="field")
    assert failed(alignment) == {"field_clouds"}
    assert "`mask`" in error.remedy


SMALL_TEARS = {
    "nearly half": (360, 4.0, None, (3.0, 20.0), 0.4),
    "not far": (400, 2.0, (440.0, 452.0), (3.75, 0.73), 0.168),
    "part of it beyond PAN": (400, 4.0, (567.0, 268.0), (-10.9, 26.6), 0.26),
    "thinner than a patch": (400, 2.0, None, (20.0, 2.0), 0.11),
}


@pytest.mark.parametrize("name", SMALL_TEARS)
def test_a_raster_of_a_few_patches_is_not_torn_in_silence(name: str, tmp_path: Path) -> None:
    side, ratio, centre, shift, share = SMALL_TEARS[name]
    ms = round(0.9 * side / ratio)
    small = replace(
        SPEC, error=HeaderError((1.3, -0.7)), pan_shape=(side, side), ms_shape=(ms, ms),
        ratio=ratio, pan_centre=centre,
    )  # fmt: skip
    torn = made(tmp_path, Tear(shift, share, 0.0, small.pan_shape), small)
    assert "two_motions" in failed(refusal(torn)[1])


ROLLED = {"bright": (0.25, 15, 60), "beyond reach": (0.25, 40, 160), "nearly half": (0.5, 60, 240)}


@pytest.mark.parametrize("name", ROLLED)
def test_a_side_that_went_far_is_no_cloud_and_is_told_where_it_went(
    name: str, tmp_path: Path
) -> None:
    share, moved_px, pan_px = ROLLED[name]
    with rasterio.open(SAMPLE / "ms.tif") as raster:
        bands, profile = raster.read(), raster.profile
    low = slice(round(bands.shape[1] * (1 - share)), None)
    bands[:, low] = np.roll(bands[:, low], moved_px, axis=2)
    with rasterio.open(tmp_path / "ms.tif", "w", **profile) as out:
        out.write(bands)
    with pytest.raises(AlignmentRefusedError, match=f"lower .* lies {pan_px} px right") as caught:
        geodelreg.align(tmp_path / "ms.tif", SAMPLE / "pan.tif")
    assert caught.value.alignment is not None
    assert failed(caught.value.alignment) == {"two_motions"}


def test_no_second_guess_of_a_place_makes_torn_ground_whole(tmp_path: Path) -> None:
    """Read otherwise, the images show a patch less of the torn part, and too few for a motion."""
    small = replace(
        SPEC, pan_shape=(332, 332), ms_shape=(74, 74), ratio=4.0, pan_centre=(375.0, 336.0)
    )
    torn = made(tmp_path, Tear((-9.5, 5.6), 0.1826, 0.0, small.pan_shape), small)
    assert "two_motions" in failed(refusal(torn)[1])


def test_ground_between_clouds_is_aligned_and_their_share_told(tmp_path: Path) -> None:
    cloudy = written(tmp_path, BentPair(make_scene(CLOUDY, sample_imagery())))
    alignment = geodelreg.align(cloudy.ms, cloudy.pan)
    assert cloudy.rms_px(alignment.correction.corrected) < 0.1
    assert any("look like clouds" in warning for warning in alignment.warnings)


@pytest.mark.parametrize("kind", ["shaded like relief", "the edges of PAN"])
def test_slopes_of_an_image_are_aligned_with_its_slopes(kind: str, tmp_path: Path) -> None:
    scene = make_scene(SMALL, sample_imagery())
    shaded = relief_shading(scene.ms, np.random.default_rng(3))
    ms = gradient_contrast(scene.ms) if "edges" in kind else shaded
    pair = written(tmp_path, BentPair(replace(scene, ms=ms)))
    found = geodelreg.align(pair.ms, pair.pan)
    assert pair.rms_px(found.correction.corrected) < 0.1
    assert any(kind in warning for warning in found.warnings)


def test_an_image_that_is_half_shaded_has_two_places_and_is_refused(tmp_path: Path) -> None:
    scene = make_scene(SMALL, sample_imagery())
    shaded = relief_shading(scene.ms, np.random.default_rng(3)).astype(np.float64)
    plain = scene.ms * (shaded.std() / scene.ms.std())
    half = BentPair(replace(scene, ms=np.rint(shaded + plain).astype(np.uint16)))
    _, alignment = refusal(written(tmp_path, half))
    assert "shading" in failed(alignment)


def test_a_shaded_image_is_refused_though_clipped_clouds_hold_most_of_its_contrast(
    tmp_path: Path,
) -> None:
    scene = make_scene(SMALL, sample_imagery())
    # the brightest fields saturate both sensors, as clouds do; the rest is dim
    clipped = [
        np.where(image > np.percentile(image, 96), 4095, 300 + image // 20).astype(np.uint16)
        for image in (scene.ms, scene.pan)
    ]
    shaded = relief_shading(clipped[0], np.random.default_rng(3))
    pair = BentPair(replace(scene, ms=shaded, pan=clipped[1]))
    assert "shading" in failed(refusal(written(tmp_path, pair))[1])


def drawn_on(
    folder: Path, kind: str, same_ground: bool, spec: SceneSpec = SMALL, seed: int = 2
) -> Made:
    """A pair, or a scene and its mirror image, with the same structure on the grid of both."""
    imagery, spec = sample_imagery(), replace(spec, error=HeaderError((6.0, -4.0)))
    scene = make_scene(spec, imagery)
    if not same_ground:
        mirrored = replace(imagery, bands=np.ascontiguousarray(imagery.bands[:, :, ::-1]))
        scene = replace(scene, pan=make_scene(spec, mirrored).pan)
    frame((scene.ms, scene.pan), kind, np.random.default_rng(seed))
    return written(folder, BentPair(scene, same_ground=same_ground))


def test_labels_on_two_places_do_not_make_them_one(tmp_path: Path) -> None:
    error, alignment = refusal(drawn_on(tmp_path, "labels", same_ground=False))
    assert "repeated" in failed(alignment)
    assert "4000 in MS, 4000 in PAN" in str(error)
    assert "`pan_nodata`" in error.remedy


def test_a_pattern_of_the_pixel_grid_is_left_out_when_told(tmp_path: Path) -> None:
    pair = drawn_on(tmp_path, "fixed pattern", same_ground=True)
    told = geodelreg.align(pair.ms, pair.pan, AlignOptions(ms_nodata=4000, pan_nodata=4000))
    assert pair.rms_px(told.correction.corrected) < 0.1


LITTLE = replace(SPEC, pan_shape=(320, 320), ms_shape=(150, 150))
COARSE = replace(SPEC, pan_shape=(600, 600), ms_shape=(135, 135), ratio=4.0)


@pytest.mark.parametrize(
    ("kind", "spec", "seed"),
    [
        ("fixed pattern", LITTLE, 2),
        ("stripes", LITTLE, 2),  # leave no patch whole
        ("stripes", COARSE, 12),  # of each patch a third, and less beside its place
    ],
)
def test_what_is_drawn_on_both_is_found_left_out_and_told(
    kind: str, spec: SceneSpec, seed: int, tmp_path: Path
) -> None:
    pair = drawn_on(tmp_path, kind, True, spec, seed)
    found = geodelreg.align(pair.ms, pair.pan)
    assert pair.rms_px(found.correction.corrected) < 0.1
    for name in ("ms.tif", "pan.tif"):
        told = f"what is drawn on {name} with the value 4000 is left out"
        assert told in found.warnings
    points = found.tie_points.reference_px[found.tie_points.kept]
    assert len(points) >= 8


def test_labels_on_a_shaded_image_are_left_out_of_its_slopes_and_told(tmp_path: Path) -> None:
    scene = make_scene(LITTLE, sample_imagery())
    scene = replace(scene, ms=relief_shading(scene.ms, np.random.default_rng(3)))
    frame((scene.ms, scene.pan), "labels", np.random.default_rng(2))
    pair = written(tmp_path, BentPair(scene))
    found = geodelreg.align(pair.ms, pair.pan)
    assert pair.rms_px(found.correction.corrected) < 0.1
    assert any("shaded like relief" in warning for warning in found.warnings)
    for name in ("ms.tif", "pan.tif"):
        of_one = [warning for warning in found.warnings if f"drawn on {name}" in warning]
        assert len(of_one) == 1
        assert "4000 is left out" in of_one[0]


def test_ground_that_is_right_beside_labels_is_no_less_so(tmp_path: Path) -> None:
    pair = drawn_on(tmp_path, "labels", same_ground=True)
    assert pair.rms_px(geodelreg.align(pair.ms, pair.pan).correction.corrected) < 0.1


def test_a_scale_is_found_from_a_corner_that_shows_something(tmp_path: Path) -> None:
    """All else is flat in MS, and must spoil neither the tone nor the share of what agrees."""
    error = HeaderError((2.0, -1.2), (1.02, 0.0, 0.0, 1.02))
    spec = replace(SPEC, error=error, ms_shape=(150, 150), ratio=4.0)
    scene = make_scene(spec, sample_imagery())
    fade(scene.ms, 0.44, np.random.default_rng(1))
    corner = written(tmp_path, BentPair(scene))
    alignment = geodelreg.align(corner.ms, corner.pan)
    assert corner.rms_px(alignment.correction.corrected) < 0.2
    assert alignment.accuracy.coverage < 0.2


@pytest.mark.parametrize(("shift", "spec"), [((-6.0, -2.4), SPEC), ((-1.6, -0.9), SMALL)])
def test_bands_that_lie_apart_are_refused_and_named_however_far(
    shift: tuple[float, float], spec: SceneSpec, tmp_path: Path
) -> None:
    apart = bands_apart(tmp_path, shift, spec)
    error, alignment = refusal(apart)
    assert "bands" in failed(alignment)
    told = re.search(r"band 3 lies ([\d.]+) px right and ([\d.]+) px down of band", str(error))
    assert told is not None
    # the bands of the imagery lie a quarter of a pixel apart themselves
    assert [float(number) for number in told.groups()] == pytest.approx(np.negative(shift), abs=0.3)
    assert "`band" in error.remedy
    alone = geodelreg.align(apart.ms, apart.pan, AlignOptions(band=1))
    assert np.abs(apart.pair.errors(alone.correction.corrected)).max() < 0.1


def test_bands_that_lie_a_little_apart_are_warned_of(tmp_path: Path) -> None:
    apart = bands_apart(tmp_path, (0.6, -0.5))
    alignment = geodelreg.align(apart.ms, apart.pan)
    assert any("MS bands do not agree: band 3" in warning for warning in alignment.warnings)


def test_bands_that_lie_apart_two_by_two_are_refused(tmp_path: Path) -> None:
    still, shift = (0.0, 0.0), (3.0, -4.0)
    scene = make_scene(SMALL, sample_imagery(), band_shifts=(still, still, shift, shift))
    error, alignment = refusal(written(tmp_path, BentPair(scene)))
    assert "bands" in failed(alignment)
    told = re.search(r"([\d.]+) px left and ([\d.]+) px down of band", str(error))
    assert told is not None
    assert [float(number) for number in told.groups()] == pytest.approx((3.0, 4.0), abs=0.3)


@pytest.mark.parametrize("start", [(64, 248), (60, 256)])
def test_a_band_that_looks_unlike_the_others_is_not_called_misaligned(
    start: tuple[int, int], tmp_path: Path
) -> None:
    ms, pan = tmp_path / "ms.tif", tmp_path / "pan.tif"
    with rasterio.open(SAMPLE / "pan.tif") as whole:
        crop(whole, pan, start, 440)
    with rasterio.open(SAMPLE / "ms.tif") as whole:
        crop(whole, ms, (start[0] // 4, start[1] // 4), 110)
    alignment = geodelreg.align(ms, pan)
    assert alignment.verdict.accepted
    assert not any("bands do not agree" in warning for warning in alignment.warnings)


def bands_apart(folder: Path, shift: tuple[float, float], spec: SceneSpec = SMALL) -> Made:
    still = (0.0, 0.0)
    scene = make_scene(spec, sample_imagery(), band_shifts=(still, still, shift, still))
    return written(folder, BentPair(scene))


def test_where_one_affine_is_the_truth_hardly_anything_is_left(tmp_path: Path) -> None:
    plain = made(tmp_path, still)
    alignment = geodelreg.align(plain.ms, plain.pan)
    assert plain.rms_px(alignment.correction.corrected) < 0.1
    low, high = alignment.accuracy.residual_interval_px
    assert low <= alignment.accuracy.residual_rms_px <= high < 0.15
