"""Checks of the outputs before the work starts: a long run must not end in "file exists"."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from geodelreg.errors import (
    OutputExistsError,
    OutputIsInputError,
    OutputUnwritableError,
    UsageError,
)


def raster_targets(sources: Sequence[str], output: Path) -> list[Path]:
    """Files that the corrected rasters go to: OUT, or one of the same name a source in folder OUT.

    Parameters
    ----------
    sources : sequence of str
        MS file, or one file per band.
    output : Path

    Raises
    ------
    UsageError
        Two sources have the same file name.
    OutputUnwritableError
        OUT is a folder and should be a file, or the reverse.
    """
    if len(sources) == 1:
        if output.is_dir():
            raise OutputUnwritableError(
                f"{output} is a folder", "Name a file, e.g. " + str(output / Path(sources[0]).name)
            )
        return [output]
    names = [Path(source).name for source in sources]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(
            f"Two MS files are called {twice} and would be written to one file in {output}",
            "Rename one, or align them one by one.",
        )
    if output.exists() and not output.is_dir():
        raise OutputUnwritableError(
            f"{output} is a file", "With several MS files, OUT is the folder that they go to."
        )
    return [output / name for name in names]


def check_targets(
    inputs: Sequence[str], targets: Sequence[Path], overwrite: bool, created: Path | None = None
) -> None:
    """Refuse outputs that cannot be written as asked, before anything is read.

    Parameters
    ----------
    inputs : sequence of str
        Files that are read and must stay as they are.
    targets : sequence of Path
        All files that will be written.
    overwrite : bool
        Existing targets may be replaced.
    created : Path, optional
        Folder that will be created when it is missing.

    Raises
    ------
    UsageError
        Two outputs are the same file.
    OutputIsInputError, OutputExistsError, OutputUnwritableError
    """
    seen: set[str] = set()
    for target in targets:
        resolved = os.path.realpath(target)
        if resolved in seen:
            raise UsageError(f"{target} is named for two outputs", "Give each its own name.")
        seen.add(resolved)
        _check_not_input(inputs, target)
        _check_absent(target, overwrite)
        folder = target.absolute().parent
        if created is not None and folder == created.absolute() and not folder.exists():
            folder = folder.parent
        _check_folder(target, folder)


def _check_not_input(inputs: Iterable[str], target: Path) -> None:
    if any(_same_file(name, target) for name in inputs):
        raise OutputIsInputError(
            f"{target} is both input and output",
            "Choose another name; align --in-place corrects the header of MS itself.",
        )


def _check_absent(target: Path, overwrite: bool) -> None:
    if target.is_dir():
        raise OutputUnwritableError(f"{target} is a folder", "Name a file.")
    if target.exists() and not overwrite:
        raise OutputExistsError(
            f"{target} exists", "Add --overwrite to replace it, or choose another name."
        )


def _check_folder(target: Path, folder: Path) -> None:
    if not folder.is_dir():
        raise OutputUnwritableError(f"{target}: its folder does not exist", "Create the folder.")
    if not os.access(folder, os.W_OK):
        raise OutputUnwritableError(
            f"{target}: no permission to write to {folder}", "Choose a folder you may write to."
        )


def _same_file(name: str, target: Path) -> bool:
    try:
        return target.samefile(name)
    except (OSError, ValueError):
        return False
