"""The documentation names everything there is, and nothing else."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from pathlib import Path

import click
import pytest
import yaml

import geodelreg
from geodelreg import errors
from geodelreg.flags import flags
from geodelreg.judge.verdict import Evidence, judge
from geodelreg.options import AlignOptions, WriteOptions
from geodelreg_cli.main import COMMANDS, cli

ROOT = Path(__file__).resolve().parents[2]


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


def test_every_command_is_explained_in_a_how_to() -> None:
    folders = [ROOT / "docs" / folder for folder in ("how-to", "tutorials")]
    pages = [page for folder in folders for page in folder.glob("*.md")]
    guide = "".join(page.read_text(encoding="utf-8") for page in pages)
    guide += (ROOT / "docs" / "batch.md").read_text(encoding="utf-8")
    for name in COMMANDS:
        assert f"`geodelreg {name}" in guide


@pytest.mark.parametrize("page", sorted(ROOT.glob("*.md")), ids=lambda p: p.name)
def test_links_outside_of_the_site_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    missing = [x for x in links if "://" not in x and not (page.parent / x).exists()]
    assert missing == []


def test_citation_names_this_version_and_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["version"], citation["license"]) == (geodelreg.__version__, "MIT")
    (paper,) = citation["references"]
    names = [f"{author['given-names']} {author['family-names']}" for author in paper["authors"]]
    page = " ".join((ROOT / "docs" / "method.md").read_text(encoding="utf-8").split())
    assert f"{', '.join(names)}, *{paper['title']}*, {paper['journal']}" in page
    numbers = "{volume}({issue}), {year}, {start}–{end}".format_map(paper)
    assert numbers in page


@pytest.mark.parametrize(
    "template",
    sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml")),
    ids=lambda p: p.name,
)
def test_issues_ask_for_the_report(template: Path) -> None:
    form = yaml.safe_load(template.read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= form.keys()
    assert "report" in [part.get("id") for part in form["body"]]


def test_every_reason_of_the_gate_has_an_entry_that_begins_with_its_message() -> None:
    unknown = dict.fromkeys((field.name for field in fields(Evidence)), float("nan"))
    options = AlignOptions(max_shift_px=50, max_rotation_deg=1, max_scale=2, max_uncertainty_px=0.2)
    messages = {reason.name: reason.message for reason in judge(Evidence(**unknown), options)}
    page = (ROOT / "docs" / "refusals.md").read_text(encoding="utf-8")
    entries = re.findall(r"^### ([^\n]*)\n\n> ([^\n]*)\n(.*?)(?=^#)", page, re.M | re.S)
    explained = {name: said for heading, said, _ in entries for name in re.findall(r"\w+", heading)}
    assert set(explained) == {*messages, "field_points", "field_clouds"}
    for name, message in messages.items():
        if name not in ("max_rotation", "max_scale"):  # share an entry with max_shift
            words = explained[name].partition(" ")[2].split("…")
            assert all(part in message for part in words), message
    assert all("**What helps.**" in text for _, _, text in entries)


def test_the_gates_limits_are_those_in_the_method_page() -> None:
    unknown = dict.fromkeys((field.name for field in fields(Evidence)), float("nan"))
    reasons = judge(Evidence(**unknown), AlignOptions())
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    table = page.partition("## The gate")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| .* \| [≥≤] (.*) \|$", table, re.M)
    documented = {name: float(limit.replace("−", "-")) for name, limit in rows}
    assert documented == {reason.name: reason.limit for reason in reasons}
