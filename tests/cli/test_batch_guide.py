"""The commands of docs/batch.md that a local cluster can serve, run as they stand there."""

from __future__ import annotations

import os
import re
import shlex
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.batch.pairs import write_pairs
from geodelreg.batch.cells import FILES, NEVER, SIDE_FILES
from tests.cli.batch_helpers import outcomes

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "batch.md"
PYTHON = shlex.quote(sys.executable)
PRELUDE = f"""set -e
geodelreg() {{ {PYTHON} -m geodelreg_cli "$@"; }}
dask() {{ exec {PYTHON} -m dask "$@"; }}
"""


def section(title: str) -> str:
    return GUIDE.read_text(encoding="utf-8").partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def blocks(title: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", section(title), re.M | re.S)


def run_shell(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-m", "-c", PRELUDE + script], cwd=folder, capture_output=True, text=True,
        timeout=300, env=os.environ | {"COLUMNS": "100"},
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_pairs(tmp_path, 2)
    return tmp_path


def test_the_commands_for_one_machine_run(folder: Path) -> None:
    (script,) = blocks("One machine", "sh")
    done = run_shell(script, folder)
    assert done.returncode == 0, done.stderr
    assert outcomes(folder / "pairs.results.csv") == ["aligned", "aligned"]
    assert outcomes(folder / "check.results.csv") == ["misaligned", "misaligned"]
    assert (folder / "pairs.geojson").exists()


def test_the_commands_for_a_cluster_run(folder: Path) -> None:
    (script,) = blocks("A cluster of Dask", "sh")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    done = run_shell(script.replace("8786", str(port)), folder)
    assert done.returncode == 0, done.stderr
    assert outcomes(folder / "cluster.results.csv") == ["aligned", "aligned"]
    assert len(list((folder / "out").glob("*.tif"))) == 2


def test_the_example_in_python_runs(folder: Path) -> None:
    (script,) = blocks("From Python", "python")
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    lines = sorted(done.stdout.splitlines())
    assert [line.split()[:2] for line in lines] == [["1", "aligned"], ["2", "aligned"]]


def test_the_columns_that_are_needed_or_forbidden_are_named() -> None:
    text = section("The pairs")
    for name in (*FILES, *NEVER):
        assert f"`{name}`" in text
    assert not set(NEVER) & set(SIDE_FILES)
