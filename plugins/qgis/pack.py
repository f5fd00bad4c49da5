"""Packs the QGIS plugin: ``python plugins/qgis/pack.py [FOLDER]`` writes a zip.

Into it go the plugin's files, geodelreg as a wheel (it is on no index yet), the licence, and
``commands.json``, the options of the commands as the command line itself describes them.  Needs
geodelreg with its ``dev`` extra.  The same sources give the same bytes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import click

from geodelreg import __version__
from geodelreg_cli.main import COMMANDS, cli

PLUGIN = Path(__file__).resolve().parent / "geodelreg_qgis"
ROOT = PLUGIN.parents[2]
EPOCH = (1980, 1, 1, 0, 0, 0)
"""The earliest time that a zip can hold."""

# Options that the plugin's own parameters stand for, or that it sets itself.
SET_BY_THE_PLUGIN = frozenset(
    {"masks", "pan_masks", "dry_run", "in_place", "overwrite", "gcp_format", "json"}
) | {"quiet", "verbose", "debug", "config", "figure_kind", "pair", "help", "dask"}


def describe(name: str) -> dict[str, Any]:
    """What the plugin needs to know of one command.

    Options that name files are left out: they are layers and files in QGIS, each with a parameter
    of its own.
    """
    context = click.Context(cli)
    command = cli.get_command(context, name)
    assert command is not None
    options = [
        param
        for param in command.params
        if isinstance(param, click.Option)
        and param.name not in SET_BY_THE_PLUGIN
        and not isinstance(param.type, click.Path)
    ]
    return {
        "summary": COMMANDS[name][1],
        "options": [_option(option, context) for option in options],
    }


def _option(option: click.Option, context: click.Context) -> dict[str, Any]:
    kind, default = _kind(option), option.get_default(context)
    plain = isinstance(default, str | int | float)  # click has several words for none
    return {
        "name": option.name,
        "flag": max(option.opts, key=len),
        "kind": kind,
        "default": option.type_cast_value(context, default) if plain else None,
        "unit": option.metavar if kind == "number" and option.metavar else "",
        "choices": option.type.choices if isinstance(option.type, click.Choice) else (),
        "help": option.help or "",
    }


def _kind(option: click.Option) -> str:
    several = "s" if option.multiple else ""
    if option.is_flag:
        return "flag"
    if isinstance(option.type, click.Choice):
        return f"choice{several}"
    if option.type is click.INT or option.type.name.startswith("N|"):
        return "integer"
    if isinstance(option.type, click.types.FloatParamType):
        return "number"
    return f"text{several}"


def commands_json() -> str:
    """Text of ``commands.json``."""
    commands = {name: describe(name) for name in COMMANDS}
    return json.dumps({"version": __version__, "commands": commands}, indent=1)


def build_wheel(folder: Path) -> Path:
    """Build geodelreg's wheel into a folder."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(folder)]
    environment = os.environ | {"SOURCE_DATE_EPOCH": "315532800"}
    subprocess.run(
        [*command, str(ROOT)], check=True, stdout=subprocess.DEVNULL, env=environment, cwd=folder
    )
    (wheel,) = folder.glob("*.whl")
    return wheel


def build(folder: Path) -> Path:
    """Write the plugin's zip into a folder, and return its path."""
    target = folder / f"{PLUGIN.name}-{__version__}.zip"
    own = sorted(
        path for path in PLUGIN.rglob("*") if path.is_file() and "__pycache__" not in path.parts
    )
    with tempfile.TemporaryDirectory() as scratch:
        wheel = build_wheel(Path(scratch))
        content = {path.relative_to(PLUGIN).as_posix(): path.read_bytes() for path in own}
        content["metadata.txt"] = content["metadata.txt"].replace(
            b"@VERSION@", __version__.encode()
        )
        content["commands.json"] = commands_json().encode()
        content["LICENSE"] = (ROOT / "LICENSE").read_bytes()
        content[f"wheels/{wheel.name}"] = wheel.read_bytes()
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in sorted(content.items()):
            entry = zipfile.ZipInfo(f"{PLUGIN.name}/{name}", EPOCH)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, data)
    return target


if __name__ == "__main__":
    print(build(Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "dist")))
