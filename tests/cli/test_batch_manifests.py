"""Manifests that are wrong or hostile: everything is told at once, and nothing is started."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.cli.batch_helpers import read_table, write_lines, write_manifest
from tests.cli.helpers import Command, copy_samples, snapshot

ROW = {"ms": "ms.tif", "pan": "pan.tif", "out": "out/1.tif"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    return copy_samples(tmp_path / "data")


def refused(geodelreg: Command, manifest: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run a manifest that must change nothing anywhere."""
    around = manifest.parent.parent
    before = snapshot(around)
    done = geodelreg("batch", manifest, *options)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert snapshot(around) == before
    assert not list(around.rglob("*.geodelreg"))
    return done


def test_all_mistakes_are_told_at_once(folder: Path, geodelreg: Command) -> None:
    (folder / "there.tif").write_bytes(b"mine")
    rows = [
        ROW,
        {**ROW, "out": "out/2.tif", "model": "round"},
        {**ROW, "out": "out/3.tif", "ratio": "nan"},
        {**ROW, "out": "out/4.tif", "band": "2.5"},
        {**ROW, "out": "out/5.tif", "warp": "perhaps"},
        {**ROW, "pan": "", "out": "out/6.tif"},
        {**ROW, "out": ""},
        {**ROW, "out": "out/../out/1.tif"},
        {**ROW, "out": "out/1.tif/2.tif"},
        {**ROW, "out": "pan.tif"},
        {**ROW, "out": "there.tif"},
        {**ROW, "out": "pairs.csv"},
        {**ROW, "out": "pairs.ledger"},
        {**ROW, "out": "out/7.tif", "masks": "a.tif=9-3"},
    ]
    columns = dict.fromkeys(("ms", "pan", "out", "model", "ratio", "band", "warp", "masks"), "")
    manifest = write_manifest(folder / "pairs.csv", [columns | row for row in rows])
    with manifest.open("ab") as file:
        file.write(b"ms.tif,pan.tif\nms.tif,\xff.tif,out/8.tif,,,,,\n")
    done = refused(geodelreg, manifest)
    for line, words in {
        3: "--model round", 4: "--ratio nan", 5: "--band 2.5", 6: "--warp perhaps",
        7: "no value for pan", 8: "no value for out", 9: "output of line 2 already",
        10: "lies below", 11: "pan.tif exists", 12: "there.tif exists", 13: "pairs.csv exists",
        14: "a file of the batch itself", 15: "9-3", 16: "2 cells for 8 columns", 17: "not UTF-8",
    }.items():  # fmt: skip
        told = [text for text in done.stderr.splitlines() if text.startswith(f"line {line}: ")]
        assert any(words in text for text in told), (line, words, done.stderr)
    assert not any(text.startswith("line 2: ") for text in done.stderr.splitlines())


@pytest.mark.parametrize("out", ["../1.tif", "/tmp/1.tif", "out/../../1.tif", "link/1.tif"])
@pytest.mark.parametrize("overwrite", [(), ("--overwrite",)])
def test_no_output_leaves_the_root(
    folder: Path, geodelreg: Command, out: str, overwrite: tuple[str, ...]
) -> None:
    (folder.parent / "outside").mkdir()
    (folder / "link").symlink_to(folder.parent / "outside")
    manifest = write_manifest(folder / "pairs.csv", [{**ROW, "out": out}])
    assert "lies outside of" in refused(geodelreg, manifest, *overwrite).stderr


def test_a_link_to_a_file_outside_is_outside(folder: Path, geodelreg: Command) -> None:
    victim = folder.parent / "victim.tif"
    victim.write_bytes(b"precious")
    (folder / "link.tif").symlink_to(victim)
    manifest = write_manifest(folder / "pairs.csv", [{**ROW, "out": "link.tif"}])
    assert "lies outside of" in refused(geodelreg, manifest, "--overwrite").stderr


def test_an_input_of_another_pair_is_no_output_with_overwrite_either(
    folder: Path, geodelreg: Command
) -> None:
    rows = [ROW, {**ROW, "out": "pan.tif"}, {**ROW, "out": "./ms.tif"}]
    manifest = write_manifest(folder / "pairs.csv", rows)
    told = refused(geodelreg, manifest, "--overwrite").stderr
    assert "line 3: " in told
    assert told.count("is written, and is an input of the batch") >= 2


@pytest.mark.parametrize(
    "column",
    ["allow", "config", "overwrite", "in_place", "in-place", "threads", "gcps", "report", "figure"],
)
def test_a_manifest_cannot_say_what_is_the_users_to_say(
    folder: Path, geodelreg: Command, column: str
) -> None:
    for manifest in (
        write_manifest(folder / "pairs.csv", [{**ROW, column: ""}]),
        write_lines(folder / "pairs.jsonl", [{**ROW, column: "all"}]),
    ):
        assert f"column '{column}'" in refused(geodelreg, manifest).stderr


@pytest.mark.parametrize(
    "name",
    ["https://127.0.0.1:9/ms.tif", "/vsicurl/http://127.0.0.1:9/ms.tif", "WMS:http://127.0.0.1:9/"],
)
def test_a_name_in_a_manifest_opens_no_network(folder: Path, geodelreg: Command, name: str) -> None:
    manifest = write_lines(folder / "pairs.jsonl", [{**ROW, "ms": name}, {**ROW, "out": "2.tif"}])
    assert geodelreg("batch", manifest, "-q").returncode == 1
    first, second = read_table(folder / "pairs.results.csv")
    assert first["error"] == "AccessNotAllowedError"
    assert second["outcome"] == "aligned"


def test_a_million_columns_are_refused_in_one_line(folder: Path, geodelreg: Command) -> None:
    named = folder / "named.csv"
    named.write_text("ms,pan,out," + ",".join(f"c{n}" for n in range(1_000_000)) + "\n")
    told = refused(geodelreg, named).stderr
    assert "line 1: longer than 1 MiB" in told
    assert len(told) < 1000
    nameless = folder / "nameless.csv"
    nameless.write_text("ms,pan,out" + "," * 999_997 + "\n" + "," * 999_999 + "\n")
    told = refused(geodelreg, nameless).stderr
    assert "1000000 columns" in told
    assert len(told) < 1000
    keys = write_lines(folder / "keys.jsonl", [ROW | {f"{n:x}": 0 for n in range(100_000)}])
    told = refused(geodelreg, keys).stderr
    assert "99995 more" in told or "longer than 1 MiB" in told
    assert len(told) < 1500


@pytest.mark.parametrize(
    "line",
    [
        '{"ms": "ms.tif", "pan": "pan.tif", "out": "a\\u0000b.tif"}',
        '{"ms": "ms\\u0000.tif", "pan": "pan.tif", "out": "a.tif"}',
        '{"ms": "\\ud800.tif", "pan": "pan.tif", "out": "a.tif"}',
        '{"ms": ["ms.tif", 7], "pan": "pan.tif", "out": "a.tif"}',
        '{"ms": {}, "pan": [], "out": 3}',
        '{"ms": "ms.tif", "pan": ["pan.tif"], "out": "a.tif"}',
        '{"ms": "ms.tif", "ms": "pan.tif", "pan": "pan.tif", "out": "a.tif"}',
        '{"ms": "ms.tif", "pan": "pan.tif", "out": "a.tif", "band": 1e999}',
        '{"ms": "ms.tif", "pan": "pan.tif", "out": "a.tif", "threads": ' + "9" * 5000 + "}",
        '{"ms": "ms.tif", "pan": "pan.tif", "out": "a.tif", "ratio": NaN}',
        '{"ms": "ms.tif", "pan": "pan.tif", "out": "a.tif", "warp": "yes", "georef": "gcps"}',
        '{"ms": "ms.tif", "pan": "pan.tif", "out": "a.tif", "creation_options": "X"}',
        '{"ms": "ms.tif", "pan": "pan.tif", "out": "/vsimem/a.tif"}',
        '{"ms": ["a/x.tif", "b/x.tif"], "pan": "pan.tif", "out": "a"}',
        "[" * 100_000,
        '"ms.tif"',
        "null",
        "{",
    ],
)
def test_a_line_of_nonsense_is_named(folder: Path, geodelreg: Command, line: str) -> None:
    manifest = folder / "pairs.jsonl"
    manifest.write_text(json.dumps(ROW) + "\n\n" + line + "\n")
    told = refused(geodelreg, manifest).stderr
    assert "line 3: " in told
    assert "line 1: " not in told
    assert len(told) < 1500


def test_nul_bytes_and_open_quotes_in_csv(folder: Path, geodelreg: Command) -> None:
    manifest = folder / "pairs.csv"
    manifest.write_bytes(b"ms,pan,out\nms.tif,pan.tif,o\0.tif\n")
    assert "line 2: out holds a NUL" in refused(geodelreg, manifest).stderr
    manifest.write_bytes(b'ms,pan,out\nms.tif,pan.tif,"1.tif\nms.tif,pan.tif,2.tif\n')
    assert "no CSV" in refused(geodelreg, manifest).stderr
    manifest.write_bytes(b"ms,ms,pan,out\na,b,c,d\n")
    assert "the column 'ms' is there twice" in refused(geodelreg, manifest).stderr
    manifest.write_bytes(b"ms;pan;out\nms.tif;pan.tif;1.tif\n")
    assert "no value for ms" in refused(geodelreg, manifest).stderr
    for content in (b"", b"\n\n", b"ms,pan,out\n"):
        manifest.write_bytes(content)
        assert geodelreg("batch", manifest).returncode == 2
    manifest.write_bytes(bytes(range(256)) * 4000)
    refused(geodelreg, manifest)


def test_texts_of_a_manifest_do_not_control_the_terminal(folder: Path, geodelreg: Command) -> None:
    manifest = write_lines(folder / "pairs.jsonl", [{**ROW, "\x1b[2Jmodel": 1}])
    assert "\x1b" not in refused(geodelreg, manifest).stderr
    write_lines(manifest, [{**ROW, "ms": "\x1b[2J.tif"}])
    done = geodelreg("batch", manifest, "-v")
    assert done.returncode == 1
    assert "[2J.tif" in done.stderr
    assert "\x1b" not in done.stderr


def test_formulas_are_no_formulas_in_the_table(folder: Path, geodelreg: Command) -> None:
    names = [f"{formula}://x" for formula in ("=1+1", "+1", "-1", "@SUM(A1)", "\t=1", '=A("b")')]
    rows = [{"ms": [name], "pan": "pan.tif", "out": f"{n}.tif"} for n, name in enumerate(names)]
    manifest = write_lines(folder / "pairs.jsonl", rows)
    assert geodelreg("batch", manifest, "-q").returncode == 1
    table = read_table(folder / "pairs.results.csv")
    assert [row["sources"] for row in table] == [f"'{name}" for name in names]
    assert [row["reason"][:2] for row in table[:4]] == ["'=", "'+", "'-", "'@"]
    assert {row["outcome"] for row in table} == {"failed"}
