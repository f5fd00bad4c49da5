"""Outputs that appear whole or not at all, one or many of them.

Every output is written into a private folder beside its target (`geodelreg.geotiff.private`),
flushed to the disk and renamed into place, side files first and the target itself last.  What a
killed process leaves behind is found by the next one that writes one of the same targets: it
finishes the work where that had been decided, otherwise it takes it back
(`geodelreg.geotiff.journal`).
"""

from __future__ import annotations

import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path

from geodelreg.errors import FileLockedError, OutputUnwritableError
from geodelreg.geotiff import journal, undo
from geodelreg.geotiff.durable import fsync_folder, fsync_path, inherit, unwritable
from geodelreg.geotiff.private import PrivateFolder, private_path
from geodelreg.geotiff.sidecars import belongs
from geodelreg.geotiff.targets import STDOUT, Inputs, check_replaceable

logger = logging.getLogger(__name__)


def write_text_atomically(path: Path, text: str, overwrite: bool) -> None:
    """Write a UTF-8 text file that appears whole or not at all; ``-`` is standard output.

    Raises
    ------
    OutputExistsError, OutputUnwritableError, FileLockedError
    """
    write_bytes_atomically(path, text.encode(), overwrite)


def write_bytes_atomically(path: Path, data: bytes, overwrite: bool) -> None:
    """Write a file that appears whole or not at all; ``-`` is standard output.

    Raises
    ------
    OutputExistsError, OutputUnwritableError, FileLockedError
    """
    if path == STDOUT:
        with together() as run:
            run.afterwards.append(lambda: _print(data))
        return
    with staged(path, overwrite=overwrite) as work:
        work.write_bytes(data)


@contextmanager
def together(
    targets: Iterable[Path] = (), inputs: Callable[[], Iterable[Path]] = tuple
) -> Iterator[Run]:
    """Let all that the block writes appear when it ends, or nothing of it.

    Inside another such block it is a part of that one.

    Parameters
    ----------
    targets : iterable of Path
        Files known to be written: all are locked before the first is begun.
    inputs : callable
        Gives files that must not be written; asked by the outermost block only.

    Yields
    ------
    Run

    Raises
    ------
    OutputUnwritableError, OutputIsInputError, FileLockedError
    """
    outer = _current.get()
    run = Run(inputs()) if outer is None else outer
    if outer is not None:
        run.lock_all(targets)
        yield run
        return
    token = _current.set(run)
    try:
        run.lock_all(targets)
        yield run
        run.publish()
    finally:
        _current.reset(token)
        run.close()
    for work in run.afterwards:
        work()


@contextmanager
def staged(target: Path, *, overwrite: bool, stale: Iterable[Path] = ()) -> Iterator[Path]:
    """Yield the path to write instead of `target`; on success all goes into place.

    Other files that the body creates beside the yielded path become side files of `target`.  On
    any exception, KeyboardInterrupt included, everything stays as it was.

    Parameters
    ----------
    target : Path
        Final place; a symbolic link is followed.
    overwrite : bool
        Whether existing files may be replaced.
    stale : iterable of Path
        Side files of an earlier `target` that must not survive beside the new one.

    Yields
    ------
    Path
        File of the same name in a private folder on the same file system.

    Raises
    ------
    OutputExistsError
        A file is in the way and `overwrite` is False.
    OutputUnwritableError
        Folder missing, no permission, disk full; no regular file.
    FileLockedError
        Another process is writing `target`.
    """
    with together() as run:
        member = run.member(target)
        old = [path for path in dict.fromkeys(stale) if os.path.lexists(path)]
        check_replaceable(member.target, overwrite, old)
        try:
            member.files.mkdir()
            yield member.files / member.target.name
            run.add(member, overwrite, old)
        except BaseException as error:
            shutil.rmtree(member.files, ignore_errors=True)
            if isinstance(error, OSError):
                raise unwritable(member.target, error) from error
            raise


@contextmanager
def exclusive(target: Path) -> Iterator[PrivateFolder]:
    """Hold the lock of `target`: yield its private folder, which is removed at the end.

    Raises
    ------
    FileLockedError, OutputUnwritableError
    """
    folder = PrivateFolder(Path(os.path.realpath(target)))
    try:
        journal.settle(folder, {})
        yield folder
    finally:
        folder.release()


def tidy(targets: Iterable[Path]) -> None:
    """Finish or take back what a killed process left beside targets.

    Raises
    ------
    FileLockedError, OutputUnwritableError
    """
    for target in targets:
        if os.path.lexists(private_path(Path(os.path.realpath(target)))):
            with exclusive(target):
                pass


class Run:
    """All that one block of `together` writes.

    Attributes
    ----------
    afterwards : list of callable
        Called when everything is in place.
    """

    def __init__(self, inputs: Iterable[Path]) -> None:
        self.afterwards: list[Callable[[], None]] = []
        self._inputs = Inputs(inputs)
        self._locked: dict[Path, PrivateFolder] = {}
        self._plans: dict[PrivateFolder, journal.Plan] = {}
        self._run = os.urandom(16).hex()

    def lock_all(self, targets: Iterable[Path]) -> None:
        """Lock targets, in an order that no two processes can block each other with."""
        for target in sorted(targets, key=os.path.realpath):
            self.lock(target)

    def lock(self, target: Path) -> PrivateFolder:
        """Lock a target, after settling what was left beside it."""
        place = Path(os.path.realpath(target))
        if place not in self._locked:
            self._locked[place] = PrivateFolder(place)
            journal.settle(self._locked[place], self._locked)
        return self._locked[place]

    def member(self, target: Path) -> PrivateFolder:
        """Lock a target that is going to be written.

        Raises
        ------
        OutputUnwritableError
                It is no regular file.
        FileLockedError
            It is one of the outputs already, or another process is writing it.
        OutputIsInputError
        """
        check_replaceable(target, overwrite=True)  # before links in /dev and /proc are followed
        self._inputs.check(target)
        folder = self.lock(target)
        if folder in self._plans or folder.files.exists():
            raise FileLockedError(
                f"{target} is being written already", "Give each output its own name."
            )
        return folder

    def add(self, folder: PrivateFolder, overwrite: bool, stale: Sequence[Path]) -> None:
        """Plan to put what lies in ``folder.files`` into place.

        Raises
        ------
        OutputExistsError, OutputIsInputError, OutputUnwritableError
        """
        target = folder.target
        created = sorted(folder.files.iterdir(), key=lambda path: (path.name == target.name, path))
        for path in created:
            if not path.is_file() or path.is_symlink() or not belongs(target, path.name):
                raise OutputUnwritableError(
                    f"{target} cannot be written: its format makes {path.name}, too, which would "
                    "not be known for a part of it",
                    "Choose another format.",
                )
        places = [target.with_name(path.name) for path in created]
        removed = [path for path in stale if path not in places]
        for place in (*places, *removed):
            check_replaceable(place, overwrite)
            self._inputs.check(place)
        for path, place in zip(created, places, strict=True):
            name_lost(place, inherit(path, place, target))
            fsync_path(path)
        files = {place.name: os.path.lexists(place) for place in places}
        self._plan(folder, files, [path.name for path in removed], 0)

    def add_edit(self, raster: Path, edits: Sequence[undo.Edit]) -> None:
        """Plan the last of some edits in place of a raster; those before it are made already.

        Raises
        ------
        FileLockedError
            One is planned already.
        OSError
        """
        folder = self.lock(raster)
        if folder in self._plans:
            raise FileLockedError(f"{raster} is named twice", "Name each file once.")
        record = undo.record_path(folder.target)
        draft = folder.files / record.name
        folder.files.mkdir()
        draft.write_bytes(undo.encoded(edits))
        name_lost(record, inherit(draft, record, folder.target))
        fsync_path(draft)
        self._plan(folder, {record.name: record.exists()}, [], len(edits))

    def publish(self) -> None:
        """Put everything into place, or nothing."""
        touched: set[Path] = set()
        for folder, plan in self._plans.items():
            places = {folder.target.with_name(name) for name in (*plan.files, *plan.removed)}
            for place in sorted(places & touched):
                raise OutputUnwritableError(
                    f"{place} cannot be written: it is a part of two outputs",
                    "Give them names of their own.",
                )
            touched |= places
        if len(touched) == 1 and not any(plan.edits for plan in self._plans.values()):
            ((folder, plan),) = self._plans.items()
            try:
                (folder.files / next(iter(plan.files))).replace(next(iter(touched)))
                fsync_folder(folder.target.parent)
            except OSError as error:
                raise unwritable(folder.target, error) from error
        elif touched:
            targets = [one.target for one in self._plans]
            for one, plan in self._plans.items():
                group = [os.path.relpath(target, one.target.parent) for target in targets]
                self._plans[one] = replace(plan, group=group)
            journal.publish(self._plans)

    def close(self) -> None:
        """Give up all locks; what was not published is gone."""
        for folder in self._locked.values():
            folder.release()

    def _plan(
        self, folder: PrivateFolder, files: dict[str, bool], removed: list[str], edits: int
    ) -> None:
        inode = folder.path.stat().st_ino
        self._plans[folder] = journal.Plan(self._run, inode, [], files, removed, edits)


_current: ContextVar[Run | None] = ContextVar("run", default=None)


def name_lost(place: Path, lost: Sequence[str]) -> None:
    """Say what a replaced file had and the new one cannot have."""
    if lost:
        logger.warning("%s: lost, for want of permission: %s", place, ", ".join(lost))


def _print(data: bytes) -> None:
    sys.stdout.flush()
    if hasattr(sys.stdout, "buffer"):
        sys.stdout.buffer.write(data)
    else:  # a notebook's, which takes text only
        sys.stdout.write(data.decode(errors="replace"))
    sys.stdout.flush()
