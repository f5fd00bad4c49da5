"""What is installed: two packages, their data, manual pages, entry points, and nothing else."""

from __future__ import annotations

import configparser
import email
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import click
import pytest

import geodelreg
from geodelreg_cli.main import COMMANDS, cli

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a freshly built wheel and source archive."""
    target, scratch = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("scratch")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(target), str(ROOT)]
    built = subprocess.run(
        [*command, "--wheel", "--sdist"], capture_output=True, text=True,
        env=os.environ | {"TMPDIR": str(scratch)},
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    assert list(scratch.iterdir()) == []
    return target


@pytest.fixture(scope="module")
def wheel(distributions: Path) -> zipfile.ZipFile:
    (path,) = distributions.glob("*.whl")
    return zipfile.ZipFile(path)


def test_wheel_installs_two_packages_and_no_package_called_cli(wheel: zipfile.ZipFile) -> None:
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert tops == {
        "geodelreg",
        "geodelreg_cli",
        f"geodelreg-{geodelreg.__version__}.dist-info",
        f"geodelreg-{geodelreg.__version__}.data",
    }


def test_wheel_holds_every_module_and_data_file_of_the_library(wheel: zipfile.ZipFile) -> None:
    expected = {
        path.relative_to(base).as_posix()
        for base, package in ((ROOT, "geodelreg"), (ROOT / "cli", "geodelreg_cli"))
        for path in (base / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {"geodelreg/py.typed", "geodelreg_cli/main.py"} <= expected
    parts = (".dist-info/", ".data/")
    assert expected == {
        name for name in wheel.namelist() if not any(part in name for part in parts)
    }


def test_wheel_holds_a_manual_page_of_every_command_with_its_options(
    wheel: zipfile.ZipFile,
) -> None:
    folder = f"geodelreg-{geodelreg.__version__}.data/data/share/man/man1/"
    context = click.Context(cli, info_name="geodelreg")
    pages = {"geodelreg": cli} | {
        f"geodelreg-{name}": cli.get_command(context, name) for name in COMMANDS
    }
    assert {name for name in wheel.namelist() if ".data/" in name} == {
        f"{folder}{page}.1" for page in pages
    }
    for page, command in pages.items():
        text = wheel.read(f"{folder}{page}.1").decode().replace("\\-", "-")
        assert command is not None
        assert f".SH NAME\n{page} - " in text
        for param in command.params:
            for flag in param.opts if isinstance(param, click.Option) else ():
                assert flag in text


def test_an_index_would_take_the_distributions(distributions: Path) -> None:
    command = [sys.executable, "-m", "twine", "check", "--strict"]
    checked = subprocess.run(
        [*command, *map(str, distributions.iterdir())], capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_wheel_names_version_and_entry_points(wheel: zipfile.ZipFile) -> None:
    info = f"geodelreg-{geodelreg.__version__}.dist-info"
    metadata = email.message_from_bytes(wheel.read(f"{info}/METADATA"))
    assert metadata["Version"] == geodelreg.__version__
    extras = {"test", "dev", "report", "batch", "parquet", "vector"}
    assert extras <= set(metadata.get_all("Provides-Extra"))
    entry_points = configparser.ConfigParser()
    entry_points.read_string(wheel.read(f"{info}/entry_points.txt").decode())
    assert dict(entry_points["console_scripts"]) == {"geodelreg": "geodelreg_cli.main:main"}
    assert list(entry_points["rasterio.rio_plugins"]) == ["geodelreg-align"]


def test_source_archive_can_build_and_test_itself(distributions: Path) -> None:
    (path,) = distributions.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE", "tests/unit/test_packaging.py"} <= names
    assert {
        "hatch_build.py",
        "mkdocs.yml",
        "docs/commands.py",
        "CITATION.cff",
        "Dockerfile",
    } <= names
    assert not any(name.startswith((".ci/", "benchmarks/.cache/", "site/")) for name in names)


def test_public_names_are_all_there() -> None:
    for name in geodelreg.__all__:
        assert getattr(geodelreg, name) is not None
    assert set(geodelreg.__all__) <= set(dir(geodelreg))
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = geodelreg.no_such_name  # type: ignore[attr-defined]
