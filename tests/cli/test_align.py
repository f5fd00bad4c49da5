"""``geodelreg align`` end to end on the sample pair: files, streams and exit codes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio
from affine import Affine

from geodelreg.product.report import report_schema
from tests.cli.helpers import (
    COMMAND,
    SAMPLES,
    Command,
    copy_samples,
    run_command,
    snapshot,
    write_noise,
)

TRUTH = json.loads((SAMPLES / "truth.json").read_text(encoding="utf-8"))


def distance_from_truth_px(transform: Affine) -> float:
    """RMS distance, in PAN pixels over 21 × 21 points, of a geotransform from the true one."""
    height, width = TRUTH["ms_shape"]
    true, pan = Affine(*TRUTH["ms_true"]), Affine(*TRUTH["pan"])
    squares = [
        (np.subtract(~pan @ (transform @ at), ~pan @ (true @ at)) ** 2).sum()
        for at in ((x, y) for x in np.linspace(0, width, 21) for y in np.linspace(0, height, 21))
    ]
    return float(np.sqrt(np.mean(squares)))


def transform_of(path: Path) -> Affine:
    with rasterio.open(path) as dataset:
        return dataset.transform


@pytest.fixture(scope="module")
def aligned(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """Folder and process of one run that writes everything."""
    folder = copy_samples(tmp_path_factory.mktemp("aligned"))
    done = run_command(
        *("align", "ms.tif", "pan.tif", "-o", "out.tif", "--json", "--report", "out.json"),
        *("--gcps", "out.points", "--gcps", "out.txt", "--figure", "out.png"),
        cwd=folder,
    )
    return folder, done


def test_out_is_ms_where_it_truly_is(
    aligned: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    folder, done = aligned
    assert done.returncode == 0, done.stderr
    assert distance_from_truth_px(transform_of(folder / "ms.tif")) > 8
    assert distance_from_truth_px(transform_of(folder / "out.tif")) < 0.05
    with rasterio.open(folder / "ms.tif") as ms, rasterio.open(folder / "out.tif") as out:
        assert np.array_equal(ms.read(), out.read())


def test_stdout_is_the_report_and_nothing_else(
    aligned: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    folder, done = aligned
    report = json.loads(done.stdout)
    jsonschema.validate(report, report_schema())
    in_file = json.loads((folder / "out.json").read_text(encoding="utf-8"))
    jsonschema.validate(in_file, report_schema())
    assert len(in_file["tie_points"].pop("points")) == in_file["tie_points"]["total"]
    assert report == in_file
    assert report["verdict"]["outcome"] == "aligned"


def test_stderr_is_a_summary_without_a_bar(
    aligned: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    _, done = aligned
    assert "check points" in done.stderr
    assert "\x1b" not in done.stderr
    assert "\r" not in done.stderr


def test_summary_tells_the_uncertainty_from_what_is_left_and_from_scatter(
    aligned: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    folder, done = aligned
    said = dict(
        re.findall(r"^(Uncertainty|Residual|Patch).*?: (\S+ PAN px \(\S+ m\))", done.stderr, re.M)
    )
    assert list(said) == ["Uncertainty", "Residual", "Patch"]  # what matters most comes first
    px = {name: float(text.split()[0]) for name, text in said.items()}
    accuracy = json.loads(done.stdout)["accuracy"]
    assert px["Uncertainty"] == pytest.approx(accuracy["uncertainty_px"], abs=1e-4)
    assert px["Residual"] == pytest.approx(accuracy["residual_rms_px"], abs=1e-4)
    assert px["Patch"] == pytest.approx(accuracy["check_rmse_px"], abs=1e-4)
    for name, text in said.items():  # a PAN pixel is 10 m
        assert float(re.findall(r"\((\S+) m", text)[0]) == pytest.approx(10 * px[name], abs=1e-3)
    assert distance_from_truth_px(transform_of(folder / "out.tif")) < px["Uncertainty"]
    assert px["Uncertainty"] < px["Patch"]


def test_side_files_hold_the_tie_points(
    aligned: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    folder, done = aligned
    kept = json.loads(done.stdout)["tie_points"]["by_status"]["kept"]
    points = (folder / "out.points").read_text(encoding="utf-8").splitlines()
    assert points[0].startswith("#CRS: ")
    assert len(points) == kept + 2
    options = (folder / "out.txt").read_text(encoding="utf-8").split()
    assert options.count("-gcp") == kept
    assert (folder / "out.png").read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in folder.iterdir()} == {
        *("ms.tif", "pan.tif", "out.tif", "out.json", "out.points", "out.txt", "out.png")
    }


def test_quiet_prints_nothing_and_threads_change_no_byte(
    aligned: tuple[Path, subprocess.CompletedProcess[str]], geodelreg: Command
) -> None:
    folder, _ = aligned
    done = geodelreg(
        *("align", "ms.tif", "pan.tif", "-o", "again.tif", "-q", "-j", "1"), cwd=folder
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (folder / "again.tif").read_bytes() == (folder / "out.tif").read_bytes()
    (folder / "again.tif").unlink()


def test_an_aligned_raster_keeps_its_header(
    aligned: tuple[Path, subprocess.CompletedProcess[str]], geodelreg: Command, tmp_path: Path
) -> None:
    folder, _ = aligned
    done = geodelreg(
        *("align", folder / "out.tif", folder / "pan.tif", "-o", tmp_path / "twice.tif", "--json")
    )
    assert done.returncode == 0
    assert json.loads(done.stdout)["verdict"]["outcome"] == "already_aligned"
    assert transform_of(tmp_path / "twice.tif") == transform_of(folder / "out.tif")


def test_dry_run_writes_no_file_and_verbose_names_the_steps(geodelreg: Command, pair: Path) -> None:
    before = snapshot(pair)
    done = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", "-v", cwd=pair)
    assert done.returncode == 0
    assert "check points" in done.stderr
    assert "geodelreg: refining, 40 %\n" in done.stderr
    assert "DEBUG" not in done.stderr
    assert done.stdout == ""
    assert snapshot(pair) == before


def test_overwrite(geodelreg: Command, pair: Path) -> None:
    (pair / "out.tif").write_bytes(b"old")
    (pair / "out.json").write_bytes(b"old")
    args = ("align", "ms.tif", "pan.tif", "-o", "out.tif", "--report", "out.json", "-q")
    assert geodelreg(*args, cwd=pair).returncode == 1
    assert (pair / "out.tif").read_bytes() == b"old"
    assert geodelreg(*args, "--overwrite", cwd=pair).returncode == 0
    assert distance_from_truth_px(transform_of(pair / "out.tif")) < 0.05
    assert json.loads((pair / "out.json").read_text(encoding="utf-8"))


def test_in_place_and_back(geodelreg: Command, pair: Path) -> None:
    original = transform_of(pair / "ms.tif")
    done = geodelreg("align", "ms.tif", "pan.tif", "--in-place", cwd=pair)
    assert done.returncode == 0, done.stderr
    assert distance_from_truth_px(transform_of(pair / "ms.tif")) < 0.05
    assert done.stderr.splitlines()[-1] == "Written: the header of MS"
    done = geodelreg("align", "ms.tif", "pan.tif", "--in-place", cwd=pair)
    assert done.stderr.splitlines()[-1] == "Written: nothing"
    done = geodelreg("revert", "ms.tif", cwd=pair)
    assert done.returncode == 0
    assert done.stderr == "ms.tif: original georeferencing is back\n"
    assert transform_of(pair / "ms.tif") == original


def test_one_file_per_band_goes_to_a_folder(geodelreg: Command, pair: Path) -> None:
    with rasterio.open(pair / "ms.tif") as ms:
        profile = ms.profile | {"count": 1}
        for number in ms.indexes:
            with rasterio.open(pair / f"B{number}.tif", "w", **profile) as band:
                band.write(ms.read(number), 1)
    names = ["B1.tif", "B2.tif", "B3.tif", "B4.tif"]
    done = geodelreg("align", *names, "pan.tif", "-o", "aligned", cwd=pair)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (pair / "aligned").iterdir()) == names
    transforms = {transform_of(pair / "aligned" / name) for name in names}
    assert len(transforms) == 1
    assert distance_from_truth_px(transforms.pop()) < 0.05


def test_refused_writes_the_report_alone(geodelreg: Command, pair: Path) -> None:
    write_noise(pair / "noise.tif", like=pair / "pan.tif", seed=1)
    before = snapshot(pair)
    done = geodelreg(
        *("align", "ms.tif", "noise.tif", "-o", "out.tif", "--gcps", "out.points"),
        *("--report", "out.json", "--json"),
        cwd=pair,
    )
    assert done.returncode == 3
    assert "geodelreg: refused: " in done.stderr
    assert "Traceback" not in done.stderr
    after = snapshot(pair)
    report = json.loads(after.pop("out.json"))
    assert after == before
    jsonschema.validate(report, report_schema())
    assert report["verdict"]["outcome"] == "refused"
    assert json.loads(done.stdout) == report


def test_a_limit_of_the_user_refuses(geodelreg: Command, pair: Path) -> None:
    done = geodelreg(*("align", "ms.tif", "pan.tif", "-o", "out.tif", "--max-shift", "3"), cwd=pair)
    assert done.returncode == 3
    assert "shift" in done.stderr
    assert not (pair / "out.tif").exists()


def test_bad_input_names_file_and_remedy(geodelreg: Command, pair: Path) -> None:
    (pair / "text.tif").write_text("no raster", encoding="utf-8")
    (pair / "half.tif").write_bytes((pair / "ms.tif").read_bytes()[:5000])
    with rasterio.open(pair / "ms.tif") as ms:
        profile = ms.profile
        del profile["crs"]
        with rasterio.open(pair / "nocrs.tif", "w", **profile) as bare:
            bare.write(ms.read())
    before = snapshot(pair)
    for name in ("missing.tif", "text.tif", "half.tif", "nocrs.tif"):
        done = geodelreg("align", name, "pan.tif", "-o", "out.tif", cwd=pair)
        lines = done.stderr.splitlines()
        assert done.returncode == 1, (name, done.stderr)
        assert len(lines) >= 2, (name, done.stderr)
        assert lines[0].startswith("geodelreg: error: ")
        assert name in lines[0]
        assert "Traceback" not in done.stderr
        assert done.stdout == ""
    done = geodelreg("align", "ms.tif", "pan.tif", "-o", "out.tif", "--band", "9", cwd=pair)
    assert done.returncode == 2
    assert "ms.tif" in done.stderr
    assert snapshot(pair) == before


def test_debug_adds_the_traceback_and_keeps_the_exit_code(
    geodelreg: Command, tmp_path: Path
) -> None:
    done = geodelreg("align", "no.tif", "pan.tif", "--dry-run", "--debug", cwd=tmp_path)
    assert done.returncode == 1
    assert "Traceback (most recent call last)" in done.stderr
    assert "geodelreg: error: " in done.stderr


def test_a_terminal_gets_a_bar_and_stdout_stays_json(pair: Path) -> None:
    leader, follower = pytest.importorskip("pty").openpty()
    process = subprocess.Popen(
        [
            *COMMAND,
            "align",
            "ms.tif",
            "pan.tif",
            "--dry-run",
            "--json",
        ],
        cwd=pair,
        stdout=subprocess.PIPE,
        stderr=follower,
        env=os.environ | {"TERM": "xterm-256color"},
    )
    os.close(follower)
    shown = b""
    while True:
        try:
            piece = os.read(leader, 65536)
        except OSError:  # the other side of the terminal is closed
            break
        if not piece:
            break
        shown += piece
    os.close(leader)
    stdout, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert json.loads(stdout)["verdict"]["outcome"] == "aligned"
    assert b"\x1b[" in shown
    assert b"check points" in shown


def test_rio_plugin(pair: Path) -> None:
    command = [sys.executable, "-c", "from rasterio.rio.main import main_group; main_group()"]
    args = ["geodelreg-align", "ms.tif", "pan.tif", "-o", "out.tif", "--co", "DESCRIPTION=MiXed"]
    done = subprocess.run([*command, *args, "-q"], cwd=pair, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert distance_from_truth_px(transform_of(pair / "out.tif")) < 0.05
    done = subprocess.run(
        [*command, *args, "--overwrite", "--band", "9"], cwd=pair, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_the_papers_method_prints_its_point_counts(geodelreg: Command, pair: Path) -> None:
    done = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", "--method", "zhang2013", cwd=pair)
    assert done.returncode in (0, 3)
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("Points: ")]
    counts = [int(part.split()[0]) for part in line.removeprefix("Points: ").split(" → ")]
    assert len(counts) >= 5
    assert counts[2:] == sorted(counts[2:], reverse=True)
    assert min(counts) >= 3


def test_a_lossy_output_is_refused_in_two_lines(geodelreg: Command, pair: Path) -> None:
    before = snapshot(pair)
    done = geodelreg(
        *("align", "ms.tif", "pan.tif", "-o", "out.tif", "--co", "COMPRESS=JPEG", "--json"),
        *("--gcps", "out.points", "--report", "out.json"),
        cwd=pair,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    cause, remedy = done.stderr.splitlines()
    assert cause.startswith("geodelreg: error: out.tif")
    assert "lossless" in remedy
    assert snapshot(pair) == before
