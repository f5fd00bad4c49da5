"""Rows of a manifest as pairs, all of them checked before any is started."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from geodelreg.batch.cells import FILES, LISTS, list_of, options_of, unknown_columns
from geodelreg.batch.job import ALIGN, CHECK, IN_PLACE, Pair
from geodelreg.batch.rows import Row
from geodelreg.door.names import is_local
from geodelreg.errors import GeodelregError, ManifestError, UsageError
from geodelreg.masking import parse_mask
from geodelreg.options import AlignOptions, WriteOptions

_MOST_PROBLEMS = 100
_MASKS = ("masks", "pan_masks")


@dataclass(frozen=True, slots=True)
class Setting:
    """What holds for all pairs.

    Attributes
    ----------
    name : str
        Of the manifest, for messages.
    folder : Path
        Absolute; where relative names of inputs begin.
    out_root : Path
        Absolute; where relative names of outputs begin, and below which all outputs stay.
    mode : str
        ``align``, ``in_place`` or ``check``.
    align, write : as their types say
        Options of pairs that say nothing else.
    reserved : tuple of Path
        Files that no pair may write: manifest, ledger, tables.
    fresh : bool
        Nothing of these pairs has been written yet.
    """

    name: str
    folder: Path
    out_root: Path
    mode: str = ALIGN
    align: AlignOptions = field(default_factory=AlignOptions)
    write: WriteOptions = field(default_factory=WriteOptions)
    reserved: tuple[Path, ...] = ()
    fresh: bool = True


class _Problems:
    """What is wrong, each thing once, with the first line that it concerns."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[str, int]] = {}
        self.count = 0

    def add(self, place: str, text: str) -> None:
        self.count += 1
        if text in self._found:
            first, times = self._found[text]
            self._found[text] = first, times + 1
        elif len(self._found) < _MOST_PROBLEMS:
            self._found[text] = place, 1

    def sentences(self) -> tuple[str, ...]:
        return tuple(
            f"{place}{f' and {times - 1} more' if times > 1 else ''}: {text}"
            for text, (place, times) in self._found.items()
        )


def checked_pairs(rows: Iterable[Row], setting: Setting) -> Iterator[Pair]:
    """Pairs of a manifest, in its order.

    Parameters
    ----------
    rows : iterable of Row
    setting : Setting

    Yields
    ------
    Pair

    Raises
    ------
    ManifestError
        After the last pair when anything is wrong with any: do nothing with them before that.
    """
    problems, targets, inputs = _Problems(), _Targets(setting), set[str]()
    number = 0
    for row in rows:
        number += 1
        for text in [row.problem] if row.problem else unknown_columns(row.cells):
            problems.add(row.place, text)
        if row.problem:
            continue
        try:
            pair = _pair(row.cells, setting)
            inputs.update(map(resolved, _inputs(pair, setting.mode)))
            written = pair.sources if setting.mode == IN_PLACE else map(str, pair.targets)
            for target in written:
                targets.add(target, row.place)
        except GeodelregError as error:
            problems.add(row.place, error.cause)
            continue
        yield pair
    for place, text in targets.late_problems(inputs):
        problems.add(place, text)
    if problems.count:
        found = problems.sentences()
        raise ManifestError(
            f"{setting.name}: {problems.count} problems, so no pair was started ({found[0]})",
            "Correct the lines, or leave them out.",
            found,
        )
    if not number:
        raise ManifestError(f"{setting.name} lists no pairs", "Add lines below the header.")


class _Targets:
    """Files that are written, each by one pair, below the root, and read by none."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._root = resolved(str(setting.out_root))
        self._places: dict[str, str] = {}

    def add(self, target: str, place: str) -> None:
        path = resolved(target)
        in_place = self._setting.mode == IN_PLACE
        if not in_place and not path.startswith(self._root.rstrip(os.sep) + os.sep):
            raise UsageError(f"out {target} lies outside of {self._root}", "Use `out_root`.")
        if path in self._places:
            what = "is corrected in place by" if in_place else "is the output of"
            raise UsageError(f"{target} {what} {self._places[path]} already")
        self._places[path] = place
        if in_place:
            return
        if Path(path).is_dir():
            raise UsageError(f"out {target} is a folder")
        if self._setting.fresh and not self._setting.write.overwrite and os.path.lexists(path):
            raise UsageError(f"out {target} exists; `overwrite=True` replaces it")

    def late_problems(self, inputs: set[str]) -> Iterator[tuple[str, str]]:
        """Places and texts of what can be told only when all are known."""
        folders = {""}
        reserved = {resolved(str(path)) for path in self._setting.reserved}
        for path, place in self._places.items():
            if path in inputs:
                yield place, f"{path} is written, and is an input of the batch"
            if path in reserved:
                yield place, f"{path} is a file of the batch itself"
            above = path.rpartition(os.sep)[0]
            while above not in folders:
                folders.add(above)
                if above in self._places:
                    first = self._places[above]
                    yield place, f"out {path} lies below {above}, which is the output of {first}"
                    folders.discard(above)
                    break
                above = above.rpartition(os.sep)[0]


def _pair(cells: Mapping[str, Any], setting: Setting) -> Pair:
    missing = [n for n in _needed(setting.mode) if cells.get(n) in (None, "", [], ())]
    if missing:
        raise UsageError(f"no value for {', '.join(missing)}")
    for name, cell in cells.items():
        texts = cell if isinstance(cell, list) else [cell]
        for text in texts:
            _check_text(name, text)
    sources = tuple(_input(name, setting.folder) for name in list_of("ms", cells["ms"]))
    if not sources:
        raise UsageError("no value for ms")
    pan = cells["pan"]
    if not isinstance(pan, str):
        raise UsageError("pan is no text")
    names = [Path(source).name for source in sources]
    if setting.mode == ALIGN and len(set(names)) < len(names):
        raise UsageError("two of the MS files have the same name and would be one output")
    own = dict(cells)
    for name in _MASKS:
        if cells.get(name):
            own[name] = tuple(_mask(text, setting.folder) for text in list_of(name, cells[name]))
    align, write = options_of(own, setting.align, setting.write)
    output = _output(cells.get("out"), setting)
    return Pair(sources, _input(pan.strip(), setting.folder), output, align, write)


def _needed(mode: str) -> tuple[str, ...]:
    return FILES if mode == ALIGN else ("ms", "pan")


def _check_text(name: str, text: Any) -> None:
    if not isinstance(text, str):
        return
    if "\0" in text:
        raise UsageError(f"{name} holds a NUL")
    try:
        os.fsencode(text).decode()
    except UnicodeError:
        raise UsageError(f"{name} holds characters that no file name has") from None
    if name in (*FILES, *LISTS) and len(text) > 100_000:
        raise UsageError(f"{name} is {len(text)} characters long")


def _input(name: str, folder: Path) -> str:
    return str(folder / name) if is_local(name) else name


def _mask(text: str, folder: Path) -> str:
    path = parse_mask(text).path
    return _input(path, folder) + text[len(path) :]


def with_absolute_masks(options: AlignOptions) -> AlignOptions:
    """The same options, whatever the folder of the process that gets them."""
    from dataclasses import replace

    here = Path.cwd()
    masks = {n: tuple(_mask(text, here) for text in getattr(options, n)) for n in _MASKS}
    return replace(options, **masks)  # type: ignore[arg-type]


def _output(out: Any, setting: Setting) -> str:
    if setting.mode == CHECK or out in (None, ""):
        return ""
    if setting.mode == IN_PLACE:
        raise UsageError("out has a value, and MS itself is corrected (`in_place=True`)")
    if not isinstance(out, str):
        raise UsageError("out is no text")
    if not is_local(out):
        raise UsageError(f"out {out} is no file of this machine")
    return os.path.normpath(setting.out_root / out.strip())


def _inputs(pair: Pair, mode: str) -> Iterator[str]:
    if mode != IN_PLACE:
        yield from pair.sources
    yield pair.reference
    for name in _MASKS:
        yield from (parse_mask(text).path for text in pair.align.get(name, ()))


def resolved(path: str) -> str:
    """`path` without links, as `os.path.realpath` would, but each folder is looked up once."""
    if not is_local(path):
        return path
    given = Path(path).absolute()
    if given.name in ("", "..") or given.is_symlink():
        return os.path.realpath(path)
    return f"{_real_folder(str(given.parent)).rstrip(os.sep)}{os.sep}{given.name}"


@lru_cache(maxsize=4096)
def _real_folder(folder: str) -> str:
    return os.path.realpath(folder)
