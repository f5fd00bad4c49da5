"""Pairs out of patterns of file names: ``{scene}_MS.tif`` goes with ``{scene}_PAN.tif``."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from geodelreg.batch.rows import Row
from geodelreg.errors import UsageError

_FIELD = re.compile(r"\{(\w+)\}")
_PIECES = re.compile(r"\{\w+\}|\*\*/|[*?]|\[!?\]?[^\]]*\]|[^{*?\[]+|[{\[]")


def rows_from_patterns(ms: str, pan: str, out: str | None) -> Iterator[Row]:
    """Find pairs by the names of their files.

    Parameters
    ----------
    ms, pan : str
        Patterns with fields in braces, which stand for the same text in all patterns, and the
        wildcards ``*``, ``?`` and ``**/``.  Several MS files with the same fields are the bands of
        one image.
    out : str or None
        Pattern of the output, of the same fields.

    Yields
    ------
    Row
        In the order of the names; with `problem` where a pair has no PAN, or several.

    Raises
    ------
    UsageError
        A pattern has a field that `ms` has not, or no file is like `ms`.
    """
    known = set(_FIELD.findall(ms))
    for name, pattern in (("PAN", pan), ("OUT", out or "")):
        unknown = sorted(set(_FIELD.findall(pattern)) - known)
        if unknown:
            raise UsageError(
                f"the pattern of {name}, {pattern!r}, has the field {{{unknown[0]}}}, which that "
                f"of MS, {ms!r}, has not",
                "Use the fields of MS.",
            )
    groups = _groups(ms)
    if not groups:
        raise UsageError(f"no file is called like {ms!r}", "Quote the pattern; check the folder.")
    pans = {fields: _matches(pan, dict(fields)) for fields in groups}
    taken = {path for paths in pans.values() for path in paths}
    number = 0
    for fields, sources in groups.items():
        if not pans[fields] and taken.issuperset(sources):
            continue  # a PAN, whose name the pattern of MS fits as well
        number += 1
        yield _row(number, dict(fields), sources, pans[fields], pan, out)


def _groups(pattern: str) -> dict[tuple[tuple[str, str], ...], list[str]]:
    """Files like a pattern, by the texts of its fields."""
    wanted = re.compile(_regex(pattern), re.DOTALL)
    groups: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for path in sorted(glob.glob(_FIELD.sub("*", pattern), recursive=True)):  # noqa: PTH207
        found = wanted.fullmatch(path)
        if found is not None and Path(path).is_file():
            groups.setdefault(tuple(found.groupdict().items()), []).append(path)
    return groups


def _regex(pattern: str) -> str:
    seen: set[str] = set()
    parts = []
    for piece in _PIECES.findall(pattern):
        name = _FIELD.fullmatch(piece)
        if name is not None and name[1] not in seen:
            seen.add(name[1])
            parts.append(f"(?P<{name[1]}>[^/]+)")
        elif name is not None:
            parts.append(f"(?P={name[1]})")
        elif len(piece) > 2 and piece[0] == "[" and piece[-1] == "]":
            inside = piece[1:-1].replace("\\", r"\\")
            parts.append(f"[{'^' + inside[1:] if inside[0] == '!' else inside}]")
        else:
            wildcards = {"*": "[^/]*", "?": "[^/]", "**/": "(?:[^/]+/)*"}
            parts.append(wildcards.get(piece) or re.escape(piece))
    return "".join(parts)


def _matches(pattern: str, fields: Mapping[str, str]) -> list[str]:
    """Files like a pattern whose fields are known."""
    name = _FIELD.sub(lambda found: glob.escape(fields[found[1]]), pattern)
    found = glob.glob(name, recursive=True)  # noqa: PTH207
    return [path for path in sorted(found) if Path(path).is_file()]


def _row(
    number: int,
    fields: Mapping[str, str],
    sources: list[str],
    pans: list[str],
    pan: str,
    out: str | None,
) -> Row:
    if len(pans) != 1:
        wanted = _FIELD.sub(lambda found: fields[found[1]], pan)
        several = f"{len(pans)} files are called like {wanted}, one is needed"
        problem = several if pans else f"no file is called like {wanted}"
        return Row(sources[0], {}, problem)
    cells: dict[str, Any] = {"ms": sources, "pan": pans[0]}
    if out is not None:
        cells["out"] = _FIELD.sub(lambda found: fields[found[1]], out)
    return Row(f"pair {number}", cells)
