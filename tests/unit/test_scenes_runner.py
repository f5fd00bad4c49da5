"""Tools are run, measured and scored as the tables say, and results are compared honestly."""

from __future__ import annotations

import json
import subprocess
import sys
from argparse import Namespace
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from affine import Affine
from pyproj import CRS

from benchmarks.peers import table
from benchmarks.peers.environments import OWN, Peer, PeerUnavailableError, environment
from benchmarks.peers.run import Result, Tool, run_tool
from benchmarks.processes import measured
from benchmarks.records import read_transform
from benchmarks.report import replace_section
from benchmarks.scenes.make import write_raster
from benchmarks.scenes.truth import Truth

UTM18 = CRS.from_epsg(32618).to_wkt()
TRUTH = Truth(
    name="T",
    description="",
    source="",
    ms_crs=UTM18,
    pan_crs=UTM18,
    ms_header=(40.0, 0.0, 1000.0, 0.0, -40.0, 9000.0),
    ms_true=(40.0, 0.0, 1030.0, 0.0, -40.0, 9040.0),
    pan=(10.0, 0.0, 1000.0, 0.0, -10.0, 9000.0),
    ms_shape=(20, 20),
    pan_shape=(80, 80),
)
ADAPTER = """
import argparse, json, os, sys
p = argparse.ArgumentParser()
for n in ("--ms", "--pan", "--out", "--setting"):
    p.add_argument(n)
a = p.parse_args()
beside = sorted(os.listdir(os.path.dirname(a.ms)))
if any("truth" in n for n in beside):
    sys.exit("sees the truth")
if a.setting == "crash":
    sys.exit("cannot do that")
shift = {"right": 0.0, "off": 20.0}[a.setting]
json.dump({"transform": [40.0, 0.0, 1030.0 + shift, 0.0, -40.0, 9040.0]}, open(a.out, "w"))
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "T"
    folder.mkdir()
    for name, shape in (("ms.tif", (4, 20, 20)), ("pan.tif", (1, 80, 80))):
        write_raster(folder / name, np.ones(shape, np.uint16), TRUTH.ms_header, UTM18)
    TRUTH.save(folder / "truth.json")
    return folder


@pytest.fixture
def adapter(tmp_path: Path) -> Path:
    script = tmp_path / "adapter.py"
    script.write_text(ADAPTER)
    return script


@pytest.mark.parametrize(("setting", "error_px"), [("right", 0.0), ("off", 2.0)])
def test_peer_is_scored_against_a_truth_it_does_not_see(
    scene: Path, adapter: Path, setting: str, error_px: float
) -> None:
    result = run_tool(Tool("peer", setting, Path(sys.executable), adapter), scene, 60)
    assert result.failure == ""
    assert result.rmse_px == pytest.approx(error_px)
    assert result.max_px == pytest.approx(error_px)


def test_failure_of_a_peer_keeps_its_last_words(scene: Path, adapter: Path) -> None:
    result = run_tool(Tool("peer", "crash", Path(sys.executable), adapter), scene, 60)
    assert np.isnan(result.rmse_px)
    assert result.failure == "cannot do that"


def test_resources_are_those_of_the_child(tmp_path: Path) -> None:
    hungry = "b = bytearray(150_000_000); b[::4096] = b'x' * len(b[::4096])"
    busy = "import time\nwhile time.process_time() < 0.4: pass"
    command = [sys.executable, "-c", f"{hungry}\n{busy}"]
    small = (  # the process that runs the tests may be larger than the child
        "import dataclasses, json, pathlib; from benchmarks.processes import measured;"
        f"usage = measured({command!r}, {{}}, 60, pathlib.Path({str(tmp_path)!r}));"
        "print(json.dumps(dataclasses.asdict(usage)))"
    )
    root = Path(__file__).resolve().parents[2]
    out = subprocess.run(
        [sys.executable, "-c", small], cwd=root, capture_output=True, text=True, check=True
    ).stdout
    usage = json.loads(out)
    assert usage["status"] == 0
    assert 150 < usage["peak_mb"] < 400
    assert usage["cpu_s"] >= 0.4


def test_a_run_that_takes_too_long_is_stopped_with_its_children(tmp_path: Path) -> None:
    marker = tmp_path / "survived"
    child = f"import time; time.sleep(3); open({str(marker)!r}, 'w')"
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    usage = measured([sys.executable, "-c", parent], {}, 1.0, tmp_path)
    assert usage.status == -9
    assert usage.last_line == "stopped after 1 s"
    measured([sys.executable, "-c", "import time; time.sleep(2.5)"], {}, 60, tmp_path)
    assert not marker.exists()


def test_transform_is_read_from_json_and_from_a_raster(tmp_path: Path) -> None:
    expected = Affine(*TRUTH.ms_true)
    write_raster(tmp_path / "out.tif", np.ones((1, 4, 4), np.uint8), TRUTH.ms_true, TRUTH.ms_crs)
    (tmp_path / "out.json").write_text(json.dumps({"transform": TRUTH.ms_true}))
    assert read_transform(tmp_path / "out.tif") == expected
    assert read_transform(tmp_path / "out.json") == expected


def test_environment_is_built_once_and_a_failure_is_remembered(tmp_path: Path) -> None:
    good = Peer("good", "good", (), "import json")
    python = environment(good, tmp_path)
    built = python.stat().st_ctime_ns
    assert environment(good, tmp_path) == python
    assert python.stat().st_ctime_ns == built
    bad = replace(good, script="bad", probe="import not_there_at_all")
    for _ in range(2):
        with pytest.raises(PeerUnavailableError, match="not_there_at_all"):
            environment(bad, tmp_path)
    with pytest.raises(PeerUnavailableError, match="no_such_command is not installed"):
        environment(replace(good, command="no_such_command"), tmp_path)


def _result(**changes: object) -> Result:
    base = Result("A", OWN, "default", 0.004, 0.006, 0.008, 2.0, 2.5, 200.0, "")
    return replace(base, **changes)  # type: ignore[arg-type]


def _save(path: Path, *results: Result) -> Path:
    path.write_text(json.dumps({"machine": "m", "results": [asdict(r) for r in results]}))
    return path


@pytest.mark.parametrize(
    ("change", "worse"),
    [
        ({}, 0),
        ({"wall_s": 2.4, "rmse_px": 0.0049, "peak_mb": 245.0}, 0),
        ({"wall_s": 2.6}, 1),
        ({"rmse_px": 0.02}, 1),
        ({"rmse_px": float("nan"), "failure": "refused"}, 1),
        ({"peak_mb": 300.0}, 1),
        ({"rmse_px": 0.0055}, 0),
    ],
    ids=["same", "within", "slower", "less accurate", "failed", "larger", "below the floor"],
)
def test_comparison_reports_what_got_worse(
    tmp_path: Path, change: dict[str, object], worse: int, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _save(tmp_path / "before.json", _result())
    after = _save(tmp_path / "after.json", _result(**change))
    assert table.run(Namespace(before=before, after=after, tolerance=1.25)) == worse
    assert ("WORSE" in capsys.readouterr().out) == bool(worse)


def test_page_names_the_best_and_the_fastest_peer_and_the_wrong_ones(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    source = _save(
        tmp_path / "r.json",
        _result(),
        _result(tool="accurate", rmse_px=0.01, cpu_s=30.0),
        _result(tool="fast", rmse_px=0.25, cpu_s=1.0),
        _result(tool="faster but poor", rmse_px=0.5, cpu_s=0.5),
        _result(tool="wrong", rmse_px=200.0, cpu_s=0.1),
        _result(tool="broken", rmse_px=float("nan"), failure="no luck"),
    )
    page = tmp_path / "docs" / "page.md"
    table.write_page(source, page, 90.0)
    text = page.read_text()
    assert (
        "| A | geodelreg: 0.0040 px, 2.5 s | accurate, default: 0.0100 px, 30.0 s "
        "| 2.5 × | fast, default: 0.2500 px, 1.0 s |" in text
    )
    assert "- A, wrong, default: 200.0 px off, no error raised" in text
    assert "- A, broken, default: no luck" in text
    assert "| wrong, default | – / 0.1 s, 200 MB |" in text
    assert (page.parent / "images" / "accuracy_versus_time.png").stat().st_size > 5000


def test_sections_are_replaced_and_others_kept(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    replace_section(page, "one", "first")
    replace_section(page, "two", "second")
    replace_section(page, "one", "changed")
    text = page.read_text()
    assert "first" not in text
    assert text.index("changed") < text.index("second")
    assert text.startswith("# Benchmarks\n")
    before = text
    replace_section(page, "two", "second")
    assert page.read_text() == before
