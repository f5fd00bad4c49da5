"""What may become an output: no input, nothing but a regular file, and none that is to stay."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from geodelreg.errors import OutputExistsError, OutputIsInputError, OutputUnwritableError
from geodelreg.geotiff.durable import unwritable

STDOUT = Path("-")
"""In place of the name of a side output: standard output."""


class Inputs:
    """Files that are read and must stay as they are.

    Parameters
    ----------
    paths : iterable of Path
        Files, and names that must not come into being.
    """

    def __init__(self, paths: Iterable[Path] = ()) -> None:
        self._by_place: dict[str, Path] = {}
        self._by_node: dict[tuple[int, int], Path] = {}
        folders: dict[Path, str] = {}
        for path in paths:
            if path.parent not in folders:
                folders[path.parent] = os.path.realpath(path.parent)
            self._by_place[f"{folders[path.parent]}{os.sep}{path.name}"] = path
            with suppress(OSError, ValueError):
                status = path.stat()
                self._by_node[status.st_dev, status.st_ino] = path

    def check(self, target: Path) -> None:
        """Refuse a target that is one of them, also through links or another spelling.

        Raises
        ------
        OutputIsInputError
        """
        found = self._by_place.get(os.path.realpath(target))
        with suppress(OSError):
            status = target.stat()
            found = self._by_node.get((status.st_dev, status.st_ino), found)
        if found is not None:
            what = "is the input" if found.exists() else "would be taken for a part of an input,"
            raise OutputIsInputError(
                f"{target} {what} {found}",
                "Choose another name, or correct the header with `write_in_place`.",
            )


def check_not_input(target: Path, inputs: Iterable[Path]) -> None:
    """Refuse a target that is one of the inputs, also through links or another spelling.

    Raises
    ------
    OutputIsInputError
    """
    Inputs(inputs).check(target)


def check_replaceable(target: Path, overwrite: bool, stale: Iterable[Path] = ()) -> None:
    """Refuse a target that exists, or has left side files, unless it may be overwritten.

    Raises
    ------
    OutputExistsError, OutputUnwritableError
    """
    try:
        mode = target.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        mode = stat.S_IFREG
    except OSError as error:
        raise unwritable(target, error) from error
    if stat.S_ISDIR(mode):
        raise unwritable(target, IsADirectoryError(errno.EISDIR, "is a folder"))
    if not stat.S_ISREG(mode):
        raise OutputUnwritableError(
            f"{target} cannot be written: it is a device, a pipe or a socket",
            "Name a file; - is standard output, except for rasters.",
        )
    if target.exists() and overwrite and not os.access(target, os.W_OK):
        raise OutputUnwritableError(
            f"{target} cannot be written: the file is read-only",
            "Change its permissions or choose another name.",
        )
    in_the_way = [path for path in (target, *stale) if os.path.lexists(path)]
    if in_the_way and not overwrite:
        what = f"{target} exists"
        if in_the_way[0] != target:
            what = f"{in_the_way[0]} exists and would be taken for a part of {target.name}"
        raise OutputExistsError(what, "Add `overwrite=True` to replace it, or choose another name.")


def make_folder(folder: Path) -> None:
    """Make a folder for outputs, and those above it.

    Raises
    ------
    OutputUnwritableError
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputUnwritableError(
            f"{folder} cannot be made ({error.strerror})", "Choose another place."
        ) from error
