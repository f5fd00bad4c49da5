"""``geodelreg batch`` as users call it: pairs in, outcomes, tables and a ledger out."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow.parquet
import pyogrio.raw
import pytest
import rasterio
import shapely
from rasterio.warp import transform_geom
from shapely.geometry import shape

from benchmarks.batch.pairs import write_pairs
from tests.cli.batch_helpers import (
    TIMINGS,
    debris,
    outcomes,
    query,
    read_table,
    write_lines,
    write_manifest,
)
from tests.cli.helpers import Command, snapshot, write_noise
from tests.cli.pages import Page


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with two pairs and a PAN of noise; never written to."""
    folder = tmp_path_factory.mktemp("pairs")
    write_pairs(folder, 2).unlink()
    write_noise(folder / "noise.tif", folder / "pan_1.tif", 3)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "data")
    return tmp_path / "data"


MIXED = [
    {"ms": "ms_1.tif", "pan": "pan_1.tif", "out": "out/deep/1.tif", "model": ""},
    {"ms": "ms_2.tif", "pan": "pan_2.tif", "out": "out/2.tif", "model": "shift"},
    {"ms": "ms_1.tif", "pan": "noise.tif", "out": "out/3.tif", "model": ""},
    {"ms": "ms_2.tif", "pan": "none.tif", "out": "out/4.tif", "model": ""},
]


def test_every_pair_ends_in_one_typed_outcome(folder: Path, geodelreg: Command) -> None:
    manifest = write_manifest(folder / "pairs.csv", MIXED)
    tables = ["all.csv", "all.parquet", "all.geojson", "all.gpkg"]
    names = [folder / name for name in tables]
    done = geodelreg(
        "batch", manifest, "--table", names[0], "--table", names[1],
        "--footprints", names[2], "--footprints", names[3],
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stdout == ""
    assert "4 pairs: 2 aligned, 1 failed, 1 refused" in " ".join(sorted_summary(done.stderr))

    rows = read_table(names[0])
    assert [row["outcome"] for row in rows] == ["aligned", "aligned", "refused", "failed"]
    assert [row["model"] for row in rows[:2]] == ["scale", "shift"]
    assert [row["error"] for row in rows] == ["", "", "", "RasterNotFoundError"]
    assert "noise.tif were not aligned" in rows[2]["reason"]
    measured = ("model", "offset_px", "offset_m", "check_rmse_px", "uncertainty_px")
    assert {rows[2][name] for name in measured} == {""}
    assert "" not in {rows[0][name] for name in measured}
    assert "none.tif does not exist" in rows[3]["reason"]
    assert query(folder / "pairs.ledger", "SELECT number, outcome FROM outcomes ORDER BY 1") == [
        (1, "aligned"), (2, "aligned"), (3, "refused"), (4, "failed"),
    ]  # fmt: skip

    for number, options in ((1, []), (2, ["--model", "shift"])):
        alone = folder / "alone.tif"
        pair = folder / f"ms_{number}.tif", folder / f"pan_{number}.tif"
        assert geodelreg("align", *pair, "-o", alone, "--overwrite", *options).returncode == 0
        assert Path(rows[number - 1]["output"]).read_bytes() == alone.read_bytes()
    assert sorted(p.name for p in (folder / "out").rglob("*.tif")) == ["1.tif", "2.tif"]
    assert debris(folder) == []

    parquet = pyarrow.parquet.read_table(names[1]).to_pylist()
    assert [row["outcome"] for row in parquet] == [row["outcome"] for row in rows]
    assert parquet[0]["sources"] == [str(folder / "ms_1.tif")]
    assert parquet[0]["check_rmse_px"] == float(rows[0]["check_rmse_px"])

    features = json.loads(names[2].read_text())["features"]
    assert [f["properties"]["outcome"] for f in features] == [row["outcome"] for row in rows]
    assert features[3]["geometry"] is None
    for feature in features[:3]:
        check_footprint(feature)
    meta, _, geometry, fields = pyogrio.raw.read(names[3])
    assert meta["crs"] == "EPSG:4326"
    assert list(fields[list(meta["fields"]).index("outcome")]) == [r["outcome"] for r in rows]
    outlines = [shapely.from_wkb(wkb) for wkb in geometry[:3]]
    for outline, feature in zip(outlines, features[:3], strict=True):
        assert outline.symmetric_difference(shape(feature["geometry"])).area < 1e-12


def check_footprint(feature: dict[str, object]) -> None:
    """Where GDAL places the four corners of the file that the feature is about."""
    properties, geometry = feature["properties"], feature["geometry"]
    assert isinstance(properties, dict)
    written = properties["outcome"] == "aligned"
    name = properties["output"] if written else properties["sources"][0]
    with rasterio.open(name) as raster:
        corners = [
            raster.transform @ place
            for place in ((0, 0), (0, raster.height), (raster.width, raster.height),
                          (raster.width, 0), (0, 0))
        ]  # fmt: skip
        box = {"type": "Polygon", "coordinates": [corners]}
        expected = shape(transform_geom(raster.crs, "EPSG:4326", box))
    found = shape(geometry)
    assert found.exterior.is_ccw
    assert found.symmetric_difference(expected).area < 1e-4 * expected.area


def sorted_summary(stderr: str) -> list[str]:
    """The line that counts, its outcomes in alphabetical order."""
    line = next(line for line in stderr.splitlines() if " pairs: " in line)
    total, _, parts = line.partition(": ")
    return [f"{total}:", ", ".join(sorted(parts.split(", "), key=lambda p: p.split()[1]))]


@pytest.mark.parametrize(
    ("rows", "options", "code"),
    [
        (MIXED[:1], [], 0),
        (MIXED[2:3], [], 3),
        (MIXED[:3], ["--check"], 4),
        (MIXED[2:3], ["--check"], 3),
        (MIXED[:1], ["--check", "--limit", "20"], 0),
        (MIXED, ["--check"], 1),
    ],
)
def test_the_exit_code_is_that_of_the_worst(
    folder: Path, geodelreg: Command, rows: list[dict[str, str]], options: list[str], code: int
) -> None:
    manifest = write_manifest(folder / "pairs.csv", rows)
    done = geodelreg("batch", manifest, *options, "-q")
    assert (done.returncode, done.stderr) == (code, "")
    if options:
        assert not (folder / "out").exists()


def test_resume_repeats_nothing_and_retry_only_what_it_names(
    folder: Path, geodelreg: Command
) -> None:
    manifest = write_manifest(folder / "pairs.csv", MIXED)
    ledger = folder / "pairs.ledger"
    assert geodelreg("batch", manifest, "-q").returncode == 1
    first = query(ledger, "SELECT * FROM outcomes ORDER BY number")

    again = geodelreg("batch", manifest)
    assert again.returncode == 1
    assert "pairs.ledger exists" in again.stderr
    assert "--resume" in again.stderr
    assert geodelreg("batch", manifest, "--resume", "-q").returncode == 1
    assert query(ledger, "SELECT * FROM outcomes ORDER BY number") == first

    shutil.copy(folder / "pan_2.tif", folder / "none.tif")
    planned = geodelreg("batch", manifest, "--retry", "failed", "--dry-run")
    assert [json.loads(line)["output"] for line in planned.stdout.splitlines()] == [
        str(folder / "out" / "4.tif")
    ]
    assert geodelreg("batch", manifest, "--retry", "failed", "-q").returncode == 3
    assert outcomes(folder / "pairs.results.csv") == ["aligned", "aligned", "refused", "aligned"]
    history = query(ledger, "SELECT number, run, outcome FROM outcomes ORDER BY number, run")
    assert history == [
        (1, 1, "aligned"), (2, 1, "aligned"), (3, 1, "refused"), (4, 1, "failed"),
        (4, 2, "aligned"),
    ]  # fmt: skip
    assert query(ledger, "SELECT * FROM outcomes WHERE run = 1 ORDER BY number") == first


def test_a_ledger_of_other_pairs_or_another_version_is_refused(
    folder: Path, geodelreg: Command
) -> None:
    manifest = write_manifest(folder / "pairs.csv", MIXED[2:3])
    ledger = folder / "pairs.ledger"
    assert geodelreg("batch", manifest, "-q").returncode == 3
    before = snapshot(folder)
    for options in (["--model", "shift"], ["--check"], ["--warp"]):
        other = geodelreg("batch", manifest, "--resume", *options)
        assert other.returncode == 1
        assert "belongs to other pairs" in other.stderr
    write_manifest(manifest, MIXED[2:4])
    assert "belongs to other pairs" in geodelreg("batch", manifest, "--resume").stderr
    write_manifest(manifest, MIXED[2:3])
    assert snapshot(folder) == before

    query(ledger, "PRAGMA user_version = 99")
    newer = geodelreg("batch", manifest, "--resume")
    assert newer.returncode == 1
    assert "version 99" in newer.stderr
    ledger.write_bytes(b"no database at all, but longer than a header of SQLite" * 9)
    broken = geodelreg("batch", manifest, "--retry", "refused")
    assert broken.returncode == 1
    assert "is no ledger" in broken.stderr


def test_patterns_make_pairs_and_bands(folder: Path, geodelreg: Command) -> None:
    for number in (1, 2):
        scene = folder / f"scene [{number}]"
        scene.mkdir()
        with rasterio.open(folder / f"ms_{number}.tif") as ms:
            for band in (2, 3):
                profile = {**ms.profile, "count": 1}
                with rasterio.open(scene / f"B{band}.tif", "w", **profile) as out:
                    out.write(ms.read(band), 1)
        shutil.copy(folder / f"pan_{number}.tif", scene / "B8.tif")
    patterns = "{scene}/B[23].tif", "{scene}/B8.tif", "-o", "out/{scene}"
    done = geodelreg("batch", "--pair", *patterns, "-q", cwd=folder)
    assert done.returncode == 0, done.stderr
    written = sorted(p.relative_to(folder).as_posix() for p in (folder / "out").rglob("*.tif"))
    assert written == [f"out/scene [{number}]/B{band}.tif" for number in (1, 2) for band in (2, 3)]
    alone = folder / "alone"
    bands = [folder / "scene [1]" / f"B{n}.tif" for n in (2, 3, 8)]
    assert geodelreg("align", *bands, "-o", alone).returncode == 0
    for name in ("B2.tif", "B3.tif"):
        assert (folder / "out/scene [1]" / name).read_bytes() == (alone / name).read_bytes()

    (folder / "scene [2]" / "B8.tif").unlink()
    lacking = geodelreg("batch", "--pair", *patterns, "--ledger", "new.ledger", cwd=folder)
    assert lacking.returncode == 2
    assert "no file is called like scene [2]/B8.tif" in lacking.stderr
    unknown = geodelreg("batch", "--pair", "{a}_MS.tif", "{b}_PAN.tif", "-o", "{a}", cwd=folder)
    assert unknown.returncode == 2
    assert "{b}" in unknown.stderr


def test_a_pattern_of_ms_that_fits_pans_too_makes_no_pairs_of_them(
    folder: Path, geodelreg: Command
) -> None:
    for number in (1, 2):
        (folder / f"ms_{number}.tif").rename(folder / f"s{number}.tif")
        (folder / f"pan_{number}.tif").rename(folder / f"s{number}_PAN.tif")
    (folder / "noise.tif").unlink()
    done = geodelreg(
        "batch", "--pair", "{s}.tif", "{s}_PAN.tif", "-o", "out/{s}.tif", "--dry-run", cwd=folder
    )
    assert done.returncode == 0, done.stderr
    pairs = [json.loads(line) for line in done.stdout.splitlines()]
    assert [Path(pair["reference"]).name for pair in pairs] == ["s1_PAN.tif", "s2_PAN.tif"]


def test_in_place_corrects_ms_itself_and_a_second_run_says_so(
    folder: Path, geodelreg: Command
) -> None:
    rows = [{"ms": f"ms_{n}.tif", "pan": f"pan_{n}.tif"} for n in (1, 2)]
    manifest = write_lines(folder / "pairs.jsonl", rows)
    assert geodelreg("batch", manifest, "--in-place", "-q").returncode == 0
    found = outcomes(folder / "pairs.results.csv")
    assert found == ["aligned", "aligned"]
    second = ("--in-place", "--ledger", folder / "second.ledger", "-q")
    assert geodelreg("batch", manifest, *second).returncode == 0
    rows_again = read_table(folder / "second.results.csv")
    assert [row["outcome"] for row in rows_again] == ["already_aligned"] * 2
    assert all("carries a correction against this PAN" in row["warnings"] for row in rows_again)

    twice = write_lines(folder / "twice.jsonl", [*rows, {"ms": "./ms_1.tif", "pan": "pan_2.tif"}])
    done = geodelreg("batch", twice, "--in-place")
    assert done.returncode == 2
    assert "line 3: " in done.stderr
    assert "ms_1.tif is corrected in place by line 1 already" in done.stderr


def test_an_output_of_the_batch_itself_is_finished_but_no_other_file_replaced(
    folder: Path, geodelreg: Command
) -> None:
    manifest = write_manifest(folder / "pairs.csv", MIXED[:2])
    assert geodelreg("batch", manifest, "-q").returncode == 0
    output = folder / "out" / "deep" / "1.tif"
    whole = output.read_bytes()
    ledger = folder / "pairs.ledger"
    forget = "UPDATE pairs SET state = 'running'", "DELETE FROM outcomes"
    with_commit(ledger, *forget)
    shutil.copy(folder / "noise.tif", folder / "out" / "2.tif")
    foreign = (folder / "out" / "2.tif").read_bytes()

    done = geodelreg("batch", manifest, "--resume", "-q")
    assert done.returncode == 1
    rows = read_table(folder / "pairs.results.csv")
    assert [(row["outcome"], row["error"]) for row in rows] == [
        ("aligned", ""), ("failed", "OutputExistsError"),
    ]  # fmt: skip
    assert output.read_bytes() == whole
    assert (folder / "out" / "2.tif").read_bytes() == foreign


def with_commit(ledger: Path, *statements: str) -> None:
    import sqlite3

    db = sqlite3.connect(ledger)
    for statement in statements:
        db.execute(statement)
    db.commit()
    db.close()


def test_fail_fast_starts_nothing_after_a_failure(folder: Path, geodelreg: Command) -> None:
    rows = [dict(MIXED[3], out=f"out/x{n}.tif") for n in range(6)]
    manifest = write_manifest(folder / "pairs.csv", rows)
    done = geodelreg("batch", manifest, "--fail-fast", "-j", "1")
    assert done.returncode == 1
    states = dict(query(folder / "pairs.ledger", "SELECT state, count(*) FROM pairs GROUP BY 1"))
    assert states["done"] == 1
    assert geodelreg("batch", manifest, "--resume", "-q").returncode == 1
    assert outcomes(folder / "pairs.results.csv") == ["failed"] * 6


@pytest.mark.parametrize(
    ("limit", "error"),
    [(("--timeout", "0.01"), "PairTimeoutError"), (("--memory", "40"), "PairMemoryError")],
)
def test_a_pair_over_its_limit_has_failed_and_may_be_retried_with_another(
    folder: Path, geodelreg: Command, limit: tuple[str, str], error: str
) -> None:
    manifest = write_manifest(folder / "pairs.csv", MIXED[:2])
    assert geodelreg("batch", manifest, *limit, "-q").returncode == 1
    rows = read_table(folder / "pairs.results.csv")
    assert {(row["outcome"], row["error"]) for row in rows} == {("failed", error)}
    assert all(limit[1] in row["reason"] for row in rows)
    assert debris(folder) == []
    more = (limit[0], "4000")
    assert geodelreg("batch", manifest, "--retry", "failed", *more, "-q").returncode == 0
    assert outcomes(folder / "pairs.results.csv") == ["aligned", "aligned"]


def test_warnings_are_kept_for_every_pair(folder: Path, geodelreg: Command) -> None:
    with rasterio.open(folder / "ms_1.tif", "r+") as ms:
        ms.update_tags(ns="RPC", LINE_OFF="1", SAMP_OFF="1", LAT_OFF="1", LONG_OFF="1",
                       HEIGHT_OFF="1", LINE_SCALE="1", SAMP_SCALE="1", LAT_SCALE="1",
                       LONG_SCALE="1", HEIGHT_SCALE="1", LINE_NUM_COEFF="1 " * 20,
                       LINE_DEN_COEFF="1 " * 20, SAMP_NUM_COEFF="1 " * 20,
                       SAMP_DEN_COEFF="1 " * 20)  # fmt: skip
    manifest = write_manifest(folder / "pairs.csv", MIXED[:1])
    done = geodelreg("batch", manifest, "-q")
    assert done.returncode == 0, done.stderr
    (row,) = read_table(folder / "pairs.results.csv", without=TIMINGS)
    assert "`strip_rpc=True` drops them" in row["warnings"]


def test_a_footprint_across_the_antimeridian_is_cut_there(folder: Path, geodelreg: Command) -> None:
    from affine import Affine

    for name in ("ms_1.tif", "noise.tif"):
        with rasterio.open(folder / name, "r+") as raster:
            raster.crs = "EPSG:4326"
            step = 0.4 / raster.width
            raster.transform = Affine(step, 0, 179.8, 0, -step, -16.0)
    manifest = write_manifest(folder / "pairs.csv", MIXED[2:3])
    shown = folder / "where.geojson"
    assert geodelreg("batch", manifest, "-q", "--footprints", shown).returncode == 3
    (feature,) = json.loads(shown.read_text())["features"]
    west, east = (shape({"type": "Polygon", "coordinates": part})
                  for part in feature["geometry"]["coordinates"])  # fmt: skip
    bounds = sorted([west.bounds, east.bounds])
    assert bounds[0] == pytest.approx((-180.0, -16.4, -179.8, -16.0), abs=1e-6)
    assert bounds[1] == pytest.approx((179.8, -16.4, 180.0, -16.0), abs=1e-6)


@pytest.mark.parametrize(
    ("args", "word"),
    [
        ([], "--pair"),
        (["pairs.csv", "-o", "x"], "--pair"),
        (["pairs.csv", "--pair", "a", "b"], "--pair"),
        (["pairs.csv", "--check", "--in-place"], "exclude"),
        (["pairs.csv", "--in-place", "--warp"], "--in-place"),
        (["pairs.csv", "--table", "x.xls"], ".parquet"),
        (["pairs.csv", "--limit", "-1"], "--limit"),
        (["none.csv"], "none.csv"),
    ],
)
def test_wrong_usage_is_told(folder: Path, geodelreg: Command, args: list[str], word: str) -> None:
    write_manifest(folder / "pairs.csv", MIXED[:1])
    before = snapshot(folder)
    done = geodelreg("batch", *args, cwd=folder)
    assert done.returncode == 2
    assert word in done.stderr
    assert snapshot(folder) == before


def test_pages_of_a_batch_lead_to_the_pages_of_its_pairs(folder: Path, geodelreg: Command) -> None:
    manifest = write_manifest(folder / "pairs.csv", MIXED)
    pages = folder / "report"
    done = geodelreg("batch", manifest, "--report-dir", pages)
    assert done.returncode == 1, done.stderr
    index = Page(pages / "index.html")
    assert outcomes(folder / "pairs.results.csv") == [
        attributes["data-outcome"] for attributes in index.all("tr") if "data-outcome" in attributes
    ]
    links = [attributes["href"] for attributes in index.all("a")]
    assert links == ["pairs/000001.html", "pairs/000002.html", "pairs/000003.html"]
    titles = [Page(pages / link).texts["title"][0] for link in links]
    assert titles == [
        "Aligned: ms_1.tif on pan_1.tif",
        "Aligned: ms_2.tif on pan_2.tif",
        "Refused: ms_1.tif on noise.tif",
    ]
    # a page of then is not replaced unasked
    (folder / "pairs.ledger").unlink()
    (folder / "pairs.results.csv").unlink()
    before = snapshot(folder)
    again = geodelreg("batch", manifest, "--report-dir", pages)
    assert again.returncode == 1
    assert "index.html exists" in again.stderr
    assert snapshot(folder) == before


def test_pages_of_checks_say_what_the_checks_say(folder: Path, geodelreg: Command) -> None:
    rows = [{name: row[name] for name in ("ms", "pan")} for row in MIXED[:1]]
    manifest = write_manifest(folder / "pairs.csv", rows)
    done = geodelreg("batch", manifest, "--check", "--report-dir", folder / "report")
    assert done.returncode == 4, done.stderr
    page = Page(folder / "report" / "pairs" / "000001.html")
    assert page.texts["title"] == ["Misaligned: ms_1.tif on pan_1.tif"]
    assert "Correct the header with geodelreg align." in page.text
