"""Promises of the layout that no linter knows: half pixels, sizes, words, and complete docs."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from pathlib import Path

import click
import pytest

from geodelreg import errors
from geodelreg.options import AlignOptions, WriteOptions
from geodelreg_cli.main import COMMANDS, cli
from geodelreg_cli.options import flags

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted([*ROOT.glob("geodelreg/**/*.py"), *ROOT.glob("cli/**/*.py")])
HALF = re.compile(r"[-+]\s*(?:0?\.5\b(?!\s*\*)|HALF_PIXEL)|\b0?\.5\s*[-+]")

# Lines that add or subtract one half and are no change of pixel convention, and why.
HALVES_OF_OTHER_THINGS = {
    "geodelreg/product/figures.py: "
    "Rectangle((columns.start - 0.5, rows.start - 0.5), *size, fill=False, ec=_ACCENT, lw=1.5)": (
        "matplotlib draws pixel (0, 0) of an image from -0.5 to 0.5"
    ),
}


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_there_are_sources() -> None:
    assert ROOT / "geodelreg" / "geo" / "pixel.py" in SOURCES


def test_only_geo_pixel_converts_between_pixel_centres_and_corners() -> None:
    found = {
        f"{relative(path)}: {line.strip()}"
        for path in SOURCES
        if relative(path) != "geodelreg/geo/pixel.py"
        for line in path.read_text(encoding="utf-8").splitlines()
        if HALF.search(line.partition("#")[0])
    }
    assert found == set(HALVES_OF_OTHER_THINGS)


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_modules_stay_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) < 400


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_drawing_libraries_are_optional(path: Path) -> None:
    imports = r"^(?:import|from) (?:matplotlib|jinja2)\b"
    assert not re.search(imports, path.read_text(encoding="utf-8"), re.M)


def error_classes() -> list[type[errors.GeodelregError]]:
    return [
        kind
        for _, kind in inspect.getmembers(errors, inspect.isclass)
        if issubclass(kind, errors.GeodelregError) and kind is not errors.GeodelregError
    ]


@pytest.mark.parametrize("kind", error_classes(), ids=lambda kind: kind.__name__)
def test_every_refusal_is_explained_with_its_exit_code(
    kind: type[errors.GeodelregError],
) -> None:
    page = (ROOT / "docs" / "when-it-refuses.md").read_text(encoding="utf-8")
    section = page.partition(f"### `{kind.__name__}`")[2].partition("\n### ")[0]
    assert f"exit {kind.exit_code}" in section
    assert "**Cause.**" in section
    assert "**Remedy.**" in section


def test_no_refusal_is_explained_that_does_not_exist() -> None:
    page = (ROOT / "docs" / "when-it-refuses.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^### `(\w+)`", page, re.M)) == {k.__name__ for k in error_classes()}


def test_every_knob_is_a_flag_of_align() -> None:
    command = cli.get_command(click.Context(cli), "align")
    assert command is not None
    offered = {flag for param in command.params for flag in param.opts}
    knobs = [field.name for kind in (AlignOptions, WriteOptions) for field in fields(kind)]
    for knob in knobs:
        assert set(flags(knob)) <= offered


def test_readme_lists_every_flag_of_align_and_no_other() -> None:
    command = cli.get_command(click.Context(cli), "align")
    assert command is not None
    offered = {
        max(param.opts, key=len) for param in command.params if isinstance(param, click.Option)
    }
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    table = readme.partition("## Options")[2].partition("\n## ")[0]
    rows = [line for line in table.splitlines() if line.startswith("| `")]
    listed = {flag for row in rows for flag in re.findall(r"`[^`]*?(--[a-z-]+)", row.split("|")[1])}
    assert listed == offered


def test_every_command_is_explained_in_the_user_guide() -> None:
    guide = (ROOT / "docs" / "user-guide.md").read_text(encoding="utf-8")
    for name in COMMANDS:
        assert f"`geodelreg {name}" in guide


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda p: p.name
)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    missing = [x for x in links if "://" not in x and not (page.parent / x).exists()]
    assert missing == []
