"""The QGIS plugin as it is packed, and what of it needs no QGIS.

The rest is tried in the real program: ``plugins/qgis/check.py``.
"""

from __future__ import annotations

import ast
import configparser
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import rasterio

import geodelreg
from geodelreg_qgis.command import (
    CommandError,
    check_version,
    commands_of,
    find_command,
    run,
)
from geodelreg_qgis.environment import bundled_wheel, find_python, make_environment
from geodelreg_qgis.messages import reason, sort_line
from geodelreg_qgis.options import Commands, load_commands
from geodelreg_qgis.sources import Source, SourceError, check_pair, file_of
from geodelreg_qgis.tie_points import read_tie_points
from tests.cli.helpers import ROOT, Command, snapshot, write_noise

PLUGIN = ROOT / "plugins" / "qgis"
FACING_QGIS = {
    *("align", "apply", "base", "batch", "check", "install", "loading", "pansharpen", "plugin"),
    "provider",
}
OFFERED = ("align", "apply", "batch", "check", "pansharpen")


def never() -> bool:
    return False


def script(path: Path, text: str) -> str:
    """An executable that runs a few lines of shell."""
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(0o755)
    return str(path)


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plugin's zip, made by its one command."""
    folder = tmp_path_factory.mktemp("packed")
    command = [sys.executable, PLUGIN / "pack.py", folder]
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    (path,) = folder.glob("*.zip")
    return path


@pytest.fixture(scope="module")
def unpacked(packed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plugins")
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(folder)
    return folder / "geodelreg_qgis"


@pytest.fixture(scope="module")
def known(unpacked: Path) -> Commands:
    return load_commands(unpacked / "commands.json")


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A ``geodelreg`` command on PATH, in a folder with a space."""
    folder = tmp_path / "my programs"
    folder.mkdir()
    made = script(folder / "geodelreg", f'exec "{sys.executable}" -m geodelreg_cli "$@"')
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
    return made


# --- the zip --------------------------------------------------------------------------------------


def test_the_zip_holds_the_plugin_and_nothing_else(packed: Path) -> None:
    sources = {
        path.relative_to(PLUGIN).as_posix()
        for path in (PLUGIN / "geodelreg_qgis").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    wheel = f"wheels/geodelreg-{geodelreg.__version__}-py3-none-any.whl"
    added = {f"geodelreg_qgis/{name}" for name in ("LICENSE", "commands.json", wheel)}
    with zipfile.ZipFile(packed) as archive:
        assert set(archive.namelist()) == sources | added
        assert archive.testzip() is None
    assert packed.name == f"geodelreg_qgis-{geodelreg.__version__}.zip"


def test_the_metadata_say_what_qgis_asks_for(unpacked: Path) -> None:
    metadata = configparser.ConfigParser(interpolation=None)
    metadata.read(unpacked / "metadata.txt", encoding="utf-8")
    general = metadata["general"]
    for key in ("name", "description", "about", "author", "tags", "category", "license"):
        assert general[key]
    assert general["version"] == geodelreg.__version__
    assert general["qgisMinimumVersion"] == "3.22"
    assert general["hasProcessingProvider"] == "yes"
    assert (unpacked / general["icon"]).is_file()


def test_the_wheel_in_the_zip_is_geodelreg(unpacked: Path) -> None:
    with zipfile.ZipFile(bundled_wheel(unpacked / "wheels")) as wheel:
        text = wheel.read("geodelreg/version.py").decode()
    assert geodelreg.__version__ in text
    with pytest.raises(CommandError, match="holds no wheel"):
        bundled_wheel(unpacked / "styles")


@pytest.mark.parametrize(
    "path", sorted((PLUGIN / "geodelreg_qgis").glob("*.py")), ids=lambda path: path.stem
)
def test_no_second_gdal_comes_into_qgis_and_helpers_need_no_qgis(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 9))
    imported = {
        name.partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in (
            [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
        )
    }
    allowed = set(sys.stdlib_module_names) | {"geodelreg_qgis"}
    assert imported <= allowed | ({"qgis", "processing"} if path.stem in FACING_QGIS else set())
    assert len(path.read_text(encoding="utf-8").splitlines()) < 400


# --- options --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OFFERED)
def test_every_option_is_one_of_the_command_with_its_help(
    known: Commands, geodelreg: Command, name: str
) -> None:
    text = " ".join(geodelreg(name, "--help").stdout.split())
    options = known.by_name[name].options
    assert len(options) > 7
    for option in options:
        assert f"{option.flag} " in text
        assert " ".join(option.help.split())[:40] in text


def test_options_that_differ_from_the_defaults_reach_the_command(
    known: Commands, geodelreg: Command, pair: Path
) -> None:
    values = {
        "method": "delaunay",
        "model": "shift",
        "band": 2,
        "search_radius_px": 300.5,
        "max_keypoints": 2500,
        "max_shift_px": 80.0,
        "on_local": "warn",
        "ratio": 0.8,
        "pan_band": None,
        "threads": 1,
    }
    words = known.by_name["align"].arguments(values)
    assert "--method" not in words
    assert "--ratio" not in words
    done = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", "--json", *words, cwd=pair)
    options = json.loads(done.stdout)["options"]
    expected = {key: value for key, value in values.items() if value is not None}
    assert {key: options[key] for key in expected} == expected
    assert options["pan_band"] == 1


def test_a_correction_is_applied_as_the_options_say(
    known: Commands, geodelreg: Command, pair: Path
) -> None:
    found = ("align", "ms.tif", "pan.tif", "--dry-run", "--report", "found.json")
    assert geodelreg(*found, cwd=pair).returncode == 0
    given = {
        "warp": True,
        "warp_grid": "pan",
        "resampling": "nearest",
        "driver": "GTiff",
        "allow": "all",
    }
    words = known.by_name["apply"].arguments({**given, "force": True, "strip_rpc": False})
    assert "--force" in words
    assert "--strip-rpc" not in words
    done = geodelreg("apply", "found.json", "ms.tif", "-o", "warped", *words, cwd=pair)
    assert done.returncode == 0
    with rasterio.open(pair / "warped") as warped, rasterio.open(pair / "pan.tif") as pan:
        assert (warped.transform, warped.shape) == (pan.transform, pan.shape)
    with rasterio.open(pair / "ms.tif") as ms, rasterio.open(pair / "warped") as warped:
        assert set(np.unique(warped.read(1))) <= {0, *np.unique(ms.read(1))}


def test_flags_and_repeated_options(known: Commands) -> None:
    given = {"warp": True, "strip_rpc": False, "creation_options": ["A=1", "", "B=2"], "driver": ""}
    words = known.by_name["align"].arguments(given)
    assert words == ["--co", "A=1", "--co", "B=2", "--warp"]


# --- the command ----------------------------------------------------------------------------------


def test_the_command_is_found_on_path_or_where_the_setting_says(
    command: str, tmp_path: Path
) -> None:
    assert find_command("") == command
    assert find_command(command) == command
    with pytest.raises(CommandError, match=r"no geodelreg command at .*nothing.*Install geodelreg"):
        find_command(str(tmp_path / "nothing"))
    assert {"align", "apply", "check", "batch", "pansharpen"} <= commands_of(command)


def test_no_command_on_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CommandError, match="no geodelreg command on PATH"):
        find_command("")


def test_an_older_geodelreg_and_other_programs_are_refused(command: str, tmp_path: Path) -> None:
    assert check_version(command, geodelreg.__version__) == geodelreg.__version__
    for text, message in (
        ("echo geodelreg 0.0.9", "is geodelreg 0.0.9, and this plugin needs 0.1.0"),
        ("echo GDAL 3.10", "is not geodelreg"),
        ("echo broken >&2; exit 1", "does not work: broken"),
    ):
        with pytest.raises(CommandError, match=message):
            check_version(script(tmp_path / "other", text), "0.1.0")
    with pytest.raises(CommandError, match="cannot be run"):
        check_version(str(tmp_path / "missing"), "0.1.0")


def test_qgis_environment_does_not_reach_the_command(
    command: str, pair: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run([command, "align", *names(pair, "a.tif")], print, never).code == 0
    for name in (
        "PYTHONHOME",
        "PYTHONPATH",
        "PROJ_LIB",
        "PROJ_DATA",
        "GDAL_DATA",
        "GDAL_DRIVER_PATH",
    ):
        monkeypatch.setenv(name, str(pair / "of QGIS"))
    assert subprocess.run([command, "--version"], capture_output=True).returncode != 0
    heard: list[str] = []
    finished = run([command, "align", *names(pair, "b.tif"), "-v"], heard.append, never)
    assert finished.code == 0
    assert (pair / "a.tif").read_bytes() == (pair / "b.tif").read_bytes()
    assert tuple(heard) == finished.messages
    lines = [sort_line(line) for line in heard]
    percents = [line.percent for line in lines if line.kind == "step"]
    assert len(percents) >= 3
    assert percents == sorted(percents)
    assert percents[-1] == 100


def names(folder: Path, output: str) -> list[str]:
    return [str(folder / "ms.tif"), str(folder / "pan.tif"), "-o", str(folder / output)]


def test_spaces_and_umlauts_in_names(command: str, pair: Path) -> None:
    folder = pair / "Übung 1"
    folder.mkdir()
    for name in ("ms.tif", "pan.tif"):
        shutil.move(pair / name, folder)
    assert run([command, "align", *names(folder, "übergelegt.tif")], print, never).code == 0
    assert (folder / "übergelegt.tif").exists()
    heard: list[str] = []
    finished = run([command, "align", *names(folder, "kein Ordner/ä.tif")], heard.append, never)
    assert finished.code != 0
    assert "Übung 1" in reason(heard)


def test_cancelling_leaves_nothing(command: str, pair: Path) -> None:
    before = snapshot(pair)
    heard: list[str] = []
    finished = run(
        [command, "align", *names(pair, "a.tif"), "-v"], heard.append, lambda: bool(heard)
    )
    assert finished.code is None
    assert snapshot(pair) == before


def test_a_command_that_does_not_go_is_ended(tmp_path: Path) -> None:
    stubborn = script(
        tmp_path / "stubborn", 'trap "" TERM; echo $$ >&2; while :; do sleep 0.1; done'
    )
    heard: list[str] = []
    assert run([stubborn], heard.append, lambda: bool(heard)).code is None
    with pytest.raises(ProcessLookupError):
        os.kill(int(heard[0]), 0)


def test_refusals_and_errors_are_told_in_words(command: str, pair: Path) -> None:
    write_noise(pair / "ms.tif", pair / "ms.tif", 5)
    refused = run([command, "align", *names(pair, "a.tif")], print, never)
    assert refused.code == 3
    assert reason(refused.messages).startswith("Refused: ")
    assert "geodelreg:" not in reason(refused.messages)
    wrong = run([command, "align", *names(pair, "a.tif"), "--max-shift", "x"], print, never)
    assert "'x' is not a valid float" in reason(wrong.messages)
    assert reason(()) != ""


def test_lines_of_the_log() -> None:
    assert sort_line("geodelreg: warning: clouds").kind == "warning"
    assert sort_line("geodelreg: warning: clouds").text == "Warning: clouds"
    assert sort_line("12 a b.tif: refused, AlignmentRefusedError, why").kind == "pair"
    assert sort_line("2 pairs: 1 failed, 1 aligned").kind == "info"


# --- layers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (Source("a", "memory", "Point?crs=EPSG:4326"), "temporary layer.*Save it to a file"),
        (Source("a", "wms", "url=http://x"), "web map.*Save it to a file"),
        (Source("a", "postgresraster", "dbname=x"), "table of a database"),
        (Source("a", "mesh_memory", "x"), "QGIS's provider “mesh_memory”"),
        (Source("a", "gdal", "/vsimem/a.tif"), "kept in memory"),
        (Source("a", "ogr", "/a.shp", unsaved=True), "not saved"),
        (Source("a", "ogr", "/a.shp", filter="x = 1"), r"filter x = 1"),
        (Source("a", "gdal", "/a.tif", crs="EPSG:1"), "EPSG:1 in QGIS only; its file states none"),
        (Source("a", "gdal", "/a.tif", crs="EPSG:1", file_crs="EPSG:2"), "its file says EPSG:2"),
    ],
)
def test_layers_that_are_no_plain_files_are_refused(source: Source, message: str) -> None:
    with pytest.raises(SourceError, match=f"“a”.*{message}"):
        file_of(source)


def test_a_raster_is_not_its_own_reference() -> None:
    check_pair(["/a.tif", "/b.tif"], ["/c.tif"])
    with pytest.raises(SourceError, match=r"b\.tif is chosen as MS and as PAN"):
        check_pair(["/a.tif", "/b.tif"], ["/b.tif"])


def test_layers_that_are_files() -> None:
    assert file_of(Source("a", "gdal", "/ä b/a.tif")) == "/ä b/a.tif"
    assert file_of(Source("a", "ogr", "/a.gpkg", "EPSG:1", "EPSG:1")) == "/a.gpkg"


# --- tie points -----------------------------------------------------------------------------------


def test_tie_points_are_where_the_headers_say(geodelreg: Command, pair: Path) -> None:
    args = ("-o", "a.tif", "--gcps", "a.points", "--report", "a.json", "--model", "affine")
    assert geodelreg("align", "ms.tif", "pan.tif", *args, cwd=pair).returncode == 0
    points = list(read_tie_points(pair / "a.points", pair / "a.json"))
    assert len(points) > 30
    with rasterio.open(pair / "ms.tif") as before, rasterio.open(pair / "a.tif") as after:
        for point in points:
            pixel = ~before.transform @ (point.was_x, point.was_y)
            x, y = after.transform @ pixel
            assert np.allclose(
                (point.x - x, point.y - y), (point.residual_x, point.residual_y), atol=1e-3
            )
            residual_px = np.hypot(*np.subtract(~after.transform @ (point.x, point.y), pixel))
            assert point.residual_px == pytest.approx(residual_px, abs=1e-5)


def test_tie_points_of_a_map_that_no_header_holds(geodelreg: Command, pair: Path) -> None:
    args = ("--dry-run", "--gcps", "a.points", "--report", "a.json", "--model", "projective")
    assert geodelreg("align", "ms.tif", "pan.tif", *args, cwd=pair).returncode == 0
    points = list(read_tie_points(pair / "a.points", pair / "a.json"))
    assert {(point.residual_x, point.residual_y) for point in points} == {(0.0, 0.0)}


# --- the environment ------------------------------------------------------------------------------


def test_a_python_that_cannot_make_environments_is_told(tmp_path: Path) -> None:
    assert find_python(sys.executable) == sys.executable
    without = tmp_path / "without"
    without.mkdir()
    (without / "sitecustomize.py").write_text(
        "import sys\n"
        "class Gone:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'ensurepip':\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Gone())\n"
        "import importlib.util\n"
        "real = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name: None if name == 'ensurepip' else real(name)\n",
        encoding="utf-8",
    )
    poor = script(tmp_path / "poor", f'PYTHONPATH="{without}" exec "{sys.executable}" "$@"')
    with pytest.raises(CommandError, match=r"no venv and ensurepip.*apt install python3-venv"):
        find_python(poor)
    old = script(tmp_path / "old", "echo 3 9 True")
    with pytest.raises(CommandError, match=r"old is 3\.9.*Install Python 3\.11 or later"):
        find_python(old)
    with pytest.raises(CommandError, match="does not work"):
        find_python(str(tmp_path / "nothing"))


def test_an_environment_is_made_whole_or_not_at_all(tmp_path: Path) -> None:
    missing = tmp_path / "geodelreg-9-py3-none-any.whl"
    parent = tmp_path / "environments"
    heard: list[str] = []
    with pytest.raises(CommandError, match=r"pip .*install"):
        make_environment(parent, sys.executable, missing, "0.1.0", heard.append, never)
    assert list(parent.iterdir()) == []
    assert make_environment(parent, sys.executable, missing, "0.1.0", print, lambda: True) is None
    assert list(parent.iterdir()) == []
