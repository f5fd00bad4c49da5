"""``geodelreg.align`` on real files: where MS ends up, however the two rasters lie."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from pyproj import CRS

from benchmarks.scenes.truth import Truth
from geodelreg import AlignOptions, align
from geodelreg.product.report import report_dict
from geodelreg.values.result import Alignment, Outcome
from tests.integration.align_scenes import (
    SAMPLE,
    Pixels,
    Recipe,
    Scene,
    about,
    centred,
    ground,
    make_scene,
    write,
)

SHIFT = Affine.translation
GEOGRAPHIC = CRS.from_epsg(4326).to_wkt()
NEXT_ZONE = CRS.from_epsg(32617).to_wkt()
CUSTOM = CRS.from_proj4("+proj=laea +lat_0=37 +lon_0=-76 +ellps=GRS80 +units=m").to_wkt()
STANDARD = Recipe(centred(4, 130), (130, 130))
SOUTH_UP = Affine(1, 0, 0, 0, -1, 130)

HEADER_ERRORS = {
    "shift 230 px": (SHIFT(45.9, -34.6), "shift"),
    "rotation 36°": (about(SHIFT(0.55, 0.4) @ Affine.rotation(36), 130), "similarity"),
    "rotation 170°": (about(SHIFT(0.55, 0.4) @ Affine.rotation(170), 130), "similarity"),
    "scale 1.1, 1.08": (about(SHIFT(-1.6, 2.1) @ Affine.scale(1.1, 1.08), 130), "scale"),
    "scale 1.02, rotation 1.5°": (
        about(SHIFT(-1.6, 2.1) @ Affine.rotation(1.5) @ Affine.scale(1.02), 130),
        "similarity",
    ),
    "shear": (about(SHIFT(-1.6, 2.1) @ Affine(1.006, 0.013, 0, -0.004, 0.994, 0), 130), "affine"),
}
RASTERS = {
    "ratio 1": Recipe(centred(1, 240), (240, 240), SHIFT(7.3, -4.6)),
    "ratio 2": Recipe(centred(2, 220), (220, 220), SHIFT(3.3, -2.6)),
    "ratio 2.5": Recipe(centred(2.5, 190), (190, 190), SHIFT(3.3, -2.6)),
    "rotated MS": Recipe(centred(4, 120, turn=20), (120, 120)),
    "south-up MS": Recipe(STANDARD.to_ground @ SOUTH_UP, (130, 130)),
    "non-square MS": Recipe(centred(4, 130, aspect=0.7), (130, 130)),
    "rotated, non-square, south-up MS": Recipe(
        centred(4, 130, turn=-70, aspect=0.7) @ SOUTH_UP, (130, 130)
    ),
    "MS half off PAN": Recipe(SHIFT(-250, -120) @ STANDARD.to_ground, (130, 130)),
    "MS larger than PAN": Recipe(centred(4, 190), (190, 190), pan_window=(230, 240, 340, 320)),
    "MS in the next UTM zone": replace(STANDARD, ms_crs=NEXT_ZONE),
    "MS in degrees": replace(STANDARD, ms_crs=GEOGRAPHIC),
    "MS in a CRS without a code": replace(STANDARD, ms_crs=CUSTOM),
}


@pytest.fixture(scope="module")
def standard(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("standard"), STANDARD)


@pytest.fixture(scope="module")
def aligned(standard: Scene) -> Alignment:
    return align(standard.ms, standard.pan)


@pytest.fixture(scope="module")
def sample() -> Scene:
    return Scene(SAMPLE / "ms.tif", SAMPLE / "pan.tif", Truth.load(SAMPLE / "truth.json"))


@pytest.fixture(scope="module")
def aligned_sample(sample: Scene) -> Alignment:
    return align(sample.ms, sample.pan)


def check(scene: Scene, alignment: Alignment, limit_px: float = 0.03) -> None:
    assert alignment.verdict.outcome is Outcome.ALIGNED
    assert scene.before_px > 5 * limit_px
    assert scene.rmse_px(alignment.correction.corrected) < limit_px
    assert alignment.accuracy.sigma_corner_px < limit_px


def test_the_sample_pair_is_aligned(sample: Scene, aligned_sample: Alignment) -> None:
    alignment = aligned_sample
    check(sample, alignment, 0.02)
    assert alignment.correction.model == "scale"
    assert alignment.accuracy.check_rmse_px < 0.05
    assert alignment.accuracy.e1_after < 0.2 * alignment.accuracy.e1_before
    assert alignment.accuracy.before_rmse_px == pytest.approx(sample.before_px, abs=0.2)
    assert alignment.warnings == ()


@pytest.mark.parametrize("name", HEADER_ERRORS)
def test_header_errors_are_found(tmp_path: Path, name: str) -> None:
    error, model = HEADER_ERRORS[name]
    scene = make_scene(tmp_path, replace(STANDARD, error=error))
    alignment = align(scene.ms, scene.pan)
    check(scene, alignment)
    assert alignment.correction.model == model
    warned = any("no longer north-up" in warning for warning in alignment.warnings)
    assert warned == (model in ("similarity", "affine"))


@pytest.mark.parametrize(
    ("error", "search"),
    [
        (SHIFT(0.81, -0.63), "header"),
        (SHIFT(45.9, -34.6), "header"),
        (HEADER_ERRORS["rotation 36°"][0], "keypoints"),
        (SHIFT(0.37, -256), "whole"),
    ],
    ids=["near", "far", "rotated", "beyond the radius"],
)
def test_the_report_says_which_search_led_there(tmp_path: Path, error: Affine, search: str) -> None:
    scene = make_scene(tmp_path, replace(STANDARD, error=error))
    alignment = align(scene.ms, scene.pan)
    check(scene, alignment)
    assert report_dict(alignment)["search"] == search


def test_the_search_makes_no_difference_to_the_place(standard: Scene, aligned: Alignment) -> None:
    by_keypoints = align(standard.ms, standard.pan, AlignOptions(search="keypoints"))
    assert by_keypoints.solution.search == "keypoints"
    assert by_keypoints.solution.step_counts["keypoints MS"] > 0
    assert aligned.solution.search == "header"
    check(standard, by_keypoints)
    truth = replace(standard.truth, ms_true=tuple(by_keypoints.correction.corrected)[:6])
    gap = Scene(standard.ms, standard.pan, truth).rmse_px(aligned.correction.corrected)
    assert gap < 0.003


def test_a_calm_pair_needs_neither_scipy_nor_the_net(standard: Scene, tmp_path: Path) -> None:
    """Loading scipy takes longer than the search and the matching together."""
    code = (
        f"import sys, geodelreg; a = geodelreg.align({str(standard.ms)!r}, {str(standard.pan)!r}); "
        f"geodelreg.write(a, {str(tmp_path / 'out.tif')!r}); "
        "found = sorted({'scipy', 'ssl', 'urllib.request'} & {*sys.modules}); "
        "print(a.verdict.outcome.value, found)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split(maxsplit=1) == ["aligned", "[]\n"]


def test_clouds_that_move_are_left_to_keypoints(tmp_path: Path) -> None:
    """Half of the patches lie elsewhere: the header's place is not beyond doubt."""

    def clouds(ms: Pixels, pan: Pixels) -> None:
        rng = np.random.default_rng(5)
        spots = rng.random((6, 3)) * (0.8, 0.8, 0.12) + (0.1, 0.1, 0.08)
        for bands, moved in ((ms, 0.0), (pan[None], 0.05)):
            height, width = bands.shape[1:]
            row, column = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
            for y, x, radius in spots:
                inside = (row - y) ** 2 + (column - x - moved) ** 2 < radius**2
                bands[:, inside] = 9000 + 500 * np.sin(90 * row + 70 * column)[inside]

    scene = make_scene(tmp_path, replace(STANDARD, change=clouds))
    alignment = align(scene.ms, scene.pan)
    check(scene, alignment, 0.06)
    assert alignment.solution.search == "keypoints"


@pytest.mark.parametrize("name", RASTERS)
def test_rasters_may_lie_in_any_way(tmp_path: Path, name: str) -> None:
    scene = make_scene(tmp_path, RASTERS[name])
    alignment = align(scene.ms, scene.pan)
    check(scene, alignment)
    assert alignment.correction.model == "shift"
    assert bool(alignment.crs_operation) == (RASTERS[name].ms_crs != STANDARD.ms_crs)


def test_ms_finer_than_the_reference_is_aligned_and_said(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, Recipe(centred(1, 440), (440, 440), SHIFT(3.3, -2.6), pan_ratio=2))
    alignment = align(scene.ms, scene.pan)
    check(scene, alignment)
    assert any("finer than the reference" in warning for warning in alignment.warnings)


def test_no_data_wedges_are_not_matched(tmp_path: Path) -> None:
    def cut(ms: Pixels, pan: Pixels) -> None:
        for bands, upper_right in ((ms, True), (pan[None], False)):
            height, width = bands.shape[1:]
            row, column = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
            wedge = column - 0.35 * row > 0.7 if upper_right else row - 0.4 * column > 0.7
            bands[:, wedge] = 0

    scene = make_scene(tmp_path, replace(STANDARD, change=cut, nodata=0))
    check(scene, align(scene.ms, scene.pan))


@pytest.mark.parametrize(("empty", "value"), [(1, 700), (3, 0)], ids=["constant", "no data"])
def test_a_band_that_shows_nothing_does_not_matter(tmp_path: Path, empty: int, value: int) -> None:
    def blank(ms: Pixels, pan: Pixels) -> None:
        ms[empty - 1] = value

    scene = make_scene(tmp_path, replace(STANDARD, change=blank, nodata=0))
    alignment = align(scene.ms, scene.pan)
    check(scene, alignment, 0.06)
    assert f"band {empty}" not in alignment.solution.band_weights
    assert any(f"band {empty} of MS" in warning for warning in alignment.warnings)


def test_the_band_asked_for_is_matched(standard: Scene) -> None:
    alignment = align(standard.ms, standard.pan, AlignOptions(band=2))
    check(standard, alignment, 0.1)
    assert list(alignment.solution.band_weights) == ["band 2"]


@pytest.mark.parametrize("model", ["similarity", "affine"])
def test_the_model_asked_for_is_fitted(standard: Scene, model: str) -> None:
    alignment = align(standard.ms, standard.pan, AlignOptions(model=model))
    check(standard, alignment)
    assert alignment.correction.model == model


@pytest.mark.parametrize("radius_px", [60.0, 512.0])
def test_headers_off_by_twice_the_search_radius_are_found(tmp_path: Path, radius_px: float) -> None:
    error = SHIFT(0.37, -2 * radius_px / 4)
    scene = make_scene(tmp_path, replace(STANDARD, error=error))
    check(scene, align(scene.ms, scene.pan, AlignOptions(search_radius_px=radius_px)))


def per_band(folder: Path, scene: Scene) -> list[Path]:
    """One file per band, and a fifth on a coarser grid that shares the header error."""
    with rasterio.open(scene.ms) as ms:
        bands, header = ms.read(), ms.transform
    paths = [
        write(folder / f"B{number}.tif", band[None], header, scene.truth.ms_crs)
        for number, band in enumerate(bands, 1)
    ]
    coarse = bands[:1].reshape(1, 65, 2, 65, 2).mean(axis=(2, 4))
    transform = header @ Affine.scale(2)
    return [*paths, write(folder / "B5.tif", coarse, transform, scene.truth.ms_crs)]


def test_one_file_per_band_gets_the_correction_of_one_file(
    standard: Scene, aligned: Alignment, tmp_path: Path
) -> None:
    files = per_band(tmp_path, standard)
    apart = align(files, standard.pan)
    check(standard, apart)
    assert apart.correction.corrected == aligned.correction.corrected
    assert apart.source.paths == tuple(map(str, files))
    assert list(apart.solution.band_weights) == ["B1", "B2", "B3", "B4"]


def content(alignment: Alignment) -> bytes:
    """All that was found out but the time it took."""
    plain = replace(alignment, timings_s={}, options=AlignOptions())
    points = plain.tie_points
    arrays = [
        getattr(points, name).tobytes()
        for name in ("source_px", "reference_px", "covariance_px2", "score", "status")
    ]
    rest = (plain.correction, plain.accuracy, plain.verdict, dict(plain.solution.step_counts))
    return pickle.dumps((arrays, repr(rest), dict(plain.solution.band_weights), plain.warnings))


def test_threads_and_runs_change_no_byte(standard: Scene, aligned: Alignment) -> None:
    runs = [align(standard.ms, standard.pan, AlignOptions(threads=t)) for t in (1, 2, 1)]
    assert {content(run) for run in runs} == {content(aligned)}


@pytest.mark.parametrize(
    "moved",
    [
        Affine.identity(),
        SHIFT(31.4, -17.7),
        about(Affine.rotation(5), 200),
        about(Affine.scale(1.015), 200),
    ],
    ids=["as aligned", "shifted", "rotated", "scaled"],
)
def test_the_same_place_is_found_from_other_headers(
    sample: Scene, aligned_sample: Alignment, tmp_path: Path, moved: Affine
) -> None:
    """Aligning what is aligned moves it by nearly nothing, from anywhere it goes back there."""
    first = aligned_sample.correction.corrected
    with rasterio.open(sample.ms) as ms:
        again = write(tmp_path / "ms.tif", ms.read(), first @ moved, sample.truth.ms_crs)
    second = align(again, sample.pan)
    same = replace(sample.truth, ms_true=tuple(first)[:6])
    gap = Scene(again, sample.pan, same).rmse_px(second.correction.corrected)
    if moved == Affine.identity():
        assert second.verdict.outcome is Outcome.ALREADY_ALIGNED
        assert second.correction.corrected == first
    assert gap < 0.02


def test_progress_only_grows(standard: Scene) -> None:
    seen: list[tuple[float, str]] = []
    align(standard.ms, standard.pan, progress=lambda fraction, step: seen.append((fraction, step)))
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] < fractions[-1] == 1.0
    assert all(step for _, step in seen)


def test_the_ground_of_the_scenes_is_real_texture() -> None:
    assert ground().bands.shape == (4, 800, 800)
    assert (ground().bands.std(axis=(1, 2)) > 100).all()
