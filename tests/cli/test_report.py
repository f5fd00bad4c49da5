"""Pages to look at, and figures, as users ask for them: ``--report``, ``report``, ``figure``."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest
import rasterio

from geodelreg.product.report import report_schema
from tests.cli.helpers import (
    Command,
    copy_corner,
    run_fresh_command,
    snapshot,
    write_noise,
)
from tests.cli.pages import Page

KINDS = ("before-after", "arrows", "mesh", "error", "matches")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, geodelreg: Command) -> Path:
    """A pair with its page and its JSON, and a refused one's; never written to."""
    folder = copy_corner(tmp_path_factory.mktemp("made"))
    write_noise(folder / "noise.tif", like=folder / "pan.tif", seed=1)
    for pan, name, code in (("pan.tif", "good", 0), ("noise.tif", "bad", 3)):
        reports = ("--report", f"{name}.html", "--report", f"{name}.json")
        done = geodelreg("align", "ms.tif", pan, "--dry-run", *reports, cwd=folder)
        assert done.returncode == code, done.stderr
    return folder


# --- what a page holds ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["good.html", "bad.html"])
def test_a_page_is_one_file_that_fetches_nothing_and_runs_its_own_script_alone(
    made: Path, name: str
) -> None:
    page = Page(made / name)
    assert (made / name).stat().st_size < 8_000_000
    assert all(address.startswith(("data:image/", "#")) for address in page.addresses())
    (policy,) = (
        m["content"] for m in page.all("meta", **{"http-equiv": "Content-Security-Policy"})
    )
    for tag, directive in (("script", "script-src"), ("style", "style-src")):
        digest = hashlib.sha256("".join(page.texts[tag]).encode()).digest()
        assert f"{directive} 'sha256-{base64.b64encode(digest).decode()}'" in policy
        assert len(page.all(tag)) == 1
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy
    handlers = [a for _, attributes in page.elements for a in attributes if a.startswith("on")]
    assert not handlers


def test_the_page_says_what_the_report_says(made: Path) -> None:
    page, report = Page(made / "good.html"), json.loads((made / "good.json").read_text())
    accuracy = report["accuracy"]
    assert "Aligned" in page.texts["title"][0]
    assert f"{accuracy['check_rmse_px']:.4f} px" in page.text
    assert f"{accuracy['kept']} kept" in page.text
    for step in report["step_counts"]:
        assert step["step"] in page.text
    for reason in report["verdict"]["reasons"]:
        assert reason["message"] in page.text
    for version in report["versions"].values():
        assert version in page.text
    assert "geodelreg align ms.tif pan.tif --dry-run --report again.html" in page.text


def test_the_arrow_of_the_key_is_as_long_as_one_of_the_picture(made: Path) -> None:
    """Both as shares of the figure's width, which is the picture's and the key's."""
    page, report = Page(made / "good.html"), json.loads((made / "good.json").read_text())
    line = re.compile(r"M([-\d.]+) ([-\d.]+)L([-\d.]+) ([-\d.]+)")

    def shafts(path: str) -> list[float]:
        ends = (map(float, found) for found in line.findall(path))
        return [math.hypot(x1 - x0, y1 - y0) for x0, y0, x1, y1 in ends]

    (key,) = page.all("svg", **{"class": "measure"})
    paths = [a for tag, a in page.elements if tag == "path" and "line kept" in a.get("class", "")]
    width = float(page.all("svg", **{"class": "picture"})[0]["viewbox"].split()[2])
    key_width = float(key["viewbox"].split()[2])
    shown = float(key["width"].removesuffix("%")) / 100 * max(shafts(paths[1]["d"])) / key_width
    (told,) = re.findall(r"([\d.]+) PAN px (?:\d+ kept)", page.text)
    residuals = [p["residual_px"] for p in report["tie_points"]["points"] if p["status"] == "kept"]
    lengths = [math.hypot(*residual) for residual in residuals]
    drawn = max(shafts(paths[0]["d"])) / width
    assert shown / float(told) == pytest.approx(drawn / max(lengths), rel=0.02)


def test_a_refusal_has_its_page_with_the_reasons_and_the_candidate(made: Path) -> None:
    page, report = Page(made / "bad.html"), json.loads((made / "bad.json").read_text())
    jsonschema.validate(report, report_schema())
    assert "Refused" in page.texts["title"][0]
    assert "Nothing was written." in page.text
    failed = [r["message"] for r in report["verdict"]["reasons"] if not r["passed"]]
    assert failed
    for message in failed:
        assert page.text.count(message) == 2  # above, and beside its bar
    assert page.all("img", **{"data-view": "after"})
    assert "How sure it is" not in page.text  # of nothing found, nothing is known
    assert "squares 1, 2 and 3" not in page.text


def test_the_command_on_the_page_finds_the_same_again(
    geodelreg: Command, made: Path, tmp_path: Path
) -> None:
    for name in ("ms.tif", "pan.tif"):
        shutil.copy(made / name, tmp_path)
    asked = ("--model", "shift", "--max-shift", "50", "-b", "3", "--report", "again.html")
    done = geodelreg("align", "ms.tif", "pan.tif", "--dry-run", *asked, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    first = (tmp_path / "again.html").read_bytes()
    (tmp_path / "again.html").unlink()
    (tmp_path / "first.html").write_bytes(first)
    (told,) = Page(tmp_path / "first.html").texts["pre"]
    words = told.split()
    assert words[0] == "geodelreg"
    run_fresh_command(*words[1:], cwd=tmp_path)
    assert (tmp_path / "again.html").read_bytes() == first


# --- names from strangers ------------------------------------------------------------------------


def test_names_of_files_and_bands_are_shown_and_never_run(
    geodelreg: Command, tmp_path: Path
) -> None:
    copy_corner(tmp_path)
    ms = "a\"><img src=x onerror=alert(1)>'&amp;.tif"
    shutil.copy(tmp_path / "ms.tif", tmp_path / ms)
    band = "</title><script>alert(2)</script>\u202eevil\u2066"
    with rasterio.open(tmp_path / ms, "r+") as dataset:
        dataset.descriptions = (band, 'b"2', "b'3", "<b>4")
    done = geodelreg(
        *("align", ms, "pan.tif", "--dry-run", "--report", "page.html", "--figure", "figure.svg"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    page = Page(tmp_path / "page.html")
    assert len(page.all("script")) == 1
    assert not [1 for _, attributes in page.elements for a in attributes if a.startswith("on")]
    assert page.texts["h1"][0] == ms
    names = page.texts["bdi"]
    assert "</title><script>alert(2)</script>\\u202eevil\\u2066" in names
    assert {'b"2', "b'3", "<b>4"} <= set(names)
    assert not set("\u202e\u2066") & set(page.source)
    assert "<script" not in (tmp_path / "figure.svg").read_text(encoding="utf-8")


# --- the same later, and of other rasters --------------------------------------------------------


@pytest.mark.parametrize("name", ["good", "bad"])
def test_a_page_made_later_is_the_same(made: Path, tmp_path: Path, name: str) -> None:
    for path in made.iterdir():
        shutil.copy(path, tmp_path)
    pan = "pan.tif" if name == "good" else "noise.tif"
    run_fresh_command("report", f"{name}.json", "ms.tif", pan, "-o", "later.html", cwd=tmp_path)
    assert (tmp_path / "later.html").read_bytes() == (made / f"{name}.html").read_bytes()


def test_a_result_of_other_rasters_is_refused(
    geodelreg: Command, made: Path, tmp_path: Path
) -> None:
    for path in made.iterdir():
        shutil.copy(path, tmp_path)
    shutil.copy(tmp_path / "ms.tif", tmp_path / "changed.tif")
    with rasterio.open(tmp_path / "changed.tif", "r+") as dataset:
        values = dataset.read(1)
        values[5, 5] += 1
        dataset.write(values, 1)
    before = snapshot(tmp_path)
    for rasters, named in (
        (("ms.tif", "noise.tif"), "noise.tif"),
        (("changed.tif", "pan.tif"), "changed.tif"),
        (("ms.tif", "changed.tif", "pan.tif"), "2 are named"),
    ):
        for command in ("report", "figure"):
            output = "out.html" if command == "report" else "out.png"
            done = geodelreg(command, "good.json", *rasters, "-o", output, cwd=tmp_path)
            assert done.returncode == 1
            assert named in done.stderr
            assert "good.json" in done.stderr
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    "spoil",
    [
        lambda report: report | {"schema_version": "3.0"},
        lambda report: report | {"found": {"model": "shift"}},
        lambda report: report | {"options": report["options"] | {"method": "magic"}},
        lambda report: [report],
        lambda report: report | {"accuracy": 3},
    ],
)
def test_a_spoilt_report_is_refused_in_words(
    geodelreg: Command, made: Path, tmp_path: Path, spoil: object
) -> None:
    for path in made.iterdir():
        shutil.copy(path, tmp_path)
    report = json.loads((made / "good.json").read_text())
    assert callable(spoil)
    (tmp_path / "spoilt.json").write_text(json.dumps(spoil(report)))
    rasters = ("ms.tif", "pan.tif")
    done = geodelreg("report", "spoilt.json", *rasters, "-o", "page.html", cwd=tmp_path)
    assert done.returncode == 1
    assert "geodelreg: error: spoilt.json" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "page.html").exists()


# --- figures -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_figure_is_drawn_the_same_twice(
    geodelreg: Command, made: Path, tmp_path: Path, kind: str
) -> None:
    args = ("figure", "good.json", "ms.tif", "pan.tif", "--kind", kind, "-o")
    for name in ("one.png", "two.png", "one.svg"):
        done = geodelreg(*args, tmp_path / name, cwd=made)
        assert done.returncode == 0, done.stderr
    run_fresh_command(*args, tmp_path / "two.svg", cwd=made)
    drawn = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert drawn["one.png"] == drawn["two.png"]
    assert drawn["one.svg"] == drawn["two.svg"]
    assert drawn["one.png"].startswith(b"\x89PNG")
    assert b"<svg" in drawn["one.svg"]


def test_a_refusal_has_its_figure(geodelreg: Command, made: Path, tmp_path: Path) -> None:
    for path in made.glob("*.tif"):
        shutil.copy(path, tmp_path)
    done = geodelreg(
        *("align", "ms.tif", "noise.tif", "-o", "out.tif"),
        *("--figure", "refused.png", "--figure-kind", "before-after"),
        cwd=tmp_path,
    )
    assert done.returncode == 3
    assert (tmp_path / "refused.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "out.tif").exists()


# --- what is missing is said before the work -----------------------------------------------------


@pytest.mark.parametrize(
    ("module", "asked"), [("jinja2", ("--report", "x.html")), ("matplotlib", ("--figure", "x.png"))]
)
def test_a_missing_extra_is_told_before_the_rasters_are_opened(
    tmp_path: Path, module: str, asked: tuple[str, str]
) -> None:
    code = (
        f"import sys; sys.modules[{module!r}] = None\n"
        "from geodelreg_cli.main import run\n"
        "sys.exit(run(sys.argv[1:]))"
    )
    # rasters that do not exist would be the next thing to be told
    done = subprocess.run(
        [sys.executable, "-c", code, "align", "ms.tif", "pan.tif", "-o", "out.tif", *asked],
        cwd=tmp_path, capture_output=True, text=True, env=os.environ,
    )  # fmt: skip
    assert done.returncode == 1
    assert "pip install '.[report]'" in done.stderr
    assert "does not exist" not in done.stderr
