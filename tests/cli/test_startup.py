"""``--help`` and ``--version`` answer at once: they load no array, raster or terminal library."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {
    "affine", "cv2", "dask", "distributed", "jinja2", "matplotlib", "numpy", "pyproj", "rasterio",
    "rich", "scipy", "shapely",
}  # fmt: skip


def modules_after(statement: str) -> set[str]:
    """Top-level names of the modules that a fresh interpreter holds after a statement."""
    code = f"import sys\n{statement}\nprint('MODULES', *sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    names = done.stdout.rpartition("MODULES ")[2].split()
    return {name.split(".")[0] for name in names}


@pytest.mark.parametrize(
    "args",
    [
        ["--version"],
        ["--help"],
        ["align", "--help"],
        ["batch", "--help"],
        ["check", "--help"],
        ["completion", "bash"],
        ["gcps", "--help"],
        ["revert", "-h"],
    ],
)
def test_help_and_version_load_nothing_heavy(args: list[str]) -> None:
    modules = modules_after(f"from geodelreg_cli.main import run; assert run({args!r}) == 0")
    assert "click" in modules
    assert not modules & HEAVY


@pytest.mark.parametrize("args", [["--version"], ["--help"]])
def test_what_names_no_option_looks_at_none(args: list[str]) -> None:
    code = f"import sys\nfrom geodelreg_cli.main import run\nrun({args!r})\n"
    code += "print('MODULES', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "geodelreg.options" not in done.stdout.rpartition("MODULES ")[2].split()


def test_importing_the_library_or_the_rio_plugin_loads_nothing_heavy() -> None:
    assert not modules_after("import geodelreg, geodelreg.errors, geodelreg.options") & HEAVY
    assert not modules_after("import geodelreg_cli.rio") & HEAVY


def test_a_driver_of_many_pairs_and_its_workers_load_nothing_heavy() -> None:
    statement = "from geodelreg.batch import run; import geodelreg.batch.child"
    assert not modules_after(statement) & HEAVY
