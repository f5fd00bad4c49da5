"""Pairs that bend: followed by a field, resampled once, refused where nothing can carry that."""

from __future__ import annotations

import json
from dataclasses import dataclass
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
from benchmarks.gate.bent_cases import BentPair
from benchmarks.gate.distortions import waves
from benchmarks.scenes.imagery import sample_imagery
from benchmarks.scenes.make import Bend, HeaderError, SceneSpec, make_scene, write_scene
from benchmarks.scenes.truth import check_points
from geodelreg import Alignment, AlignOptions, WriteOptions
from geodelreg.errors import AlignmentRefusedError, UsageError
from geodelreg.geo.maps.field import FieldMap
from geodelreg.product.gcps import gcp_context, gcps_from_alignment, write_gcps
from geodelreg.product.report import report_dict, report_schema
from geodelreg_cli.main import cli

Array = NDArray[np.float64]
SHAPE = (640, 640)
RATIO = 2.0
MS_PX, PATCH_PX = 295, 20  # no multiple
SPEC = SceneSpec("bent", "", HeaderError((1.3, -0.7)), SHAPE, (MS_PX, MS_PX), ratio=RATIO)


@dataclass(frozen=True)
class Made:
    """Two files, and what is true of them."""

    ms: Path
    pan: Path
    pair: BentPair

    def errors_px(self, alignment: Alignment, at: Array) -> Array:
        """(N, 2) PAN pixels."""
        truth = self.pair.scene.truth
        header_px = alignment.solution.map.forward(at)
        found = self.pair.to_pan(truth, Affine(*truth.ms_header), header_px)
        return np.asarray(found - self.pair.pan_px(at))

    def source_px(self, pan_px: Array) -> Array:
        """(N, 2) MS pixels of PAN pixels, by the truth turned round."""
        truth = self.pair.scene.truth
        start = ~Affine(*truth.ms_true) @ Affine(*truth.pan)
        at = np.stack(start @ (pan_px[:, 0], pan_px[:, 1]), axis=1)
        for _ in range(30):
            at -= (self.pair.pan_px(at) - pan_px) / RATIO
        return at


def made(folder: Path, bend: Bend) -> Made:
    scene = make_scene(SPEC, sample_imagery(), bend)
    write_scene(scene, folder)
    return Made(folder / "ms.tif", folder / "pan.tif", BentPair(scene, bend))


@pytest.fixture(scope="module")
def wavy(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return made(tmp_path_factory.mktemp("wavy"), waves(2.0, 400.0, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def followed(wavy: Made) -> Alignment:
    return geodelreg.align(wavy.ms, wavy.pan, AlignOptions(on_local="field"))


def rms(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=-1).mean()))


def test_waves_are_followed_and_the_standard_error_is_right(
    wavy: Made, followed: Alignment
) -> None:
    assert followed.solution.model == "field"
    at = check_points(wavy.pair.scene.truth.ms_shape)
    error = wavy.errors_px(followed, at)
    assert rms(error) < 0.04
    assert rms(error) < 0.05 * rms(wavy.pair.errors(wavy.pair.best_affine()))
    sigma = RATIO * followed.solution.map.sigma_at(at)
    assert 0.5 < np.sqrt(((error**2).sum(axis=1) / sigma**2).mean()) < 1.6
    assert followed.accuracy.check_rmse_px < 0.1
    assert followed.accuracy.residual_rms_px < 0.1


def test_its_points_reach_the_borders(followed: Alignment) -> None:
    points = followed.tie_points
    at = points.source_px[points.kept]
    assert (at.min(axis=0) <= PATCH_PX / 2).all()
    assert (at.max(axis=0) >= MS_PX - PATCH_PX / 2).all()


def test_facets_follow_worse_and_say_so(wavy: Made, followed: Alignment) -> None:
    facets = geodelreg.align(wavy.ms, wavy.pan, model="tin")
    assert facets.solution.model == "tin"
    at = check_points(wavy.pair.scene.truth.ms_shape)
    error, best = wavy.errors_px(facets, at), wavy.errors_px(followed, at)
    assert 2 * rms(best) < rms(error) < 0.3
    sigma = RATIO * facets.solution.map.sigma_at(at)
    assert 0.5 < np.sqrt(((error**2).sum(axis=1) / sigma**2).mean()) < 1.6


def test_without_an_output_for_it_the_refusal_names_what_carries_a_field(wavy: Made) -> None:
    with pytest.raises(AlignmentRefusedError, match="of the ground's bend") as caught:
        geodelreg.align(wavy.ms, wavy.pan)
    assert "`warp=True`" in caught.value.remedy


def test_the_report_holds_the_map_itself(followed: Alignment) -> None:
    report = json.loads(json.dumps(report_dict(followed)))
    jsonschema.validate(report, report_schema())
    again = FieldMap.from_json(report["correction"]["pixel_map"])
    at = check_points((300, 300))
    assert np.abs(again.forward(at) - followed.solution.map.forward(at)).max() < 1e-9
    assert np.abs(again.sigma_at(at) - followed.solution.map.sigma_at(at)).max() < 1e-9


def exported(alignment: Alignment, path: Path) -> Path:
    """All its points, the rejected ones too."""
    points = gcps_from_alignment(alignment, every=True)
    write_gcps(path, points, context=gcp_context(alignment, every=True))
    return path


@pytest.mark.parametrize("name", ["all.geojson", "all.gpkg", "all.fgb"])
def test_unedited_points_give_the_field_again(
    wavy: Made, followed: Alignment, tmp_path: Path, name: str
) -> None:
    at = np.random.default_rng(1).uniform(-20, 320, (500, 2))
    true = followed.solution.map
    points = exported(followed, tmp_path / name)
    for model in ("auto", "field"):
        again = geodelreg.refit(points, wavy.ms, wavy.pan, model=model).solution
        assert again.model == "field"
        assert np.abs(again.map.forward(at) - true.forward(at)).max() < 1e-6
        assert np.abs(again.map.sigma_at(at) - true.sigma_at(at)).max() < 1e-6
    affine = geodelreg.refit(points, wavy.ms, wavy.pan, model="affine").solution
    assert rms(affine.map.forward(at) - true.forward(at)) > 0.3


def test_an_edit_moves_the_field_there_alone(
    wavy: Made, followed: Alignment, tmp_path: Path
) -> None:
    layer = exported(followed, tmp_path / "all.geojson")
    document = json.loads(layer.read_text("utf-8"))
    told = [f["properties"] for f in document["features"] if f["properties"]["enable"]]
    edited = min(told, key=lambda point: np.hypot(point["row"] - 150, point["col"] - 150))
    edited["x"] += 10.0
    edited["sigma_x"] = edited["sigma_y"] = None
    layer.write_text(json.dumps(document), "utf-8")
    after = geodelreg.refit(layer, wavy.ms, wavy.pan).solution
    at = np.array([(point["col"], point["row"]) for point in told])
    gap = np.hypot(*(after.map.forward(at) - followed.solution.map.forward(at)).T)
    away = np.hypot(*(at - (edited["col"], edited["row"])).T)
    assert 0 < gap[away < 1].max() < 0.5
    assert gap[away > 100].max() < 0.1 * gap[away < 1].max()


def test_the_command_warps_it_onto_the_grid_of_pan(wavy: Made, tmp_path: Path) -> None:
    """MS where it truly lies, looked up by scipy's spline of order 3, is what is written."""
    out, report = tmp_path / "out.tif", tmp_path / "out.json"
    command = ["align", str(wavy.ms), str(wavy.pan), "-o", str(out), "--report", str(report)]
    run = CliRunner().invoke(cli, [*command, "--warp", "--grid", "pan", "-r", "bilinear", "-q"])
    assert run.exit_code == 0, run.output
    assert json.loads(report.read_text("utf-8"))["correction"]["model"] == "field"
    rows, columns = np.mgrid[60:580:3, 60:580:3]
    at = wavy.source_px(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5) - 0.5
    with rasterio.open(wavy.ms) as dataset:
        source = dataset.read(2).astype(float)
    expected = ndimage.map_coordinates(source, [at[:, 1], at[:, 0]], order=1)
    with rasterio.open(out) as dataset, rasterio.open(wavy.pan) as pan:
        assert (dataset.transform, dataset.shape) == (pan.transform, pan.shape)
        got = dataset.read(2)[rows, columns].ravel().astype(float)
    scatter = float(np.std(got - expected) / np.std(expected))
    assert scatter < 0.02


def test_on_its_own_grid_it_is_written_too(followed: Alignment, tmp_path: Path) -> None:
    geodelreg.write(followed, tmp_path / "out.tif", WriteOptions(warp=True))
    with rasterio.open(tmp_path / "out.tif") as dataset:
        assert dataset.tags()["GEODELREG_MODEL"] == "field"
        assert (dataset.read_masks(1) > 0).mean() > 0.9


def test_sharpening_resamples_once_through_it(wavy: Made, tmp_path: Path) -> None:
    """MS where it truly lies, by scipy, times PAN over the mean of its bands; a VRT is refused."""
    out, pair = tmp_path / "sharp.tif", [str(wavy.ms), str(wavy.pan)]
    with_equal = ["--weights", "equal", "-r", "bilinear", "--extent", "intersection", "-q"]
    run = CliRunner().invoke(cli, ["pansharpen", *pair, "-o", str(out), *with_equal])
    assert run.exit_code == 0, run.output
    rows, columns = np.mgrid[60:580:3, 60:580:3]
    at = wavy.source_px(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5) - 0.5
    with rasterio.open(wavy.ms) as dataset:
        bands = [band.astype(float) for band in dataset.read()]
    placed = np.stack([ndimage.map_coordinates(b, [at[:, 1], at[:, 0]], order=1) for b in bands])
    with rasterio.open(out) as dataset, rasterio.open(wavy.pan) as pan:
        assert dataset.tags()["GEODELREG_MODEL"] == "field"
        left, top = (round(v) for v in ~pan.transform @ (dataset.transform.c, dataset.transform.f))
        brightness = pan.read(1)[rows, columns].ravel()
        got = dataset.read()[:, rows - top, columns - left].reshape(len(bands), -1)
    expected = placed * brightness / placed.mean(axis=0)
    assert np.std(got - expected) < 0.02 * np.std(expected)


def test_a_lazy_raster_holds_none(wavy: Made, followed: Alignment, tmp_path: Path) -> None:
    out = tmp_path / "sharp.vrt"
    with pytest.raises(UsageError, match="no geotransform in it holds `model='field'`"):
        geodelreg.pansharpen(wavy.ms, wavy.pan, out, alignment=followed)
    asked = ["pansharpen", "no.tif", "none.tif", "-o", str(out), "--model", "field"]
    assert isinstance(CliRunner().invoke(cli, asked).exception, UsageError)  # before the work
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("way", [["-o", "out.tif"], ["--in-place"]])
@pytest.mark.parametrize("asked", [["--model", "field"], ["--on-local", "field"]])
def test_a_header_is_refused_before_the_work(way: list[str], asked: list[str]) -> None:
    """Before it looks for the files, which do not exist."""
    run = CliRunner().invoke(cli, ["align", "no.tif", "none.tif", *asked, *way])
    assert isinstance(run.exception, UsageError)
    assert run.exception.exit_code == 2
    assert "`warp=True`" in run.exception.remedy


def test_no_header_is_written(followed: Alignment, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no header, can hold it"):
        geodelreg.write(followed, tmp_path / "out.tif")
    with pytest.raises(UsageError):
        geodelreg.write_in_place(followed)
    assert not list(tmp_path.iterdir())


def test_other_methods_know_no_field() -> None:
    with pytest.raises(UsageError, match="knows no field"):
        AlignOptions(model="field", method="sift")


def test_too_few_points_determine_no_field(tmp_path: Path) -> None:
    small = SceneSpec("small", "", HeaderError((1.3, -0.7)), (150, 150), (42, 42), ratio=RATIO)
    write_scene(make_scene(small, sample_imagery()), tmp_path)
    with pytest.raises(AlignmentRefusedError) as caught:
        geodelreg.align(tmp_path / "ms.tif", tmp_path / "pan.tif", AlignOptions(model="field"))
    alignment = caught.value.alignment
    assert alignment is not None
    assert not alignment.verdict.accepted


def test_where_one_affine_is_the_truth_nothing_changes(tmp_path: Path) -> None:
    write_scene(make_scene(SPEC, sample_imagery()), tmp_path)
    files = tmp_path / "ms.tif", tmp_path / "pan.tif"
    plain = geodelreg.align(*files)
    may_bend = geodelreg.align(*files, AlignOptions(on_local="field"))
    assert may_bend.solution.model == plain.solution.model != "field"
    assert may_bend.correction == plain.correction  # to the last bit
    assert (may_bend.tie_points.residual_px == plain.tie_points.residual_px).all()
