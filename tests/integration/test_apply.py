"""A correction that was found before, for rasters, vectors and point lists of the same scene."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner
from numpy.typing import NDArray
from pyproj import Transformer

import geodelreg
from geodelreg import Alignment, AlignOptions, WriteOptions
from geodelreg.errors import (
    CorrectionMisfitError,
    LossyOutputError,
    ReportError,
    UsageError,
)
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.kriging import Kernel
from geodelreg.product.report import report_json
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import NO_TIE_POINTS
from geodelreg.values.raster import Grid
from geodelreg.values.result import Accuracy, Input, Outcome, Solution, Verdict
from geodelreg_cli.main import cli

Array = NDArray[np.float64]
UTM18 = rasterio.crs.CRS.from_epsg(32618).to_wkt()
UTM19 = rasterio.crs.CRS.from_epsg(32619).to_wkt()
HEADER = Affine(4.0, 0.0, 700_000.0, 0.0, -4.0, 4_500_000.0)
SIDE = 60
AFFINE = Affine(1.001, 0.002, 1.5, -0.001, 0.999, -0.75)
"""MS pixels to header pixels."""


def field() -> FieldMap:
    axis = np.arange(2.5, SIDE, 5.0)
    xy = np.stack([v.ravel() for v in np.meshgrid(axis, axis)], axis=1)
    target = xy + 0.5 * np.sin(2 * np.pi * xy[:, ::-1] / 50.0)
    return FieldMap(xy, target, np.full(xy.shape, 1e-8), Kernel(40.0, (0.2, 0.2), 0.0))


def raster(path: Path, grid: Grid, **profile: Any) -> Path:
    height, width = grid.shape
    settings = {"driver": "GTiff", "height": height, "width": width, "count": 2}
    settings |= {"dtype": "uint16", "crs": grid.crs_wkt, "transform": grid.transform}
    rows, columns = np.mgrid[:height, :width]
    with rasterio.open(path, "w", **settings | profile) as dataset:
        dataset.write((100 + 10 * np.stack([columns, rows])).astype(np.uint16))
    return path


def alignment_of(ms: Path, pan: Path, model: str, found: PixelMap) -> Alignment:
    """As `geodelreg.align` returns it, of a map that is known."""
    inputs = []
    for path in (ms, pan):
        with rasterio.open(path) as dataset:
            grid = Grid(dataset.transform, dataset.shape, dataset.crs.to_wkt())
        inputs.append(Input((str(path),), grid, ("",)))
    verdict = Verdict(Outcome.ALIGNED)
    solution = Solution(model, found, NO_TIE_POINTS, Accuracy(), verdict, {})
    return Alignment(*inputs, solution, AlignOptions())


@pytest.fixture
def scene(tmp_path: Path) -> tuple[Path, Path]:
    """MS and PAN."""
    ms = raster(tmp_path / "ms.tif", Grid(HEADER, (SIDE, SIDE), UTM18))
    fine = Grid(Affine(1.0, 0.0, 700_000.0, 0.0, -1.0, 4_500_000.0), (240, 240), UTM18)
    return ms, raster(tmp_path / "pan.tif", fine)


def stored(scene: tuple[Path, Path], model: str) -> tuple[Alignment, Path]:
    """An alignment and its report."""
    found: PixelMap = field() if model == "field" else AffineMap(AFFINE)
    alignment = alignment_of(*scene, model, found)
    report = scene[0].with_name(f"{model}.json")
    report.write_text(report_json(alignment), "utf-8")
    return alignment, report


def true_ground(alignment: Alignment, xy: Array) -> Array:
    """(N, 2) corrected map coordinates of map coordinates under the header of MS."""
    at = np.stack(~HEADER @ (xy[:, 0], xy[:, 1]), axis=1)
    there = alignment.solution.map.forward(at)
    return np.stack(HEADER @ (there[:, 0], there[:, 1]), axis=1)


@pytest.mark.parametrize("grid", ["ms", "pan"])
@pytest.mark.parametrize("model", ["affine", "field"])
def test_on_the_raster_itself_it_does_what_the_alignment_did(
    scene: tuple[Path, Path], model: str, grid: str
) -> None:
    alignment, report = stored(scene, model)
    options = WriteOptions(warp=True, warp_grid=grid)
    one, other = (scene[0].with_name(name) for name in ("one.tif", "other.tif"))
    geodelreg.write(alignment, one, options)
    geodelreg.apply(report, scene[0], other, options)
    with rasterio.open(one) as first, rasterio.open(other) as second:
        assert first.shape == second.shape
        px = np.array(~first.transform @ second.transform)[:6]
        assert np.abs(px - (1, 0, 0, 0, 1, 0)).max() < 1e-6
        np.testing.assert_array_equal(first.read(), second.read())


def test_an_affine_corrects_the_header_of_a_raster_of_another_size(
    scene: tuple[Path, Path],
) -> None:
    alignment, report = stored(scene, "affine")
    coarse = Grid(HEADER @ Affine.translation(4, 6) @ Affine.scale(2.5), (20, 20), UTM18)
    mask = raster(scene[0].with_name("mask.tif"), coarse)
    before = mask.read_bytes()
    geodelreg.apply(report, mask, mask.with_name("out.tif"))
    at = np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0], [7.0, 3.0]])
    header = np.stack(coarse.transform @ (at[:, 0], at[:, 1]), axis=1)
    with rasterio.open(mask.with_name("out.tif")) as out, rasterio.open(mask) as source:
        got = np.stack(out.transform @ (at[:, 0], at[:, 1]), axis=1)
        np.testing.assert_array_equal(out.read(), source.read())
    np.testing.assert_allclose(got, true_ground(alignment, header), rtol=0, atol=4e-6)
    geodelreg.apply(report, mask)
    with rasterio.open(mask) as placed:
        got = np.stack(placed.transform @ (at[:, 0], at[:, 1]), axis=1)
    np.testing.assert_allclose(got, true_ground(alignment, header), rtol=0, atol=4e-6)
    geodelreg.revert(mask)
    assert mask.read_bytes() == before


def test_a_raster_in_another_crs_is_moved_on_the_same_ground(scene: tuple[Path, Path]) -> None:
    alignment, report = stored(scene, "affine")
    to19 = Transformer.from_crs(UTM18, UTM19, always_xy=True)
    x, y = to19.transform(700_000.0, 4_500_000.0)
    there = Grid(Affine(8.0, 0.0, x, 0.0, -8.0, y), (30, 30), UTM19)
    mask = raster(scene[0].with_name("mask.tif"), there)
    geodelreg.apply(report, mask, mask.with_name("out.tif"))
    at = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0], [15.0, 15.0]])
    header = np.stack(there.transform @ (at[:, 0], at[:, 1]), axis=1)
    in18 = np.stack(to19.transform(*header.T, direction="INVERSE"), axis=1)
    expected = np.stack(to19.transform(*true_ground(alignment, in18).T), axis=1)
    with rasterio.open(mask.with_name("out.tif")) as out:
        got = np.stack(out.transform @ (at[:, 0], at[:, 1]), axis=1)
    np.testing.assert_allclose(got, expected, rtol=0, atol=0.01)


def test_control_points_carry_a_field_for_gdals_thin_plate_spline(
    scene: tuple[Path, Path],
) -> None:
    alignment, _ = stored(scene, "field")
    out = scene[0].with_name("gcps.tif")
    geodelreg.write(alignment, out, WriteOptions(georef="gcps"))
    with rasterio.open(out) as dataset:
        points, _ = dataset.gcps
    at = np.random.default_rng(0).uniform(0, SIDE, (300, 2))
    header = np.stack(HEADER @ (at[:, 0], at[:, 1]), axis=1)
    expected = true_ground(alignment, header)
    with rasterio.transform.GCPTransformer(points, tps=True) as spline:
        got = np.stack(spline.xy(at[:, 1], at[:, 0], offset="ul"), axis=1)
        rows, columns = spline.rowcol(*expected.T, op=np.positive)
    assert np.hypot(*(got - expected).T).max() < 0.02 * 4.0
    assert np.hypot(columns - at[:, 0], rows - at[:, 1]).max() < 0.02


def test_a_jump_is_no_thin_plate_spline(scene: tuple[Path, Path]) -> None:
    alignment, _ = stored(scene, "field")
    smooth = alignment.solution.map
    assert isinstance(smooth, FieldMap)
    target = smooth.target + np.where(smooth.source[:, 1:] > 30, [[0.8, 0.6]], 0.0)
    torn = replace(smooth, target=target, jumps=(30.0,))
    alignment = replace(alignment, solution=replace(alignment.solution, map=torn))
    with pytest.raises(LossyOutputError, match="thin plate spline") as refused:
        geodelreg.write(alignment, scene[0].with_name("out.tif"), WriteOptions(georef="gcps"))
    assert "`warp=True`" in refused.value.remedy
    assert not scene[0].with_name("out.tif").exists()


def test_a_field_needs_warp(scene: tuple[Path, Path]) -> None:
    _, report = stored(scene, "field")
    for target in (scene[0].with_name("out.tif"), None):
        with pytest.raises(UsageError, match="no header, can hold it") as refused:
            geodelreg.apply(report, scene[0], target)
        assert "`warp=True`" in refused.value.remedy
    assert not scene[0].with_name("out.tif").exists()


@pytest.mark.parametrize("model", ["affine", "field"])
def test_geojson_gets_corrected_coordinates_and_keeps_the_rest(
    scene: tuple[Path, Path], model: str
) -> None:
    alignment, report = stored(scene, model)
    to84 = Transformer.from_crs(UTM18, "OGC:CRS84", always_xy=True)
    header = np.array(
        [[700_040.0, 4_499_960.0], [700_200.0, 4_499_800.0], [700_100.0, 4_499_900.0]]
    )
    lonlat = np.stack(to84.transform(*header.T), axis=1).tolist()
    features = [
        {"type": "Feature", "properties": {"name": "é"}, "bbox": [0, 0, 1, 1],
         "geometry": {"type": "Polygon", "coordinates": [[*lonlat, lonlat[0]]]}},
        {"type": "Feature", "properties": {}, "geometry": None},
        {"type": "Feature", "properties": {},
         "geometry": {"type": "Point", "coordinates": [*lonlat[0], 12.5]}},
    ]  # fmt: skip
    path = scene[0].with_name("fields.geojson")
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), "utf-8")
    out = path.with_name("out.geojson")
    run = CliRunner().invoke(cli, ["apply", str(report), str(path), "-o", str(out), "-q"])
    assert run.exit_code == 0, run.output
    polygon, nothing, point = json.loads(out.read_text("utf-8"))["features"]
    expected = np.stack(to84.transform(*true_ground(alignment, header).T), axis=1)
    ring = np.array(polygon["geometry"]["coordinates"][0])
    assert np.abs(ring[:3] - expected).max() < 1e-10  # 10 µm
    assert polygon["properties"] == {"name": "é"}
    assert "bbox" not in polygon
    assert nothing["geometry"] is None
    assert point["geometry"]["coordinates"][2] == 12.5


def test_points_in_a_csv_file_too(scene: tuple[Path, Path]) -> None:
    alignment, report = stored(scene, "field")
    path = scene[0].with_name("points.csv")
    path.write_text("id;X;Y\na;700040.0;4499960.0\nb;700200.0;4499800.0\n", "utf-8")
    geodelreg.apply(report, path, path.with_name("out.csv"))
    with path.with_name("out.csv").open(newline="") as file:
        head, *rows = csv.reader(file, delimiter=";")
    assert head == ["id", "X", "Y"]
    assert [row[0] for row in rows] == ["a", "b"]
    got = np.array([row[1:] for row in rows], dtype=float)
    header = np.array([[700_040.0, 4_499_960.0], [700_200.0, 4_499_800.0]])
    assert np.abs(got - true_ground(alignment, header)).max() < 4e-6


def test_layers_of_a_geopackage_too(scene: tuple[Path, Path]) -> None:
    pyogrio = pytest.importorskip("pyogrio")
    from shapely import Point, from_wkb, get_coordinates, to_wkb

    alignment, report = stored(scene, "field")
    path = scene[0].with_name("points.gpkg")
    header = np.array([[700_040.0, 4_499_960.0], [700_200.0, 4_499_800.0]])
    pyogrio.raw.write(
        path,
        to_wkb(np.array([Point(xy) for xy in header])),
        [np.array(["a", "b"], dtype=object)],
        ["name"],
        crs="EPSG:32618",
        geometry_type="Point",
        layer="plots",
    )
    geodelreg.apply(report, path, path.with_name("out.gpkg"))
    about, _, binary, (names,) = pyogrio.raw.read(path.with_name("out.gpkg"), layer="plots")
    assert list(names) == ["a", "b"]
    assert "32618" in str(about["crs"])
    got = get_coordinates(from_wkb(binary))
    assert np.abs(got - true_ground(alignment, header)).max() < 4e-6


def test_files_of_another_place_are_refused_unless_forced(scene: tuple[Path, Path]) -> None:
    _, report = stored(scene, "affine")
    far = Grid(HEADER @ Affine.translation(40, 0), (SIDE, SIDE), UTM18)
    other = raster(scene[0].with_name("other.tif"), far)
    points = scene[0].with_name("points.csv")
    points.write_text("x,y\n0,0\n5,5\n")
    for file, out in ((other, "out.tif"), (points, "out.csv")):
        with pytest.raises(CorrectionMisfitError, match=file.name) as refused:
            geodelreg.apply(report, file, file.with_name(out))
        assert "`force=True`" in refused.value.remedy
        assert not file.with_name(out).exists()
        geodelreg.apply(report, file, file.with_name(out), force=True)
        assert file.with_name(out).exists()


def refused_one(said: Any) -> Any:
    return said | {"verdict": {"outcome": "refused", "accepted": False, "reasons": []}}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda said: said | {"schema_version": "9.0"}, "of 9.0"),
        (refused_one, "was refused"),
        (lambda said: {"type": "FeatureCollection"}, "no report"),
        (lambda said: [], "no report"),
        (lambda said: said | {"found": {"model": "field", "pixel_map": {"kind": "tps"}}}, "wrong"),
        (lambda said: said | {"inputs": {}}, "wrong"),
    ],
)
def test_broken_and_foreign_corrections_are_refused(
    scene: tuple[Path, Path], change: Any, words: str
) -> None:
    _, report = stored(scene, "affine")
    report.write_text(json.dumps(change(json.loads(report.read_text("utf-8")))))
    with pytest.raises(ReportError, match=words) as refused:
        geodelreg.apply(report, scene[0], scene[0].with_name("out.tif"))
    assert report.name in refused.value.cause
    assert refused.value.remedy


def test_several_files_go_to_a_folder_all_or_none(scene: tuple[Path, Path]) -> None:
    _, report = stored(scene, "affine")
    mask = raster(scene[0].with_name("mask.tif"), Grid(HEADER, (SIDE, SIDE), UTM18))
    out = scene[0].with_name("out")
    command = ["apply", str(report), str(scene[0]), str(mask), "-o", str(out)]
    run = CliRunner().invoke(cli, command)
    assert run.exit_code == 0, run.output
    assert sorted(path.name for path in out.iterdir()) == ["mask.tif", "ms.tif"]
    far = Grid(HEADER @ Affine.translation(400, 0), (SIDE, SIDE), UTM18)
    other = raster(scene[0].with_name("other.tif"), far)
    command = ["apply", str(report), str(mask), str(other), "-o", str(out.with_name("two"))]
    run = CliRunner().invoke(cli, command)
    assert isinstance(run.exception, CorrectionMisfitError)
    assert not list(out.with_name("two").iterdir())


def test_what_was_corrected_is_not_corrected_again_unless_forced(tmp_path: Path) -> None:
    """By the alignment, and by its report, in another file and in place."""
    pair = tmp_path / "ms.tif", tmp_path / "pan.tif"
    for path in pair:
        shutil.copy(Path(__file__).parents[2] / "sample_tiles" / path.name, path)
    alignment = geodelreg.align(*pair)
    report, aligned, mask = (tmp_path / name for name in ("r.json", "aligned.tif", "mask.tif"))
    report.write_text(report_json(alignment))
    geodelreg.write(alignment, aligned)
    shutil.copy(pair[0], mask)
    geodelreg.apply(report, mask)
    for file, target in ((mask, None), (aligned, tmp_path / "twice.tif")):
        before = file.read_bytes()
        with pytest.raises(CorrectionMisfitError, match="was corrected before"):
            geodelreg.apply(report, file, target)
        assert file.read_bytes() == before
    geodelreg.revert(mask)
    geodelreg.apply(report, mask)
    geodelreg.apply(report, mask, force=True)
    with pytest.raises(CorrectionMisfitError, match="is the PAN that the correction"):
        geodelreg.apply(report, pair[1], tmp_path / "moved.tif")
