"""Bands that lie apart: each is corrected by itself, in headers or by resampling."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner
from numpy.typing import NDArray
from scipy import ndimage

import geodelreg
from benchmarks.scenes.imagery import sample_imagery
from benchmarks.scenes.make import HeaderError, Scene, SceneSpec, make_scene, write_scene
from geodelreg import Alignment, AlignOptions, WriteOptions
from geodelreg.errors import AlignmentRefusedError, CorrectionMisfitError, UsageError
from geodelreg.product.report import report_dict, report_schema
from geodelreg_cli.main import cli

Array = NDArray[np.float64]
RATIO = 4.0
SPEC = SceneSpec("apart", "", HeaderError((2.3, -1.7)), (800, 800), (180, 180), ratio=RATIO)
SHIFTS_PX = ((0.0, 0.0), (0.9, -0.3), (1.5, 0.4), (-0.2, 1.8))
"""Of the content of each band, PAN pixels to the right and down."""


@dataclass(frozen=True)
class Made:
    """Two files, their truth and what was found out."""

    ms: Path
    pan: Path
    scene: Scene
    alignment: Alignment

    def pan_px(self, transform: Affine, at: Array) -> Array:
        """(N, 2) PAN pixels of MS pixels by a geotransform of MS."""
        step = ~Affine(*self.scene.truth.pan) @ transform
        return np.stack(step @ (at[:, 0], at[:, 1]), axis=1)


def made(folder: Path, shifts: tuple[tuple[float, float], ...]) -> Made:
    scene = make_scene(SPEC, sample_imagery(), band_shifts=shifts)
    write_scene(scene, folder)
    files = folder / "ms.tif", folder / "pan.tif"
    return Made(*files, scene, geodelreg.align(*files, AlignOptions(per_band=True)))


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return made(tmp_path_factory.mktemp("apart"), SHIFTS_PX)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return made(tmp_path_factory.mktemp("twin"), ((0.0, 0.0),) * 4)


def lattice() -> Array:
    axis = np.linspace(5, 175, 12)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def errors_px(made: Made, shifts: tuple[tuple[float, float], ...]) -> list[Array]:
    """(N, 2) of each band, PAN pixels, over the raster."""
    at, truth = lattice(), Affine(*made.scene.truth.ms_true)
    header = Affine(*made.scene.truth.ms_header)
    return [
        made.pan_px(header, band.map.forward(at)) - made.pan_px(truth, at) - np.array(shift)
        for band, shift in zip(made.alignment.solution.bands, shifts, strict=True)
    ]


def rms(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=-1).mean()))


def test_each_band_is_put_where_it_lies(apart: Made, twin: Made) -> None:
    """But for what the bands of the imagery itself are apart, which the unshifted twin shows."""
    moved, still = (
        np.array([error.mean(axis=0) for error in errors_px(*one)])
        for one in ((apart, SHIFTS_PX), (twin, ((0.0, 0.0),) * 4))
    )
    assert np.hypot(*(moved - still).T).max() < 0.03
    for band, gap in zip(apart.alignment.solution.bands, moved - still, strict=True):
        assert np.hypot(*gap) < 4 * band.sigma_px
        assert band.sigma_px < 0.1
    assert apart.alignment.verdict.accepted


def test_bands_of_one_image_lie_where_the_truth_says(tmp_path: Path) -> None:
    """Whatever their tone; bands of real imagery lie apart, and no truth says by how much."""
    sample = sample_imagery()
    green = np.clip(sample.bands[1] / 4095, 0, 1)
    tones = np.stack([4095 * green**power for power in (0.8, 1.0, 1.2, 1.5)]).astype(np.float32)
    scene = make_scene(SPEC, replace(sample, bands=tones), band_shifts=SHIFTS_PX)
    write_scene(scene, tmp_path)
    files = tmp_path / "ms.tif", tmp_path / "pan.tif"
    found = Made(*files, scene, geodelreg.align(*files, AlignOptions(per_band=True)))
    errors = [rms(error) for error in errors_px(found, SHIFTS_PX)]
    assert len(errors) == len(SHIFTS_PX)
    assert max(errors) < 0.05
    assert np.median(errors) < 0.03
    sigma = [band.sigma_px for band in found.alignment.solution.bands]
    assert (np.array(errors) < 3 * np.hypot(sigma, found.alignment.accuracy.systematic_px)).all()


def test_without_it_the_refusal_names_it(apart: Made) -> None:
    with pytest.raises(AlignmentRefusedError, match="two MS bands") as caught:
        geodelreg.align(apart.ms, apart.pan)
    assert "per_band=True" in caught.value.remedy


def test_the_report_tells_of_each_band(apart: Made) -> None:
    report = json.loads(json.dumps(report_dict(apart.alignment)))
    jsonschema.validate(report, report_schema())
    shifts = np.array([band["shift_px"] for band in report["bands"]])
    assert np.abs(shifts - shifts[0] - np.array(SHIFTS_PX) + SHIFTS_PX[0]).max() < 1.0


@pytest.mark.parametrize("name", ["bands", "out.vrt", "out.tif"])
def test_the_report_applies_to_each_band_as_the_alignment_did(
    apart: Made, tmp_path: Path, name: str
) -> None:
    report, ours, theirs = (tmp_path / part for part in ("r.json", "one", "other"))
    geodelreg.write_report(apart.alignment, report)
    for folder in (ours, theirs):
        folder.mkdir()
    warp = name.endswith("tif")
    geodelreg.write(apart.alignment, theirs / name, warp=warp)
    command = ["apply", str(report), str(apart.ms), "-o", str(ours / name), "-q"]
    run = CliRunner().invoke(cli, [*command, *(["--warp"] if warp else [])])
    assert run.exit_code == 0, run.output
    found, expected = (
        sorted((folder / name).iterdir()) if name == "bands" else [folder / name]
        for folder in (ours, theirs)
    )
    assert [path.name for path in found] == [path.name for path in expected]
    for one, other in zip(found, expected, strict=True):
        with rasterio.open(one) as a, rasterio.open(other) as b:
            assert a.transform.almost_equals(b.transform, 1e-6)
            assert np.abs(a.read().astype(float) - b.read()).max() <= 1


@pytest.mark.parametrize("name", ["points.geojson", "points.gpkg", "points.csv"])
def test_exported_points_tell_their_band_and_refit_each(
    apart: Made, tmp_path: Path, name: str
) -> None:
    points, bands = tmp_path / name, apart.alignment.solution.bands
    geodelreg.export_gcps(apart.alignment, points)
    common = geodelreg.refit(points, apart.ms, apart.pan, model="shift")
    at = lattice()
    gap = common.solution.map.forward(at) - apart.alignment.solution.map.forward(at)
    assert np.abs(gap).max() < 1e-6
    for band in bands:
        one = geodelreg.refit(points, apart.ms, apart.pan, model="shift", band=band.number)
        assert np.abs(one.solution.map.forward(at) - band.map.forward(at)).max() < 1e-3
        assert len(one.tie_points) == apart.alignment.accuracy.kept
    geodelreg.export_gcps(apart.alignment, tmp_path / "plain.points")
    lines = (tmp_path / "plain.points").read_text("utf-8").splitlines()
    assert len(lines) == apart.alignment.accuracy.kept + 2


def test_check_shares_the_estimate_and_searches_once(
    apart: Made, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", "geodelreg"):
        found = geodelreg.check(apart.ms, apart.pan, per_band=True)
    assert sum(record.getMessage().startswith("guess from") for record in caplog.records) == 1
    said = report_dict(apart.alignment)["bands"]
    assert found.bands is not None
    assert [band.number for band in found.bands] == [band["number"] for band in said]
    for band, other in zip(found.bands, said, strict=True):
        assert np.abs(np.subtract(band.shift_px, other["shift_px"])).max() < 1e-9
        assert band.sigma_px == other["sigma_px"]
        assert 0.4 < band.correlation <= 1  # infrared shows half of what PAN does
    assert found.raster_outcome.value == "cannot_tell"
    assert "PAN px at least between the places of two MS bands" in found.reason


def test_what_has_no_such_bands_is_not_corrected_by_them(apart: Made, tmp_path: Path) -> None:
    report, mask = tmp_path / "r.json", tmp_path / "mask.tif"
    geodelreg.write_report(apart.alignment, report)
    with (
        rasterio.open(apart.ms) as ms,
        rasterio.open(mask, "w", **ms.profile | {"count": 1}) as out,
    ):
        out.write(ms.read(1), 1)
    (tmp_path / "points.csv").write_text("x,y\n1,2\n")
    with pytest.raises(CorrectionMisfitError, match=r"mask\.tif has 1 bands"):
        geodelreg.apply(report, mask, tmp_path / "out")
    with pytest.raises(UsageError, match="has no bands"):
        geodelreg.apply(report, tmp_path / "points.csv", tmp_path / "out.csv")
    with pytest.raises(UsageError, match="one for all"):
        geodelreg.apply(report, apart.ms)
    assert not list(tmp_path.glob("out*"))


def test_each_file_of_a_folder_has_its_header_and_the_same_pixels(
    apart: Made, tmp_path: Path
) -> None:
    out = tmp_path / "bands"
    command = ["align", str(apart.ms), str(apart.pan), "--per-band", "-q", "-o", str(out)]
    run = CliRunner().invoke(cli, command)
    assert run.exit_code == 0, run.output
    with rasterio.open(apart.ms) as ms:
        pixels, header = ms.read(), ms.transform
    files = sorted(out.iterdir())
    assert len(files) == len(SHIFTS_PX)
    for path, band, data in zip(files, apart.alignment.solution.bands, pixels, strict=True):
        with rasterio.open(path) as dataset:
            assert dataset.count == 1
            assert (dataset.read(1) == data).all()
            affine = band.map.as_affine()
            assert affine is not None
            assert dataset.transform.almost_equals(header @ affine, 1e-6)


def resampled(apart: Made, number: int, grid: rasterio.DatasetReader) -> Array:
    """Band of MS on a grid, by scipy's bilinear interpolation where the band lies."""
    affine = apart.alignment.solution.bands[number - 1].map.as_affine()
    assert affine is not None
    with rasterio.open(apart.ms) as ms:
        back = ~(ms.transform @ affine) @ grid.transform
        source = ms.read(number).astype(float)
    rows, columns = np.mgrid[: grid.height, : grid.width] + 0.5
    x, y = back @ (columns.ravel(), rows.ravel())
    found = ndimage.map_coordinates(source, [y - 0.5, x - 0.5], order=1)
    return np.asarray(found.reshape(grid.shape))


@pytest.mark.parametrize("name", ["out.tif", "out.vrt"])
def test_bands_are_resampled_to_where_they_lie(apart: Made, tmp_path: Path, name: str) -> None:
    out, warp = tmp_path / name, name.endswith("tif")
    geodelreg.write(apart.alignment, out, WriteOptions(warp=warp, resampling="bilinear"))
    with rasterio.open(out) as dataset:
        assert dataset.count == len(SHIFTS_PX)
        inner = slice(10, min(dataset.shape) - 10)
        for number in dataset.indexes:
            got = dataset.read(number).astype(float)[inner, inner]
            expected = resampled(apart, number, dataset)[inner, inner]
            assert np.std(got - expected) < 0.02 * np.std(expected)


def test_what_has_one_place_for_all_bands_is_refused(apart: Made, tmp_path: Path) -> None:
    for target in (tmp_path / "out.tif", tmp_path / "out.jp2"):
        with pytest.raises(UsageError, match="one for all"):
            geodelreg.write(apart.alignment, target)
    with pytest.raises(UsageError, match="one for all"):
        geodelreg.write_in_place(apart.alignment)
    with pytest.raises(UsageError, match="each band"):
        AlignOptions(per_band=True, band=2)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["sharp.tif", "sharp.vrt"])
def test_each_band_is_sharpened_where_it_lies(apart: Made, tmp_path: Path, name: str) -> None:
    """As what `write` has resampled onto PAN's grid, sharpened as it is."""
    onto = tmp_path / "onto.tif"
    geodelreg.write(apart.alignment, onto, warp=True, warp_grid="pan")
    geodelreg.pansharpen(onto, apart.pan, tmp_path / "expected.tif", weights="equal")
    out = tmp_path / name
    geodelreg.pansharpen(apart.ms, apart.pan, out, weights="equal", alignment=apart.alignment)
    with rasterio.open(out) as sharp, rasterio.open(tmp_path / "expected.tif") as expected:
        covered = (sharp.dataset_mask() > 0) & (expected.dataset_mask() > 0)
        assert covered.mean() > 0.2
        gap = np.abs(sharp.read().astype(float) - expected.read())[:, covered]
    assert np.quantile(gap, 0.999) <= 1
