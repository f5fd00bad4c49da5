"""Outputs are checked before the work starts; the inputs here cannot even be opened."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from geodelreg.errors import (
    OutputExistsError,
    OutputIsInputError,
    OutputUnwritableError,
    UsageError,
)
from geodelreg_cli.outputs import check_targets, raster_targets
from tests.cli.helpers import Command, snapshot


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("ms.tif", "pan.tif", "old.tif", "old.json"):
        (tmp_path / name).write_bytes(name.encode())
    (tmp_path / "sub").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("args", "code", "message", "remedy"),
    [
        (("-o", "old.tif"), 1, "old.tif exists", "--overwrite"),
        (("-o", "new.tif", "--report", "old.json"), 1, "old.json exists", "--overwrite"),
        (("-o", "new.tif", "--gcps", "sub/../old.json"), 1, "exists", "--overwrite"),
        (("-o", "ms.tif", "--overwrite"), 2, "ms.tif is the input ms.tif", "--in-place"),
        (("-o", "sub/../pan.tif", "--overwrite"), 2, "is the input pan.tif", "--in-place"),
        (("-o", "missing/new.tif"), 1, "its folder does not exist", "Create the folder"),
        (("-o", "old.tif/new.tif"), 1, "a file is where its folder should be", "another folder"),
        (("-o", "sub"), 1, "sub is a folder", "ms.tif"),
        (("-o", "new.tif", "--figure", "sub"), 1, "sub cannot be written: it is a folder", "file"),
        (("--in-place", "--report", "old.json"), 1, "old.json exists", "--overwrite"),
    ],
)  # fmt: skip
def test_refused_before_anything_is_read(
    geodelreg: Command, folder: Path, args: tuple[str, ...], code: int, message: str, remedy: str
) -> None:
    before = snapshot(folder)
    done = geodelreg("align", "ms.tif", "pan.tif", *args, cwd=folder)
    assert done.returncode == code
    assert message in done.stderr
    assert remedy in done.stderr
    assert "Traceback" not in done.stderr
    assert snapshot(folder) == before


def test_several_ms_files_need_a_folder_and_names_of_their_own(
    geodelreg: Command, folder: Path
) -> None:
    (folder / "sub" / "ms.tif").write_bytes(b"")
    before = snapshot(folder)
    same = geodelreg("align", "ms.tif", "sub/ms.tif", "pan.tif", "-o", "out", cwd=folder)
    assert (same.returncode, "Two MS files are called ms.tif" in same.stderr) == (2, True)
    file = geodelreg("align", "ms.tif", "old.json", "pan.tif", "-o", "old.tif", cwd=folder)
    assert (file.returncode, "old.tif is a file" in file.stderr) == (1, True)
    deep = geodelreg("align", "ms.tif", "old.json", "pan.tif", "-o", "no/out", cwd=folder)
    assert (deep.returncode, "its folder does not exist" in deep.stderr) == (1, True)
    assert snapshot(folder) == before


def test_targets_of_one_and_of_several_files(folder: Path) -> None:
    assert raster_targets(["a/ms.tif"], folder / "new.tif") == [folder / "new.tif"]
    out = folder / "out"
    assert raster_targets(["a/B2.tif", "b/B3.tif"], out) == [out / "B2.tif", out / "B3.tif"]
    with pytest.raises(UsageError, match=r"B2\.tif"):
        raster_targets(["a/B2.tif", "b/B2.tif"], out)
    check_targets([], [out / "B2.tif", out / "B3.tif"], False, created=out)
    with pytest.raises(OutputUnwritableError, match="Create the folder"):
        check_targets([], [out / "B2.tif"], False)


@pytest.mark.parametrize("link", [os.symlink, os.link], ids=["symlink", "hard link"])
def test_an_input_is_known_by_its_other_name(folder: Path, link: object) -> None:
    assert callable(link)
    link(folder / "ms.tif", folder / "alias.tif")
    with pytest.raises(OutputIsInputError, match=r"alias\.tif"):
        check_targets([str(folder / "ms.tif")], [folder / "alias.tif"], overwrite=True)


def test_overwrite_replaces_files_only(folder: Path) -> None:
    check_targets(["ms.tif"], [folder / "old.tif"], overwrite=True)
    with pytest.raises(OutputExistsError, match=r"old\.tif exists"):
        check_targets(["ms.tif"], [folder / "old.tif"], overwrite=False)
    with pytest.raises(OutputUnwritableError, match="is a folder"):
        check_targets(["ms.tif"], [folder / "sub"], overwrite=True)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write")
def test_a_folder_without_write_permission(folder: Path) -> None:
    (folder / "sub").chmod(0o555)
    with pytest.raises(OutputUnwritableError, match="permission denied"):
        check_targets([], [folder / "sub" / "new.tif"], overwrite=False)


def test_names_that_are_no_local_files_are_never_outputs(folder: Path) -> None:
    check_targets(
        ["s3://bucket/ms.tif", "/vsizip/a.zip/ms.tif", "NETCDF:x.nc:v"],
        [folder / "new.tif"],
        overwrite=False,
    )
