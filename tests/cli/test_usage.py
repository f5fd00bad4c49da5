"""Wrong usage: exit 2, the flag named, nothing read and nothing written."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.helpers import Command, snapshot

ALIGN = ("align", "ms.tif", "pan.tif")
OUT = (*ALIGN, "-o", "out.tif")

CASES = {
    "no command of that name": (("algin",), "algin"),
    "no rasters": (("align", "-o", "out.tif"), "MS... PAN"),
    "one raster": (("align", "ms.tif", "-o", "out.tif"), "at least two"),
    "no output": (ALIGN, "-o OUT, --in-place, --dry-run"),
    "two ways out": ((*OUT, "--in-place"), "one of"),
    "unknown flag": ((*OUT, "--sharpen"), "--sharpen"),
    "unknown method": ((*OUT, "--method", "magic"), "'magic' is not one of"),
    "unknown model": ((*OUT, "--model", "spline"), "'spline' is not one of"),
    "band is a word": ((*OUT, "--band", "red"), "neither a whole number nor auto"),
    "band zero": ((*OUT, "-b", "0"), "--band 0 is out of range"),
    "negative radius": ((*OUT, "--search-radius", "-1"), "--search-radius -1.0"),
    "scale below one": ((*OUT, "--max-scale", "0.5"), "--max-scale 0.5"),
    "no uncertainty at all": ((*OUT, "--max-uncertainty", "0"), "--max-uncertainty 0.0 is out of"),
    "threads below zero": ((*OUT, "-j", "-2"), "--num-threads -2"),
    "creation option without value": ((*OUT, "--co", "COMPRESS"), "KEY=VALUE"),
    "warp onto GCPs": ((*OUT, "--warp", "--georef", "gcps"), "exclude each other"),
    "in place with a format": ((*ALIGN, "--in-place", "--of", "GTiff"), "drop --of"),
    "format of no GCPs": ((*OUT, "--gcp-format", "qgis"), "needs --gcps"),
    "GCPs of no format": ((*OUT, "--gcps", "points.xyz"), "points.xyz"),
    "one name twice": ((*OUT, "--report", "out.tif"), "two outputs"),
    "impossible GDAL option": ((*OUT, "--config", "A=B", "C"), "--config A=B C"),
}


@pytest.mark.parametrize(("args", "message"), CASES.values(), ids=CASES.keys())
def test_wrong_usage(
    geodelreg: Command, tmp_path: Path, args: tuple[str, ...], message: str
) -> None:
    (tmp_path / "ms.tif").write_bytes(b"never read")
    before = snapshot(tmp_path)
    done = geodelreg(*args, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Usage: geodelreg" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert snapshot(tmp_path) == before


def test_help_shows_examples_units_and_defaults(geodelreg: Command) -> None:
    done = geodelreg("align", "--help")
    assert done.returncode == 0
    assert done.stderr == ""
    for text in (
        "geodelreg align ms.tif pan.tif -o aligned.tif\n",
        "--search-radius PX",
        "[default: 512]",
        "--max-rotation DEG",
        "-j, --num-threads N|ALL_CPUS",
        "--co KEY=VALUE",
        "Exit codes: 0 done",
    ):
        assert text in done.stdout


def test_version(geodelreg: Command) -> None:
    import geodelreg as library

    assert geodelreg("--version").stdout == f"geodelreg {library.__version__}\n"
