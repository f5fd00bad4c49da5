"""Manifests as rows of cells: CSV and JSON lines, read line by line, whatever is in them."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from geodelreg.errors import ManifestError

LINE_BYTES = 1 << 20
"""Longest line; that of a sane manifest has some hundred characters."""

MAX_COLUMNS = 1000

JSON_SUFFIXES = (".jsonl", ".ndjson", ".json")


@dataclass(frozen=True, slots=True)
class Row:
    """One pair as it is written down.

    Attributes
    ----------
    place : str
        For messages: its line.
    cells : dict
        Text (CSV) or JSON values by column.
    problem : str
        Why it cannot be read; empty when it can.
    """

    place: str
    cells: dict[str, Any]
    problem: str = ""


def rows_of_file(path: Path) -> Iterator[Row]:
    """Rows of a manifest, in order; blank lines are left out.

    Parameters
    ----------
    path : Path
        CSV with a header line, or JSON lines (``.jsonl``, ``.ndjson``).

    Raises
    ------
    ManifestError
        The file cannot be opened, or has no header.
    """
    try:
        with path.open("rb") as file:
            if path.suffix.lower() in JSON_SUFFIXES:
                yield from _json_rows(file)
            else:
                yield from _csv_rows(file, path)
    except OSError as error:
        raise ManifestError(
            f"{path} cannot be read ({error.strerror})", "Check the name of the manifest."
        ) from error


def _lines(file: BinaryIO) -> Iterator[tuple[int, str | None, str]]:
    """Number, text and problem of each line."""
    number = 0
    while line := file.readline(LINE_BYTES + 1):
        number += 1
        if len(line) > LINE_BYTES:
            while line and not line.endswith(b"\n"):
                line = file.readline(LINE_BYTES)
            yield number, None, f"longer than {LINE_BYTES >> 20} MiB"
            continue
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError:
            yield number, None, "not UTF-8"
            continue
        yield number, text, ""


def _json_rows(file: BinaryIO) -> Iterator[Row]:
    for number, text, problem in _lines(file):
        place = f"line {number}"
        if text is None:
            yield Row(place, {}, problem)
        elif text.strip():
            try:
                cells = json.loads(text, object_pairs_hook=_once)
            except (ValueError, RecursionError) as error:
                yield Row(place, {}, f"no JSON ({error})")
                continue
            if isinstance(cells, dict):
                yield Row(place, cells)
            else:
                yield Row(place, {}, "no JSON object")


def _once(items: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON whose names differ."""
    cells = dict(items)
    if len(cells) < len(items):
        raise ValueError("a name is there twice")
    return cells


def _csv_rows(file: BinaryIO, path: Path) -> Iterator[Row]:
    bad: list[Row] = []
    line = 0

    def texts() -> Iterator[str]:
        nonlocal line
        for line, text, problem in _lines(file):
            if text is None:
                bad.append(Row(f"line {line}", {}, problem))
            else:
                yield text

    reader = csv.reader(texts(), strict=True)
    columns: list[str] = []
    cells: list[str] | None = []
    while cells is not None:
        try:
            cells = next(reader, None)
        except csv.Error as error:
            bad.append(Row(f"line {line}", {}, f"no CSV ({error})"))
            cells = []
        yield from bad
        if not columns and bad:
            return  # without a header nothing more can be told
        bad.clear()
        if not any(cells or ()):
            continue
        assert cells is not None
        if columns:
            yield _csv_row(f"line {line}", columns, cells)
            continue
        columns = [cell.strip() for cell in cells]
        problem = _header_problem(columns)
        if problem:
            yield Row(f"line {line}", {}, problem)
            return
    if not columns:
        raise ManifestError(f"{path} is empty", "Its first line names the columns: ms,pan,out.")


def _header_problem(columns: list[str]) -> str:
    if len(columns) > MAX_COLUMNS:
        return f"{len(columns)} columns; there are not that many options"
    twice = next((name for name in columns if columns.count(name) > 1), None)
    return "" if twice is None else f"the column {twice!r} is there twice"


def _csv_row(place: str, columns: list[str], cells: list[str]) -> Row:
    if len(cells) != len(columns):
        return Row(place, {}, f"{len(cells)} cells for {len(columns)} columns")
    return Row(place, dict(zip(columns, cells, strict=True)))
