"""Cells of a manifest as options: text or JSON values in, values of the right types out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, fields, replace
from functools import lru_cache
from typing import Any

from geodelreg.errors import UsageError
from geodelreg.options import AlignOptions, WriteOptions

FILES = ("ms", "pan", "out")

NEVER = {
    "allow": "what may be opened is for who runs the batch to say",
    "config": "GDAL's settings are for who runs the batch to say",
    "overwrite": "what may be replaced is for who runs the batch to say",
    "in_place": "whether MS itself is changed is for who runs the batch to say",
    "threads": "each pair runs in one thread",
}
SIDE_FILES = ("gcps", "gcp_format", "report", "figure", "json", "dry_run", "check", "output")

_ALIGN = {f.name: f for f in fields(AlignOptions) if f.name not in NEVER}
_WRITE = {f.name: f for f in fields(WriteOptions) if f.name not in NEVER}
LISTS = ("ms", *(n for n, f in {**_ALIGN, **_WRITE}.items() if str(f.type).startswith("tuple")))
_BOOLS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
_SHOWN = 5


def unknown_columns(names: Mapping[str, Any]) -> list[str]:
    """What is wrong with the names of columns, in sentences."""
    unknown = [name for name in names if name not in (*FILES, *_ALIGN, *_WRITE)]
    forbidden = [name for name in unknown if name.replace("-", "_") in NEVER]
    sides = [name for name in unknown if name.replace("-", "_") in SIDE_FILES]
    problems = [f"column {n!r}: {NEVER[n.replace('-', '_')]}" for n in forbidden]
    problems += [f"column {n!r}: a manifest names no further outputs" for n in sides]
    others = [name for name in unknown if name not in forbidden and name not in sides]
    if others:
        more = f" and {len(others) - _SHOWN} more" if len(others) > _SHOWN else ""
        listed = ", ".join(repr(name[:40]) for name in others[:_SHOWN])
        problems.append(f"unknown option {listed}{more}")
    return problems


def options_of(
    cells: Mapping[str, Any], align: AlignOptions, write: WriteOptions
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of one pair that differ from the defaults of the library.

    Parameters
    ----------
    cells : mapping
        By column; what is empty or None is as in `align` and `write`.
    align, write : as their types say
        Of the whole batch.

    Raises
    ------
    UsageError
        A value is impossible.
    """
    given = {name: cell for name, cell in cells.items() if name not in FILES and not _empty(cell)}
    own = [
        tuple((name, _value(known[name], given[name])) for name in given if name in known)
        for known in (_ALIGN, _WRITE)
    ]
    return _changed(align, own[0]), _changed(write, own[1])


@lru_cache(maxsize=1024)
def _changed(base: AlignOptions | WriteOptions, own: tuple[tuple[str, Any], ...]) -> dict[str, Any]:
    """What differs from the defaults in `base` with other values; most pairs have the same."""
    checked, default = replace(base, **dict(own)), type(base)()
    values = {f.name: getattr(checked, f.name) for f in fields(checked)}
    return {name: value for name, value in values.items() if value != getattr(default, name)}


def list_of(name: str, cell: Any) -> tuple[str, ...]:
    """Several texts: a JSON list, or parted by semicolons in CSV.

    Raises
    ------
    UsageError
    """
    if isinstance(cell, str):
        return tuple(part.strip() for part in cell.split(";") if part.strip())
    if isinstance(cell, list | tuple) and all(isinstance(part, str) for part in cell):
        return tuple(cell)
    raise UsageError(f"{name} is neither text nor a list of texts")


def _empty(cell: Any) -> bool:
    return cell is None or (isinstance(cell, str) and not cell.strip())


def _value(field: Field[Any], cell: Any) -> Any:
    """A cell as the type of its option."""
    name, kind = field.name, str(field.type).split(" | ")[0]
    if kind.startswith("tuple[int"):
        return tuple(cell) if isinstance(cell, list) else str(cell).replace(";", ",")
    if kind.startswith("tuple"):
        return list_of(name, cell)
    text = cell.strip() if isinstance(cell, str) else cell
    is_number = isinstance(cell, int | float) and not isinstance(cell, bool)
    try:
        if kind == "bool":
            return _BOOLS[str(text).lower()]
        if kind == "int" and (isinstance(text, str) or (is_number and cell == int(cell))):
            return int(text)
        if kind == "float" and (isinstance(text, str) or is_number):
            return float(text)
        if kind == "str" and isinstance(text, str):
            return text
    except (ValueError, KeyError, OverflowError):
        pass
    raise UsageError(f"`{name}={str(cell)[:60]!r}` is no value of that option")
