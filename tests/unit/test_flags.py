"""Messages speak of arguments in Python and of flags on the command line; no text says both."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from geodelreg.flags import NAMES, arguments, as_typed, flags
from geodelreg_cli.main import COMMANDS, cli

LIBRARY = Path(__file__).resolve().parents[2] / "geodelreg"
MODULES = sorted(set(LIBRARY.rglob("*.py")) - {LIBRARY / "flags.py"})
OF_COMMANDS = re.compile(r"\b(gdal\w*|rio|geodelreg) [^;`]*")
"""A command of a shell that a message tells to run."""


def texts(path: Path) -> Iterator[str]:
    """What a module may say: its strings, docstrings apart; f-strings with `…` for what varies."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    silent = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            silent |= set(node.values)
            yield "".join(v.value if isinstance(v, ast.Constant) else "…" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in silent:
            yield node.value


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(LIBRARY).as_posix())
def test_the_library_speaks_of_arguments(path: Path) -> None:
    for text in texts(path):
        if path.name != "words.py" or not text.startswith("--"):  # words that make up a command
            assert not re.search(r"(?<![\w-])--[a-z]", OF_COMMANDS.sub("", text)), text
        assert set(re.findall(r"`([a-z]\w*)(?:=[^`]*)?`", text)) <= NAMES, text


def test_whatever_is_named_is_a_flag_of_a_command() -> None:
    offered = set()
    for name in COMMANDS:
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        offered |= {flag for param in command.params for flag in param.opts}
    assert {flags(name)[-1] for name in NAMES} <= offered


@pytest.mark.parametrize(
    ("message", "typed"),
    [
        ("Allow more: `max_shift_px=40`.", "Allow more: --max-shift 40."),
        ("try `band`, or `model='scale'`", "try --band, or --model scale"),
        ("`warp=True` and `georef='gcps'`", "--warp and --georef gcps"),
        ("`band=N` matches on one", "--band N matches on one"),
        ("e.g. `creation_options=['A=1', 'B=2']`.", "e.g. --co A=1 --co B=2."),
        ("`ms_nodata=-9999.0` is", "--nodata -9999.0 is"),
        ("with `write_in_place`", "with --in-place"),
        ("`model='a b'` is unknown", "--model 'a b' is unknown"),
        ("the file `ms=2`.tif and band=3/`x`", "the file `ms=2`.tif and band=3/`x`"),
    ],
)
def test_the_command_line_shows_flags(message: str, typed: str) -> None:
    assert as_typed(message) == typed


def test_arguments_of_what_is_on_off_or_many() -> None:
    assert arguments("north_up", True) == ["--north-up"]
    assert arguments("north_up", False) == []
    assert arguments("pan_band", 0) == ["--pan-band", "auto"]
    assert arguments("masks", ("a.tif", "b c.tif=3")) == ["--mask", "a.tif", "--mask", "b c.tif=3"]
