"""Control points that a person has edited: as exported, disabled, moved, drawn."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner, Result
from numpy.typing import NDArray
from rasterio.warp import transform
from scipy.interpolate import LinearNDInterpolator

import geodelreg
from geodelreg.errors import AlignmentRefusedError, GcpFormatError, PointsError
from geodelreg.product.report import report_schema
from geodelreg_cli.main import cli

SAMPLES = Path(__file__).resolve().parents[2] / "sample_tiles"
MS, PAN = str(SAMPLES / "ms.tif"), str(SAMPLES / "pan.tif")
TRUTH = json.loads((SAMPLES / "truth.json").read_text("utf-8"))
TRUE, ON_PAN = Affine(*TRUTH["ms_true"]), Affine(*TRUTH["pan"])
Array = NDArray[np.float64]


def run(*args: object) -> Result:
    return CliRunner().invoke(cli, [str(arg) for arg in args])


def code(done: Result) -> int:
    """What the process would end with."""
    return int(getattr(done.exception, "exit_code", done.exit_code))


def header(path: Path) -> Affine:
    with rasterio.open(path) as dataset:
        return dataset.transform


def apart_px(one: Affine, other: Affine) -> float:
    """Largest distance of two geotransforms at the corners of MS, MS pixels."""
    height, width = TRUTH["ms_shape"]
    corners = [(0, 0), (width, 0), (0, height), (width, height)]
    return max(float(np.hypot(*np.subtract(~other @ (one @ at), at))) for at in corners)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with MS as `align` corrects it, and its points in every format with a meaning here."""
    folder = tmp_path_factory.mktemp("exported")
    for kept, names in (
        ("kept", ("p.csv", "p.points", "p.txt")),
        ("all", ("all.geojson", "all.gpkg", "all.fgb")),
    ):
        files = [arg for name in names for arg in ("--gcps", folder / name)]
        out = ("-o", folder / f"{kept}.tif", "--points", kept, "-q")
        done = run("align", MS, PAN, "--model", "affine", *out, *files)
        assert done.exit_code == 0, done.output
    return folder


@pytest.mark.parametrize(
    ("name", "within_px"),
    [
        ("all.geojson", 1e-6),
        ("all.gpkg", 1e-6),
        ("all.fgb", 1e-6),
        ("p.csv", 1e-6),
        ("p.points", 5e-3),
    ],
)
@pytest.mark.parametrize("pan", [(PAN,), ()], ids=["with PAN", "without"])
def test_unedited_points_give_the_correction_again(
    exported: Path, tmp_path: Path, name: str, within_px: float, pan: tuple[str, ...]
) -> None:
    out = tmp_path / "out.tif"
    done = run("refit", exported / name, MS, *pan, "--model", "affine", "-o", out)
    assert done.exit_code == 0, done.output
    assert apart_px(header(out), header(exported / "kept.tif")) < within_px
    assert ("PAN px" in done.stderr) == bool(pan)
    assert "matched on" not in done.stderr  # nothing was matched, so no band of PAN is asked about
    with rasterio.open(out) as written, rasterio.open(MS) as ms:
        assert np.array_equal(written.read(), ms.read())
        assert written.tags()["GEODELREG_POINTS"] == name
        assert written.tags().get("GEODELREG_PAN") == ("pan.tif" if pan else None)


def test_the_report_says_what_was_done_and_applies(exported: Path, tmp_path: Path) -> None:
    out, report, again = (tmp_path / name for name in ("out.tif", "r.json", "again.tif"))
    done = run("refit", exported / "all.geojson", MS, PAN, "-o", out, "--report", report, "-q")
    assert done.exit_code == 0, done.output
    said = json.loads(report.read_text("utf-8"))
    jsonschema.validate(said, report_schema())
    assert said["search"] == "points"
    assert said["inputs"]["points"]["files"][0]["path"].endswith("all.geojson")
    assert said["tie_points"]["by_status"]["kept"] == said["accuracy"]["kept"] > 90
    assert said["tie_points"]["total"] > said["accuracy"]["kept"]
    assert said["accuracy"]["ncc_after"] is None
    assert run("apply", report, MS, "-o", again, "-q").exit_code == 0
    assert apart_px(header(again), header(out)) < 1e-9


def write_csv(path: Path, rows: list[dict[str, Any]]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def rows_at(
    pixels: list[tuple[float, float]], place: Callable[[float, float], tuple[float, float]]
) -> list[dict[str, Any]]:
    """Points as one would type them, without standard errors."""
    places = [place(*pixel) for pixel in pixels]
    return [
        {"id": f"p{n}", "column": c, "line": r, "x": x, "y": y, "enable": 1}
        for n, ((c, r), (x, y)) in enumerate(zip(pixels, places, strict=True))
    ]


def truly(column: float, row: float) -> tuple[float, float]:
    return TRUE @ (column, row)


SPREAD = [(float(c), float(r)) for c in (10, 60, 110, 150) for r in (12, 70, 130)]


def test_typed_points_give_what_they_lie_on_and_disabled_ones_do_not_count(
    tmp_path: Path,
) -> None:
    rows = rows_at(SPREAD, truly)
    rows[3] |= {"x": rows[3]["x"] + 500, "enable": 0}
    found = geodelreg.refit(write_csv(tmp_path / "t.csv", rows), MS, model="affine")
    assert apart_px(found.correction.corrected, TRUE) < 1e-6
    assert found.accuracy.kept == len(SPREAD) - 1
    assert found.accuracy.check_rmse_px < 1e-6
    assert any("all count the same" in note for note in found.warnings)


def test_few_points_have_no_accuracy_and_that_is_said(tmp_path: Path) -> None:
    points = write_csv(tmp_path / "few.csv", rows_at([SPREAD[0], SPREAD[2], SPREAD[9]], truly))
    done = run("refit", points, MS, "--model", "shift", "--dry-run")
    assert done.exit_code == 0, done.output
    found = geodelreg.refit(points, MS, model="shift")
    if not np.isfinite(found.accuracy.check_rmse_px):
        assert "too few to measure the accuracy" in done.stderr
    assert found.accuracy.checked <= found.accuracy.kept == 3


def drag(path: Path, target: Path, east_m: float, chosen: int, **fields: Any) -> str:
    """Move the geometry of one kept feature as QGIS does; its identifier."""
    document = json.loads(path.read_text("utf-8"))
    kept = [f for f in document["features"] if f["properties"]["enable"]]
    feature = kept[chosen]
    properties = feature["properties"]
    (lon,), (lat,) = transform(
        "EPSG:32618", "EPSG:4326", [properties["x"] + east_m], [properties["y"]]
    )
    feature["geometry"]["coordinates"] = [round(lon, 9), round(lat, 9)]
    properties |= fields
    target.write_text(json.dumps(document), "utf-8")
    return str(properties["id"])


def error_px(alignment: geodelreg.Alignment, distance_to: str) -> float:
    """PAN pixels between where a point says its MS pixel lies and where it truly does."""
    index = int(distance_to)
    points = alignment.tie_points
    true = ~ON_PAN @ (TRUE @ tuple(points.source_px[index]))
    return float(np.hypot(*np.subtract(points.reference_px[index], true)))


def index_of(path: Path, name: str) -> str:
    features = json.loads(path.read_text("utf-8"))["features"]
    return str([feature["properties"]["id"] for feature in features].index(name))


def test_a_dragged_point_counts_little_and_is_measured_when_asked(
    exported: Path, tmp_path: Path
) -> None:
    edited = tmp_path / "edited.geojson"
    name = drag(exported / "all.geojson", edited, 30.0, 40)
    at = index_of(edited, name)
    plain = geodelreg.refit(edited, MS, PAN, model="affine")
    assert error_px(plain, at) == pytest.approx(3.0, abs=0.3)
    assert apart_px(plain.correction.corrected, TRUE) < 0.02
    assert any(note.startswith(f"1 point was placed by hand ({name})") for note in plain.warnings)
    drag(exported / "all.geojson", tmp_path / "far.geojson", 900.0, 40)
    far = geodelreg.refit(tmp_path / "far.geojson", MS, PAN, model="affine")
    assert f"1 enabled point lies far from the fit: {name}" in far.warnings
    snapped = geodelreg.refit(edited, MS, PAN, model="affine", snap=True)
    assert error_px(snapped, at) < 0.2
    assert snapped.tie_points.sigma_px[int(at)].max() < 0.2
    assert any(note.startswith("1 of 1 points placed by hand") for note in snapped.warnings)


def test_a_drawn_point_is_looked_for_where_the_others_say(exported: Path, tmp_path: Path) -> None:
    edited = tmp_path / "drawn.geojson"
    name = drag(exported / "all.geojson", edited, 0.0, 30, row=None, col=None, x=None, y=None)
    with pytest.raises(PointsError, match=f"point {name} lacks the pixel of MS") as caught:
        geodelreg.refit(edited, MS, PAN)
    assert "`snap=True`" in caught.value.remedy
    done = run("refit", edited, MS, "--dry-run", "--snap")
    assert done.exit_code == 2
    assert "name PAN" in done.output
    found = geodelreg.refit(edited, MS, PAN, model="affine", snap=True)
    assert found.tie_points.kept[int(index_of(edited, name))]
    assert error_px(found, index_of(edited, name)) < 0.2


@pytest.mark.parametrize("name", ["all.gpkg", "all.fgb"])
def test_layers_hold_numbers_and_may_be_edited_and_reprojected(
    exported: Path, tmp_path: Path, name: str
) -> None:
    """By geopandas: one point disabled, one dragged by three PAN pixels, one drawn."""
    import geopandas
    from shapely import Point

    table = geopandas.read_file(exported / name)
    assert table.crs.to_epsg() == 32618
    assert set(table["enable"]) == {0, 1}
    assert np.array_equal(table["enable"] == 1, table["status"] == 0)
    numbers = ["row", "col", "x", "sigma_x", "sigma_right_px", "correlation", "residual_down_px"]
    assert (table[numbers].dtypes == np.float64).all()
    first, second, third = table.index[table["enable"] == 1][[5, 50, 70]]
    table.loc[first, "enable"] = 0
    table.loc[second, "geometry"] = Point(table.loc[second, "x"] + 30, table.loc[second, "y"])
    table.loc[third, [*numbers, "y", "sigma_y", "enable", "status"]] = None
    edited = tmp_path / f"edited{Path(name).suffix}"
    table.to_crs(4326).to_file(edited, layer="points")
    found = geodelreg.refit(edited, MS, PAN, model="affine", snap=True)
    kept = found.tie_points.kept
    assert kept.sum() == (table["enable"] == 1).sum() + 1
    errors = [error_px(found, str(index)) for index in np.flatnonzero(kept)]
    assert max(errors) < 0.3
    assert any(note.startswith("2 of 2 points placed by hand") for note in found.warnings)


def test_layers_are_the_same_bytes_again(exported: Path, tmp_path: Path) -> None:
    for name in ("all.gpkg", "all.fgb"):
        args = ("--dry-run", "--points", "all", "--model", "affine", "-q")
        assert run("align", MS, PAN, *args, "--gcps", tmp_path / name).exit_code == 0
        assert (tmp_path / name).read_bytes() == (exported / name).read_bytes()


@pytest.mark.parametrize("name", ["bad.gpkg", "bad.fgb"])
def test_what_is_no_layer_of_points_is_refused(tmp_path: Path, name: str) -> None:
    import geopandas
    from shapely import box

    (tmp_path / name).write_bytes(b"nothing of use")
    with pytest.raises(GcpFormatError, match="does not begin as"):
        geodelreg.refit(tmp_path / name, MS)
    squares = geopandas.GeoDataFrame({"id": ["1"]}, geometry=[box(0, 0, 1, 1)], crs=32618)
    squares.to_file(tmp_path / f"squares_{name}")
    with pytest.raises(GcpFormatError, match="a feature is no point"):
        geodelreg.refit(tmp_path / f"squares_{name}", MS)


def test_a_field_follows_points_that_bend(tmp_path: Path) -> None:
    def bent(column: float, row: float) -> tuple[float, float]:
        return TRUE @ (column + np.sin(row / 40), row + 0.8 * np.cos(column / 40))

    pixels = [(c + 4.0, r + 4.0) for c in range(0, 150, 12) for r in range(0, 150, 12)]
    points, out = write_csv(tmp_path / "bent.csv", rows_at(pixels, bent)), tmp_path / "out.tif"
    found = geodelreg.refit(points, MS, model="field", max_shift_px=100)
    steps = range(22, 130, 12)
    between = np.array([(float(c), float(r)) for c in steps for r in steps])
    target = found.solution.map.forward(between)
    placed = np.array([found.source.grid.transform @ tuple(at) for at in target])
    goal = np.array([bent(*at) for at in between])
    assert np.abs(placed - goal).max() < 0.05 * 40
    refused = run("refit", points, MS, "--model", "field", "-o", out)
    assert (code(refused), out.exists()) == (2, False)
    assert run("refit", points, MS, "--model", "field", "-o", out, "--warp", "-q").exit_code == 0


def test_facets_pass_through_every_point(tmp_path: Path) -> None:
    """Within the mesh scipy's piecewise linear interpolation; beyond it nothing jumps."""
    rng = np.random.default_rng(3)
    pixels = [(float(c), float(r)) for c, r in rng.uniform(5, 150, (60, 2))]

    def bent(column: float, row: float) -> tuple[float, float]:
        return TRUE @ (column + 0.4 * np.sin(row / 40), row + 0.4 * np.cos(column / 40))

    points, out = write_csv(tmp_path / "bent.csv", rows_at(pixels, bent)), tmp_path / "out.tif"
    found = geodelreg.refit(points, MS, model="tin")
    at, header = rng.uniform(0, 160, (4000, 2)), found.source.grid.transform
    target = np.array([~header @ bent(*pixel) for pixel in pixels])
    expected = LinearNDInterpolator(np.array(pixels), target)(at)
    inside = np.isfinite(expected).all(axis=1)
    assert 0.5 < inside.mean() < 1
    placed = found.solution.map.forward(at)
    assert np.abs(placed - expected)[inside].max() < 1e-9
    assert np.abs(found.solution.map.inverse(placed) - at).max() < 1e-6
    near = found.solution.map.forward(at + 1e-4) - placed
    assert np.abs(near - 1e-4).max() < 3e-5
    report = tmp_path / "r.json"
    geodelreg.write_report(found, report)
    geodelreg.write(found, out, warp=True)
    geodelreg.apply(report, MS, tmp_path / "again.tif", geodelreg.WriteOptions(warp=True))
    with rasterio.open(out) as one, rasterio.open(tmp_path / "again.tif") as other:
        assert np.array_equal(one.read(), other.read())
    jsonschema.validate(json.loads(report.read_text("utf-8")), report_schema())
    assert code(run("refit", points, MS, "--model", "tin", "-o", tmp_path / "no.tif")) == 2


def test_a_scale_that_no_header_is_wrong_by_is_refused(tmp_path: Path) -> None:
    def coarser(column: float, row: float) -> tuple[float, float]:
        return TRUE @ (2.5 * column - 80, 2.5 * row - 80)

    points = write_csv(tmp_path / "coarser.csv", rows_at(SPREAD, coarser))
    with pytest.raises(PointsError, match=r"2\.5 times as large or small"):
        geodelreg.refit(points, MS, model="affine")
    found = geodelreg.refit(points, MS, model="affine", max_scale=3)
    assert found.at_centre.scale[0] == pytest.approx(2.5, abs=0.01)


FORM = {
    "model": "affine", "spread_px2": 0.0, "range_px": 0.0, "variance_px2": [0, 0], "jump_rows": []
}  # fmt: skip
BAD: dict[str, tuple[Callable[[], list[dict[str, Any]]], tuple[str, ...], str]] = {
    "on a line": (
        lambda: rows_at([(float(i), 2.0 * i) for i in range(5, 60, 5)], truly), (), "on a line"
    ),
    "too few": (
        lambda: rows_at(SPREAD[:3], truly), ("--model", "affine"), "3 enabled points determine no"
    ),
    "few for a field": (
        lambda: rows_at(SPREAD[:5], truly), ("--model", "field", "--warp"), "needs 12"
    ),
    "one place twice": (
        lambda: rows_at([*SPREAD, SPREAD[4]], truly), (), "points p4 and p12 are at one place"
    ),
    "of a larger raster": (
        lambda: rows_at([(c + 900, r) for c, r in SPREAD], truly), (), "those of another raster"
    ),
    "of another place": (
        lambda: rows_at(SPREAD, lambda c, r: (5e5 + 40 * c, 6e6 - 40 * r)), (), "another raster"
    ),
    "mirrored": (
        lambda: rows_at(SPREAD, lambda c, r: truly(150 - c, r)), (), "folds or mirrors"
    ),
    "none enabled": (
        lambda: [row | {"enable": 0} for row in rows_at(SPREAD, truly)], (), "no enabled point"
    ),
    "words for numbers": (
        lambda: [row | {"enable": "yes"} for row in rows_at(SPREAD, truly)], (), "'yes' is no"
    ),
    "no fit": (
        lambda: [row | {"fit": '{"model": "field"}'} for row in rows_at(SPREAD, truly)], (),
        "its fit cannot be read",
    ),
    "two fits": (
        lambda: [
            row | {"fit": json.dumps(FORM | {"spread_px2": n % 2})}
            for n, row in enumerate(rows_at(SPREAD, truly))
        ],
        (), "come from 2 fits",
    ),
    "a kernel that is none": (
        lambda: [
            row | {"fit": json.dumps(FORM | {"model": "field", "range_px": -1.0})}
            for row in rows_at(SPREAD, truly)
        ],
        (), "its fit cannot be read",
    ),
    "an error below 0": (
        lambda: [row | {"sigma_x": -1, "sigma_y": 1} for row in rows_at(SPREAD, truly)], (),
        "standard errors -1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ["all.geojson", "all.gpkg", "p.csv", "p.points"])
def test_points_of_another_raster_are_told(exported: Path, tmp_path: Path, name: str) -> None:
    """PAN, and a part of MS; QGIS points hold places by the header, which are right in the part."""
    part = tmp_path / "part.tif"
    with rasterio.open(MS) as ms:
        moved = ms.transform @ Affine.translation(8, 6)
        shape = {"width": ms.width - 8, "height": ms.height - 6}
        profile = ms.profile | shape | {"transform": moved}
        with rasterio.open(part, "w", **profile) as out:
            out.write(ms.read()[:, 6:, 8:])
    if name.endswith("points"):
        found = geodelreg.refit(exported / name, part, model="affine").correction.corrected
        assert apart_px(found, header(exported / "kept.tif") @ Affine.translation(8, 6)) < 0.01
        return
    for raster in (PAN, part):
        with pytest.raises(PointsError, match="are those of another raster, or of this one"):
            geodelreg.refit(exported / name, raster, PAN)


def test_a_pixel_that_was_typed_anew_is_placed_by_hand(exported: Path, tmp_path: Path) -> None:
    with (exported / "p.csv").open(newline="") as stream:
        rows: list[dict[str, Any]] = list(csv.DictReader(stream))
    rows[9]["column"] = float(rows[9]["column"]) + 0.8
    edited = write_csv(tmp_path / "edited.csv", rows)
    found = geodelreg.refit(edited, MS, PAN, model="affine", snap=True)
    assert any(note.startswith("1 of 1 points placed by hand") for note in found.warnings)
    assert error_px(found, "9") < 0.2


@pytest.mark.parametrize("name", BAD)
def test_bad_points_are_refused_with_cause_and_remedy(tmp_path: Path, name: str) -> None:
    make, more, cause = BAD[name]
    points, out = write_csv(tmp_path / "bad.csv", make()), tmp_path / "out.tif"
    done = run("refit", points, MS, "-o", out, "--report", tmp_path / "r.json", *more)
    assert isinstance(done.exception, PointsError | GcpFormatError)
    assert str(points) in done.exception.cause
    assert cause in done.exception.cause
    assert done.exception.remedy
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]


def test_limits_refuse_and_what_needs_pan_is_refused_before_the_work(
    exported: Path, tmp_path: Path
) -> None:
    points, out = exported / "p.csv", tmp_path / "out.tif"
    refused = run("refit", points, MS, PAN, "-o", out, "--max-shift", 2)
    assert isinstance(refused.exception, AlignmentRefusedError)
    for more, word in (
        (("--report", tmp_path / "r.html"), "pages show MS on PAN"),
        (("--warp", "--grid", "pan"), "needs PAN"),
    ):
        done = run("refit", points, MS, "-o", out, *more)
        assert code(done) == 2
        assert word in done.output + str(done.exception)
    assert not list(tmp_path.iterdir())
    same = run("refit", points, MS, PAN, "--dry-run", "--gcps", points, "--overwrite")
    assert code(same) == 2
