"""Checks of the outputs before the work starts: a long run must not end in "file exists"."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path

import click

from geodelreg.errors import OutputUnwritableError, UsageError
from geodelreg.geotiff.durable import unwritable
from geodelreg.geotiff.sidecars import possible_sidecars
from geodelreg.geotiff.targets import STDOUT, Inputs, check_replaceable


def raster_targets(sources: Sequence[str], output: Path, apart: bool = False) -> list[Path]:
    """Files that the corrected rasters go to: OUT, or one of the same name a source in folder OUT.

    Parameters
    ----------
    sources : sequence of str
        MS file, or one file per band.
    output : Path
    apart : bool
        Each band gets a header of its own: OUT is a folder for them, or a VRT.

    Raises
    ------
    UsageError
        Two sources have the same file name.
    OutputUnwritableError
        OUT is a folder and should be a file, or the reverse.
    """
    from geodelreg.product.band_files import band_targets
    from geodelreg.writing_bands import bands_target

    if output == STDOUT:
        raise UsageError("-o -: a raster cannot be written to standard output", "Name a file.")
    if apart and not bands_target(output, len(sources)):
        return [out for path in sources for out in band_targets(Path(path), output).values()]
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
    inputs: Sequence[str],
    targets: Sequence[Path],
    overwrite: bool,
    created: Path | None = None,
    rasters: Sequence[Path] = (),
) -> None:
    """Refuse outputs that cannot be written as asked, before anything is read.

    Parameters
    ----------
    inputs : sequence of str
        Files that are read and must stay as they are.
    targets : sequence of Path
        All files that will be written; ``-`` is standard output.
    overwrite : bool
        Existing targets may be replaced.
    created : Path, optional
        Folder that will be created when it is missing.
    rasters : sequence of Path
        Those of `targets` that are rasters: others must not be taken for side files of them.

    Raises
    ------
    UsageError
        Two outputs are the same file.
    OutputIsInputError, OutputExistsError, OutputUnwritableError
    """
    known = Inputs(map(Path, inputs))
    parts = {os.path.realpath(side): out for out in rasters for side in possible_sidecars(out)}
    seen: set[str] = set()
    for target in targets:
        resolved = "-" if target == STDOUT else os.path.realpath(target)
        if resolved in seen:
            raise UsageError(f"{target} is named for two outputs", "Give each its own name.")
        seen.add(resolved)
        if target == STDOUT:
            continue
        if resolved in parts:
            raise UsageError(
                f"{target} would be taken for a part of {parts[resolved]}", "Choose another name."
            )
        known.check(target)
        check_replaceable(target, overwrite)
        folder = target.absolute().parent
        if created is not None and folder == created.absolute() and not folder.exists():
            folder = folder.parent
        if not folder.is_dir():
            there = next(path for path in (folder, *folder.parents) if path.exists())
            code = errno.ENOENT if there.is_dir() else errno.ENOTDIR
            raise unwritable(target, OSError(code, "no such folder"))
        if not os.access(folder, os.W_OK):
            raise unwritable(target, PermissionError(errno.EACCES, "permission denied"))


def check_gcp_formats(paths: Sequence[Path]) -> None:
    """Refuse control points of which the extension says no format.

    Raises
    ------
    click.UsageError
    """
    from geodelreg.product.gcps import GCP_FORMATS

    known = {suffix for spec in GCP_FORMATS.values() for suffix in spec.extensions}
    for path in paths:
        if path.suffix.lower() not in known:
            raise click.UsageError(
                f"--gcps {path}: the extension says no format; add --gcp-format, or use one of "
                + ", ".join(sorted(known))
            )
