"""Runs the examples of a page of the documentation as they stand there.

Blocks that are marked ``sh`` or ``python`` are examples. What needs more than a test has (a
network, a cluster, other programs) is marked ``bash`` or ``py``.  A block ``text`` right after one
for the shell is what that prints; numbers may differ.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.cli import forked
from tests.cli.helpers import ROOT, command_server

PYTHON = shlex.quote(sys.executable)
PRELUDE = f"""set -e
geodelreg() {{ {PYTHON} -S {shlex.quote(forked.__file__)} "$GEODELREG_SERVER" "$@"; }}
rio() {{ {PYTHON} -c 'from rasterio.rio.main import main_group; main_group()' "$@"; }}
dask() {{ exec {PYTHON} -m dask "$@"; }}
"""


def pages() -> list[str]:
    """README and all pages, by their names in the repository."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [page.relative_to(ROOT).as_posix() for page in found]


def examples(page: str, languages: str = "sh|python") -> list[tuple[str, str, str]]:
    """Language and text of each example, and what the page says that it prints, in order."""
    text = (ROOT / page).read_text(encoding="utf-8")
    block = rf"^```({languages})\n(.*?)^```\n(?:\n```text\n(.*?)^```)?"
    return re.findall(block, text, re.M | re.S)


def run_examples(page: str, folder: Path, port: int, languages: str = "sh|python") -> None:
    """Run all examples of a page, one after the other.

    Those in Python share one namespace, as in a session.

    Parameters
    ----------
    page : str
        Name in the repository.
    folder : Path
        Where they run, with the files that they name.
    port : int
        Of a cluster, in place of Dask's usual one.
    languages : str
        Those of the blocks, ``|`` between them.

    Raises
    ------
    Exception
        When one fails.
    """
    session: dict[str, Any] = {"__name__": "__main__"}
    for language, text, told in examples(page, languages):
        block = text.replace("8786", str(port))
        if language == "python":
            with contextlib.chdir(folder):
                exec(compile(block, page, "exec"), session)
            continue
        done = subprocess.run(
            ["bash", "-m", "-c", PRELUDE + block], cwd=folder, capture_output=True, text=True,
            timeout=300,
            env=os.environ | {"COLUMNS": "100", "GEODELREG_SERVER": command_server()},
        )  # fmt: skip
        printed = done.stdout + done.stderr
        assert done.returncode == 0, f"{block}\n{printed}"
        lines = [_without_numbers(line) for line in printed.splitlines()]
        missing = [x for x in told.splitlines() if _without_numbers(x) not in lines]
        assert missing == [], printed


def _without_numbers(line: str) -> str:
    return re.sub(r"[0-9.]+", "0", line)
