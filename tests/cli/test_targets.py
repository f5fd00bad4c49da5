"""What may become an output: regular files that are no part of an input; `-` is stdout."""

from __future__ import annotations

import json
import os
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import rasterio
import rasterio.shutil

from tests.cli.helpers import Command, snapshot
from tests.integration.special_files import bound_socket

IS_ROOT = hasattr(os, "geteuid") and os.geteuid() == 0


def pipe(path: Path) -> None:
    os.mkfifo(path)


def null_device(path: Path) -> None:
    """As /dev/null, which a test must not lose; others than root cannot replace the real one."""
    if IS_ROOT:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    else:
        path.symlink_to("/dev/null")


def link_to_null(path: Path) -> None:
    null_device(path.with_name("null"))
    path.symlink_to("null")


SPECIAL = {"pipe": pipe, "socket": bound_socket, "device": null_device, "link": link_to_null}
SPECIAL["folder"] = Path.mkdir


@pytest.mark.parametrize(
    "args", [("revert", "ms.tif"), ("align", "ms.tif", "pan.tif", "--in-place")]
)
def test_a_record_of_edits_that_is_a_pipe_is_refused_at_once(
    geodelreg: Command, pair: Path, args: tuple[str, ...]
) -> None:
    os.mkfifo(pair / "ms.tif.geodelreg-undo.json")
    done = geodelreg(*args, cwd=pair)
    assert done.returncode == 1
    assert "ms.tif.geodelreg-undo.json" in done.stderr
    assert "no regular file" in done.stderr


def test_pam_that_is_a_pipe_is_refused_at_once(geodelreg: Command, pair: Path) -> None:
    os.mkfifo(pair / "ms.tif.aux.xml")
    done = geodelreg("align", "ms.tif", "pan.tif", "-o", "out.tif", cwd=pair)
    assert done.returncode == 1
    assert "ms.tif.aux.xml is a device or a pipe" in done.stderr


@pytest.mark.parametrize("option", [(), ("--of", "PNG"), ("--warp",)], ids=["copy", "anew", "warp"])
def test_rasters_with_a_name_that_gdal_cannot_be_given_are_refused(
    geodelreg: Command, pair: Path, option: tuple[str, ...]
) -> None:
    done = geodelreg(
        "align", "ms.tif", "pan.tif", "-o", os.fsdecode(b"x\xff.tif"), *option, cwd=pair
    )
    assert done.returncode == 1
    assert "its name is not UTF-8" in done.stderr
    assert "internal error" not in done.stderr
    assert sorted(kinds(pair)) == ["ms.tif", "pan.tif"]


def kinds(folder: Path) -> dict[str, int]:
    return {path.name: stat.S_IFMT(path.lstat().st_mode) for path in folder.iterdir()}


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize(
    "option", ["-o out.tif", "--dry-run --report", "--dry-run --figure", "--dry-run --gcps"]
)
def test_what_is_no_regular_file_is_never_replaced(
    geodelreg: Command, pair: Path, kind: str, option: str
) -> None:
    place = pair / "out.tif" if "out.tif" in option else pair / "out.geojson"
    SPECIAL[kind](place)
    before, files = kinds(pair), snapshot(pair)
    args = option.split() if "out.tif" in option else [*option.split(), place.name]
    done = geodelreg("align", "ms.tif", "pan.tif", *args, "--overwrite", cwd=pair)
    assert done.returncode == 1, done.stderr
    assert place.name in done.stderr
    assert "folder" in done.stderr or "device" in done.stderr
    assert kinds(pair) == before
    assert snapshot(pair) == files


def test_report_and_points_go_to_stdout(geodelreg: Command, pair: Path) -> None:
    before = snapshot(pair)
    args = ("align", "ms.tif", "pan.tif", "--dry-run")
    done = geodelreg(*args, "--report", "-", cwd=pair)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["verdict"]["outcome"] == "aligned"
    done = geodelreg(*args, "--gcps", "-", "--gcp-format", "geojson", cwd=pair)
    assert done.returncode == 0, done.stderr
    points = json.loads(done.stdout)
    assert points["type"] == "FeatureCollection"
    (pair / "given.geojson").write_text(done.stdout)
    files = ("given.geojson", "-", "--to", "qgis", "--raster", "ms.tif")
    done = geodelreg("gcps", *files, cwd=pair)
    assert done.returncode == 0, done.stderr
    assert f"{len(points['features'])} points" in done.stderr
    assert done.stdout.count("\n") == len(points["features"]) + 2
    (pair / "given.geojson").unlink()
    assert snapshot(pair) == before


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("-o", "-"), "a raster cannot be written to standard output"),
        (("--dry-run", "--gcps", "-"), "--gcp-format"),
        (("--dry-run", "--json", "--report", "-"), "two outputs"),
        (("--dry-run", "--figure", "-", "--report", "-"), "two outputs"),
    ],
)
def test_stdout_is_for_one_side_output(
    geodelreg: Command, pair: Path, args: tuple[str, ...], message: str
) -> None:
    before = snapshot(pair)
    done = geodelreg("align", "ms.tif", "pan.tif", *args, cwd=pair)
    assert done.returncode == 2, done.stderr
    assert message in " ".join(done.stderr.split())
    assert done.stdout == ""
    assert snapshot(pair) == before


def virtual(folder: Path, source: str, name: str) -> str:
    rasterio.shutil.copy(folder / source, folder / name, driver="VRT")
    return name


def in_a_vrt(folder: Path) -> str:
    return virtual(folder, "pan.tif", "p.vrt")


def in_a_vrt_in_a_vrt(folder: Path) -> str:
    text = (folder / in_a_vrt(folder)).read_text()
    (folder / "q.vrt").write_text(text.replace(">pan.tif<", ">p.vrt<"))
    return "q.vrt"


def with_header(folder: Path) -> str:
    rasterio.shutil.copy(folder / "pan.tif", folder / "pan.img", driver="ENVI")
    return "pan.img"


def with_header_in_a_vrt(folder: Path) -> str:
    return virtual(folder, with_header(folder), "p.vrt")


def with_statistics(folder: Path) -> str:
    (folder / "pan.tif.aux.xml").write_text("<PAMDataset></PAMDataset>")
    return "pan.tif"


def with_overviews(folder: Path) -> str:
    with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(folder / "pan.tif", "r+") as dataset:
        dataset.build_overviews([2, 4])
    return "pan.tif"


def in_an_archive(folder: Path) -> str:
    with zipfile.ZipFile(folder / "pan.zip", "w") as archive:
        archive.write(folder / "pan.tif", "pan.tif")
    return "/vsizip/pan.zip/pan.tif"


def linked(folder: Path) -> str:
    (folder / "other.tif").symlink_to("pan.tif")
    return in_a_vrt(folder)


def plain(_folder: Path) -> str:
    return "pan.tif"


@pytest.mark.parametrize("option", ["--report", "--gcps", "-o"])
@pytest.mark.parametrize(
    ("make", "part"),
    [
        (in_a_vrt, "pan.tif"),
        (in_a_vrt, "p.vrt"),
        (in_a_vrt_in_a_vrt, "pan.tif"),
        (in_a_vrt_in_a_vrt, "p.vrt"),
        (with_header, "pan.hdr"),
        (with_header_in_a_vrt, "pan.img"),
        (with_header_in_a_vrt, "pan.hdr"),
        (with_statistics, "pan.tif.aux.xml"),
        (with_overviews, "pan.tif.ovr"),
        (in_an_archive, "pan.zip"),
        (linked, "other.tif"),
        (plain, "ms.tif.geodelreg-undo.json"),
        (plain, "pan.tif.aux.xml"),  # there is none, and there must not be one
        (plain, "pan.tfw"),
    ],
)
def test_parts_of_inputs_are_inputs(
    geodelreg: Command, pair: Path, make: Callable[[Path], str], part: str, option: str
) -> None:
    pan = make(pair)
    before = snapshot(pair)
    args = (option, part) if option == "-o" else ("--dry-run", option, part)
    more = ("--gcp-format", "geojson") if option == "--gcps" else ()
    done = geodelreg("align", "ms.tif", pan, *args, *more, "--overwrite", "--of", "GTiff", cwd=pair)
    assert done.returncode == 2, done.stderr
    assert f"{part} is the input" in done.stderr or f"{part} would be taken for" in done.stderr
    assert snapshot(pair) == before


def test_parts_of_masks_are_inputs(geodelreg: Command, pair: Path) -> None:
    for suffix in ("shp", "shx", "dbf", "prj"):
        (pair / f"lakes.{suffix}").write_bytes(b"as it is")
    before = snapshot(pair)
    done = geodelreg(
        *("align", "ms.tif", "pan.tif", "--dry-run", "--mask", "lakes.shp"),
        *("--report", "lakes.dbf", "--overwrite"),
        cwd=pair,
    )
    assert done.returncode == 2, done.stderr
    assert "lakes.dbf is the input" in done.stderr
    assert snapshot(pair) == before


def test_side_outputs_are_no_parts_of_the_raster_output(geodelreg: Command, pair: Path) -> None:
    before = snapshot(pair)
    done = geodelreg(
        *("align", "ms.tif", "pan.tif", "-o", "out.tif", "--report", "out.tif.aux.xml"), cwd=pair
    )
    assert done.returncode == 2, done.stderr
    assert "out.tif.aux.xml would be taken for a part of out.tif" in done.stderr
    assert snapshot(pair) == before


def test_converted_points_do_not_replace_what_they_come_from(
    geodelreg: Command, pair: Path
) -> None:
    made = ("align", "ms.tif", "pan.tif", "--dry-run", "--gcps", "a.geojson")
    assert geodelreg(*made, cwd=pair).returncode == 0
    before = snapshot(pair)
    for target in ("a.geojson", "ms.tif", "ms.tif.aux.xml"):
        args = ("a.geojson", target, "--to", "qgis", "--raster", "ms.tif", "--overwrite")
        done = geodelreg("gcps", *args, cwd=pair)
        assert done.returncode == 2, done.stderr
        assert target in done.stderr
    assert snapshot(pair) == before


def test_later_output_that_fails_takes_the_raster_back(geodelreg: Command, pair: Path) -> None:
    """The place of the figure is taken while the command runs; seen only when all is in place."""
    (pair / ".out.png.geodelreg").mkdir()
    (pair / ".out.png.geodelreg" / "photos").mkdir()
    before = snapshot(pair)
    done = geodelreg(
        *("align", "ms.tif", "pan.tif", "-o", "out.tif", "--figure", "out.png"), cwd=pair
    )
    assert done.returncode == 1, done.stderr
    assert ".out.png.geodelreg holds photos" in done.stderr
    assert snapshot(pair) == before
    assert (pair / ".out.png.geodelreg" / "photos").is_dir()
