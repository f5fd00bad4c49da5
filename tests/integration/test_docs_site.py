"""The built site: whole, in step with the code, and content without a network."""

from __future__ import annotations

import json
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

import geodelreg
from docs.report_fields import report_fields
from geodelreg.product.check import check_json
from geodelreg.product.report import plain
from geodelreg.values.points import Status
from geodelreg_cli.main import COMMANDS, cli

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "sample_tiles"


class Page(HTMLParser):
    """What a page says, and what a browser asks for to show it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.text = ""
        self.requests: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        asked = [given.get("src"), given.get("srcset"), given.get("data"), given.get("poster")]
        if tag == "link" and given.get("rel") not in ("canonical", "prev", "next"):
            asked.append(given.get("href"))
        self.requests += [address for address in asked if address]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as ``mkdocs build --strict`` makes it: any broken link or anchor is an error."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_pages_ask_for_nothing_outside(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 30
    for path in pages:
        outside = [x for x in Page(path).requests if x.startswith(("http:", "https:", "//"))]
        assert outside == [], path
    for path in site.rglob("*.css"):
        style = path.read_text(encoding="utf-8")
        assert "@import" not in style
        assert not any(f"url({quote}http" in style for quote in ("", "'", '"'))


def test_every_option_of_every_command_is_in_the_reference(site: Path) -> None:
    text = Page(site / "cli.html").text
    for name in COMMANDS:
        section = text.partition(f"geodelreg {name} [OPTIONS]")[2].partition("[OPTIONS]")[0]
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        options = [param for param in command.params if isinstance(param, click.Option)]
        assert options
        for flag in (flag for option in options for flag in option.opts):
            assert flag in section, name


def test_every_public_name_of_python_is_in_the_reference(site: Path) -> None:
    page = (site / "reference.html").read_text(encoding="utf-8")
    names = set(geodelreg.__all__) - {"__version__", "errors"}
    assert {name for name in names if f".{name}" not in page} == set()


def test_every_field_of_the_report_is_in_the_reference(site: Path) -> None:
    page = Page(site / "report.html").text.split()
    for field in report_fields():
        assert field.path in page
        assert field.meaning, field.path


@pytest.fixture(scope="module")
def checked() -> geodelreg.Check:
    return geodelreg.check(
        SAMPLES / "ms.tif", SAMPLES / "pan.tif", per_band=True, pan_mask=np.eye(800, dtype=np.uint8)
    )


def test_names_in_python_give_what_the_report_says(checked: geodelreg.Check) -> None:
    report = json.loads(check_json(checked)) | {
        "tie_points": checked.alignment.to_dict(tie_points=True)["tie_points"]
    }
    names = {
        "alignment": checked.alignment, "check": checked, "geodelreg": geodelreg, "i": 0,
        "Status": Status, "xy": np.zeros((1, 2)),
    }  # fmt: skip
    compared = set()
    for field in report_fields():
        of_others = field.path == "correction.pixel_map" or field.path.startswith("inputs.points")
        if not field.python or of_others:
            continue
        value, expected = eval(field.python, names), at(report, field.path)
        if field.path == "found.sigma_source_px":
            expected = expected[0][:1]
        if not is_record(expected):
            assert plain(value) == expected, field.path
            compared.add(field.path)
    assert {"accuracy.check_rmse_px", "masks[].path", "check.bands[].shift_px"} <= compared


def is_record(value: Any) -> bool:
    """True of what has fields of its own."""
    return isinstance(value, dict) or (
        isinstance(value, list) and any(isinstance(item, dict) for item in value)
    )


def at(report: dict[str, Any], path: str) -> Any:
    """The value of a field, of lists the first."""
    value: Any = report
    for part in path.split("."):
        value = value[part.removesuffix("[]")]
        value = value[0] if part.endswith("[]") else value
    return value
