"""``geodelreg check`` end to end: verdict on stdout, exit code, and not one file touched."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import jsonschema
import pytest
import rasterio
from affine import Affine

from geodelreg.product.report import report_schema
from tests.cli.helpers import SAMPLES, Command, copy_samples, run_command, snapshot, write_noise

TRUTH = json.loads((SAMPLES / "truth.json").read_text(encoding="utf-8"))


def make_aligned(folder: Path) -> Path:
    """The sample MS with its true geotransform."""
    path = folder / "aligned.tif"
    with rasterio.open(folder / "ms.tif") as ms:
        profile, bands = ms.profile | {"transform": Affine(*TRUTH["ms_true"])}, ms.read()
    with rasterio.open(path, "w", **profile) as out:
        out.write(bands)
    return path


@pytest.fixture(scope="module")
def misaligned(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """Folder and process of one check of the sample pair, band by band."""
    folder = copy_samples(tmp_path_factory.mktemp("check"))
    return folder, run_command("check", "ms.tif", "pan.tif", "--per-band", cwd=folder)


def test_misaligned_is_exit_4_with_how_far_and_which_way(
    misaligned: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    folder, done = misaligned
    assert done.returncode == 4, done.stderr
    assert re.search(
        r"^ms\.tif: misaligned by up to 9\.\d+ ± 0\.0\d+ PAN px \(9\d\.\d m\)", done.stdout
    )
    assert "7.36 px right, 4.62 px up" in done.stdout
    assert re.search(r"rotation -?0\.000\d°, scale × 1\.0008\d*, × 0\.9993\d*", done.stdout)
    assert "One affine is enough" in done.stdout
    assert re.search(
        r"^Uncertainty of the correction: 0\.0\d+ PAN px \(0\.\d+ m\)", done.stdout, re.M
    )
    assert re.search(r"^Residual misregistration after it: 0\.00\d+ PAN px", done.stdout, re.M)
    assert "check points" in done.stdout
    assert done.stderr == ""
    assert {path.name for path in folder.iterdir()} == {"ms.tif", "pan.tif"}


def test_per_band_prints_one_row_a_band(
    misaligned: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    _, done = misaligned
    rows = done.stdout.splitlines()[-4:]
    assert [row.split()[:2] for row in rows] == [["band", str(n)] for n in range(1, 5)]
    for row in rows:
        dx, dy, sigma, most, correlation = map(float, row.split()[2:7])
        assert dx == pytest.approx(7.36, abs=0.6)
        assert dy == pytest.approx(-4.62, abs=0.6)
        assert 0 < sigma < 0.3
        assert most > 8
        assert 0.5 < correlation <= 1
        assert row.endswith("  misaligned")


def test_aligned_is_exit_0_and_touches_nothing(geodelreg: Command, pair: Path) -> None:
    path = make_aligned(pair)
    before = snapshot(pair)
    done = geodelreg("check", path.name, "pan.tif", cwd=pair)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("aligned.tif: aligned, off by at most 0.0")
    assert "tolerance 0.5 PAN px" in done.stdout
    assert done.stderr == ""
    unsure = geodelreg("check", path.name, "pan.tif", "--tolerance", "0.001", cwd=pair)
    assert unsure.returncode == 3
    assert "would move" not in unsure.stdout
    assert "larger tolerance (--tolerance)" in unsure.stderr
    assert snapshot(pair) == before


def test_quiet_leaves_the_exit_code_alone(geodelreg: Command, pair: Path) -> None:
    for tolerance, code in (("0.5", 4), ("10", 0)):
        done = geodelreg("check", "ms.tif", "pan.tif", "-q", "--tolerance", tolerance, cwd=pair)
        assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


@pytest.mark.parametrize("as_json", [False, True])
def test_an_unrelated_pair_is_exit_3_with_the_reason(
    geodelreg: Command, pair: Path, as_json: bool
) -> None:
    write_noise(pair / "noise.tif", like=pair / "pan.tif", seed=1)
    before = snapshot(pair)
    done = geodelreg(*("check", "ms.tif", "noise.tif"), *["--json"] * as_json, cwd=pair)
    assert done.returncode == 3
    assert "geodelreg: refused: cannot tell whether ms.tif is aligned: " in done.stderr
    assert "needs" in done.stderr or "no transformation" in done.stderr
    assert "Traceback" not in done.stderr
    assert snapshot(pair) == before
    if as_json:
        report = json.loads(done.stdout)
        jsonschema.validate(report, report_schema())
        assert report["check"]["outcome"] == "cannot_tell"
        assert report["check"]["reason"] in done.stderr
        misalignment = report["check"]["misalignment"]
        assert misalignment.pop("residual_interval_px") == [None, None]
        assert misalignment.pop("moved") == ""
        assert set(misalignment.values()) == {None}
        assert report["check"]["affine_enough"] is None
    else:
        assert done.stdout == "ms.tif: cannot tell (tolerance 0.5 PAN px)\n"


def test_json_is_the_report_with_a_block_of_its_own(geodelreg: Command, whole_pair: Path) -> None:
    done = geodelreg("check", "ms.tif", "pan.tif", "--json", "--model", "scale", cwd=whole_pair)
    assert done.returncode == 4
    report = json.loads(done.stdout)
    jsonschema.validate(report, report_schema())
    block = report["check"]
    assert block["outcome"] == block["raster_outcome"] == "misaligned"
    assert block["limit_px"] == 0.5
    assert block["bands"] is None
    assert block["affine_enough"] is True
    assert 9 < block["misalignment"]["distance_px"] < 9.3
    assert report["correction"]["model"] == "scale"
    assert report["correction"]["at_centre"]["shift_px"] == pytest.approx([7.36, -4.62], abs=0.05)


def test_one_file_per_band(geodelreg: Command, whole_pair: Path) -> None:
    with rasterio.open(whole_pair / "ms.tif") as ms:
        for number in ms.indexes:
            with rasterio.open(
                whole_pair / f"B{number}.tif", "w", **ms.profile | {"count": 1}
            ) as band:
                band.write(ms.read(number), 1)
    done = geodelreg("check", "B1.tif", "B2.tif", "B3.tif", "B4.tif", "pan.tif", cwd=whole_pair)
    assert done.returncode == 4, done.stderr
    assert done.stdout.startswith("B1.tif and 3 more: misaligned by up to 9.")


CASES = {
    "no rasters": ((), "MS... PAN"),
    "one raster": (("ms.tif",), "at least two"),
    "negative tolerance": (("ms.tif", "pan.tif", "--tolerance", "-1"), "--tolerance"),
    "tolerance is a word": (("ms.tif", "pan.tif", "--tolerance", "tight"), "--tolerance"),
    "no output": (("ms.tif", "pan.tif", "-o", "out.tif"), "-o"),
    "band zero": (("ms.tif", "pan.tif", "-b", "0"), "--band 0"),
    "impossible GDAL option": (("ms.tif", "pan.tif", "--config", "A=B", "C"), "--config A=B C"),
}


@pytest.mark.parametrize(("args", "message"), CASES.values(), ids=CASES.keys())
def test_wrong_usage_is_exit_2(
    geodelreg: Command, tmp_path: Path, args: tuple[str, ...], message: str
) -> None:
    (tmp_path / "ms.tif").write_bytes(b"never read")
    done = geodelreg("check", *args, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Usage: geodelreg check" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_an_unreadable_raster_is_exit_1(geodelreg: Command, pair: Path) -> None:
    done = geodelreg("check", "missing.tif", "pan.tif", cwd=pair)
    assert done.returncode == 1
    assert "missing.tif" in done.stderr
    assert done.stdout == ""


def test_help_tells_the_tolerances_and_exit_codes_apart(geodelreg: Command) -> None:
    done = geodelreg("check", "--help")
    assert done.returncode == 0
    assert "[default: 0.5" in done.stdout
    assert done.stdout.count("--tolerance PX") == 1
    assert "3 cannot tell" in done.stdout
    assert "4 misaligned" in done.stdout
