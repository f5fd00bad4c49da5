"""What the command says of files that strangers made: it names causes, and obeys no name."""

from __future__ import annotations

import json
import subprocess
import sys
from html import escape
from pathlib import Path

import pytest
import rasterio
from pyproj import CRS

from geodelreg import align
from geodelreg.errors import AlignmentRefusedError
from tests.cli.helpers import Command, snapshot
from tests.integration.crs_zoo import ENGINEERING

HOSTILE = "\x1b[31mred\x9b2J\u202eright\nerror: to left\x07"


def unshown(text: str) -> set[str]:
    """Characters that a terminal obeys, line ends apart."""
    return {char for char in text if not char.isprintable() and char != "\n"}


def with_crs(raster: Path, wkt: str) -> None:
    Path(f"{raster}.aux.xml").write_text(f"<PAMDataset><SRS>{escape(wkt)}</SRS></PAMDataset>")


def described(path: Path, text: str) -> None:
    with rasterio.open(path, "r+") as dataset:
        dataset.descriptions = [f"{number} {text}" for number in dataset.indexes]


@pytest.fixture
def hostile(pair: Path) -> Path:
    """MS with a name and band names that would control the terminal; its folder holds PAN."""
    ms = pair / f"{HOSTILE}.tif"
    (pair / "ms.tif").rename(ms)
    described(ms, HOSTILE.replace("\x07", ""))
    return ms


@pytest.mark.parametrize(
    "args",
    [
        ("check", "MS", "pan.tif", "--per-band"),
        ("check", "MS", "pan.tif", "--json"),
        ("align", "MS", "pan.tif", "-o", "out \x1b[1m.tif", "-v", "--georef", "gcps"),
        ("align", "MS", "pan.tif", "-o", "out.png", "-vv", "--debug"),
        ("align", "MS", "pan.tif", "--dry-run", "--mask", "\x1b[1m.tif"),
        ("align", "MS", "MS", "-o", "MS"),
        ("align", "\x1b]0;title\x07.tif", "pan.tif", "--dry-run"),
        ("check", "MS", "pan.tif", "--band", "99", "--debug"),
        ("check", "pan.tif", "pan.tif", "--band", "\x1b[1m"),
        ("gcps", "points.csv", "\x1b[1m.geojson", "--raster", "MS"),
        ("revert", "MS"),
    ],
)
def test_names_are_shown_and_not_obeyed(
    geodelreg: Command, hostile: Path, args: tuple[str, ...]
) -> None:
    (hostile.parent / "points.csv").write_text("pixel,line,x,y\n1,2,440000,4100000\n")
    named = [str(hostile) if arg == "MS" else arg for arg in args]
    done = geodelreg(*named, cwd=hostile.parent)
    assert unshown(done.stdout + done.stderr) == set()
    assert "error: to left" not in (done.stdout + done.stderr).split("\n")
    assert "Traceback" not in done.stderr or "--debug" in args


def test_escapes_in_band_names_are_written_out(geodelreg: Command, hostile: Path) -> None:
    done = geodelreg("check", hostile, hostile.parent / "pan.tif", "--per-band")
    assert r"\x1b[31mred\x9b2J\u202eright\nerror: to left" in done.stdout

    report = geodelreg("check", hostile, hostile.parent / "pan.tif", "--json").stdout
    assert json.loads(report)["inputs"]["source"]["files"][0]["path"] == str(hostile)


def test_engineering_crs_is_kept(geodelreg: Command, pair: Path) -> None:
    for name in ("ms.tif", "pan.tif"):
        with_crs(pair / name, ENGINEERING)
    done = geodelreg("align", "ms.tif", "pan.tif", "-o", "out.tif", cwd=pair)
    assert done.returncode == 0
    assert "out.tif.aux.xml" in done.stderr
    with rasterio.open(pair / "out.tif") as dataset:
        assert CRS.from_wkt(dataset.crs.to_wkt()).name == "hall"


def test_engineering_crs_against_a_projected_one_is_refused(geodelreg: Command, pair: Path) -> None:
    with_crs(pair / "ms.tif", ENGINEERING)
    before = snapshot(pair)
    done = geodelreg("align", "ms.tif", "pan.tif", "-o", "out.tif", cwd=pair)
    assert done.returncode == 1
    assert "no transformation between the coordinate reference systems 'hall' and" in done.stderr
    assert "list index" not in done.stderr
    assert snapshot(pair) == before


def test_one_refusal_speaks_of_arguments_and_of_flags(geodelreg: Command, pair: Path) -> None:
    done = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", "--max-shift", "0.5", cwd=pair)
    with pytest.raises(AlignmentRefusedError) as caught:
        align(pair / "ms.tif", pair / "pan.tif", max_shift_px=0.5)
    assert "(`max_shift_px`, `max_rotation_deg`, `max_scale`): allow more" in str(caught.value)
    assert "(--max-shift, --max-rotation, --max-scale): allow more" in done.stderr
    assert "`" not in done.stderr


@pytest.mark.parametrize("crs", ["+proj=utm +zone=18", "+proj=longlat"])
def test_missing_grid_is_named(geodelreg: Command, pair: Path, crs: str) -> None:
    with_crs(pair / "ms.tif", CRS(f"{crs} +ellps=intl +nadgrids=nothere.gsb").to_wkt("WKT2_2019"))
    done = geodelreg("align", "ms.tif", "pan.tif", "-o", "out.tif", cwd=pair)
    assert done.returncode == 1
    assert "PROJ cannot use the coordinate reference system of ms.tif" in done.stderr
    assert "Install the grid" in done.stderr
    assert "internal error" not in done.stderr


def test_format_of_separate_bands_is_refused(geodelreg: Command, pair: Path) -> None:
    done = geodelreg("align", "ms.tif", "pan.tif", "-o", "out.nc", cwd=pair)
    assert done.returncode == 1
    assert "netCDF makes each band a raster of its own" in done.stderr
    assert sorted(snapshot(pair)) == ["ms.tif", "pan.tif"]


def test_figure_without_matplotlib_is_refused_before_the_work(pair: Path) -> None:
    (pair / "pan.tif").write_bytes(b"never looked at")
    code = (
        "import sys; sys.modules['matplotlib'] = None; from geodelreg_cli.main import run; "
        "sys.exit(run(['align', 'ms.tif', 'pan.tif', '-o', 'out.tif', '--figure', 'out.png']))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=pair, capture_output=True, text=True)
    assert done.returncode == 1
    assert "figures need matplotlib" in done.stderr
    assert "pip install '.[report]'" in done.stderr
    assert sorted(snapshot(pair)) == ["ms.tif", "pan.tif"]


@pytest.mark.parametrize(
    ("args", "warned"),
    [
        (("align", "--dry-run"), True),
        (("align", "-o", "out.tif", "--warp"), False),
        (("align", "-o", "out.tif", "--georef", "gcps"), False),
        (("check",), False),
    ],
)
def test_a_rotated_header_is_warned_of_where_one_is_written(
    geodelreg: Command, pair: Path, args: tuple[str, ...], warned: bool
) -> None:
    done = geodelreg(args[0], "ms.tif", "pan.tif", *args[1:], "--model", "affine", cwd=pair)
    assert ("no longer north-up" in done.stderr) == warned
    assert "--warp" not in done.stderr or warned
