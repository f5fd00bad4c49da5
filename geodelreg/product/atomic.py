"""Outputs that appear whole or not at all.

Every output is written into a private folder beside its target, ``.<name>.geodelreg``, flushed to
the disk and renamed into place, side files first and the target itself last.  The folder holds a
lock, so that two processes never write one target at once.  What a killed process leaves behind is
found by the next one that writes the same target: it finishes the renaming where that had begun,
otherwise it throws the folder away.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import shutil
import stat
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from geodelreg.errors import (
    FileLockedError,
    OutputExistsError,
    OutputIsInputError,
    OutputUnwritableError,
)

if sys.platform != "win32":
    import fcntl

logger = logging.getLogger(__name__)

_CAUSES = {
    errno.ENOENT: ("its folder does not exist", "Create the folder."),
    errno.ENOTDIR: ("its folder does not exist", "Create the folder."),
    errno.EACCES: ("permission denied", "Choose a place you may write to."),
    errno.EPERM: ("permission denied", "Choose a place you may write to."),
    errno.EROFS: ("the file system is read-only", "Choose another place."),
    errno.ENOSPC: ("the disk is full", "Free some space or choose another disk."),
    errno.EDQUOT: ("the disk quota is used up", "Free some space or choose another disk."),
    errno.EFBIG: ("it is too large for the file system", "Choose another disk."),
    errno.EISDIR: ("it is a folder", "Name a file."),
}
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)


def unwritable(target: Path, error: OSError) -> OutputUnwritableError:
    """What to tell the user when writing `target` failed with `error`."""
    default = (error.strerror or str(error), "Check the disk, or choose another place.")
    cause, remedy = _CAUSES.get(error.errno or 0, default)
    return OutputUnwritableError(f"{target} cannot be written: {cause}", remedy)


def check_not_input(target: Path, inputs: Iterable[Path]) -> None:
    """Refuse a target that is one of the inputs, also through links or another spelling.

    Raises
    ------
    OutputIsInputError
    """
    for name in inputs:
        with suppress(OSError):
            if target.samefile(name):
                raise OutputIsInputError(
                    f"{target} is the input {name}",
                    "Choose another name, or correct the header with --in-place.",
                )


def write_text_atomically(path: Path, text: str, overwrite: bool) -> None:
    """Write a UTF-8 text file that appears whole or not at all.

    Raises
    ------
    OutputExistsError, OutputUnwritableError, FileLockedError
    """
    with staged(path, overwrite=overwrite) as work:
        work.write_bytes(text.encode())


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
        Folder missing, no permission, disk full.
    FileLockedError
        Another process is writing `target`.
    """
    target = Path(os.path.realpath(target))
    with exclusive(target) as folder:
        files = folder / "files"
        old = [path for path in dict.fromkeys(stale) if os.path.lexists(path)]
        check_replaceable(target, overwrite, old)
        try:
            files.mkdir()
            yield files / target.name
            _publish(files, target, overwrite, old)
        except OSError as error:
            raise unwritable(target, error) from error


def tidy(targets: Iterable[Path]) -> None:
    """Finish or remove what a killed process left beside targets that are not to be written now."""
    for target in targets:
        if os.path.lexists(_private_folder(Path(os.path.realpath(target)))):
            with suppress(OutputUnwritableError, FileLockedError), exclusive(target):
                pass


@contextmanager
def exclusive(target: Path) -> Iterator[Path]:
    """Hold the lock of `target`: yield its private folder, which is removed at the end.

    Raises
    ------
    FileLockedError, OutputUnwritableError
    """
    target = Path(os.path.realpath(target))
    folder = _private_folder(target)
    try:
        descriptor = _acquire(folder, target)
    except OSError as error:
        raise unwritable(target, error) from error
    try:
        _finish_or_discard(folder, target)
        yield folder
    finally:
        if not (folder / "ready").exists():
            with suppress(OSError):
                _clear(folder)
                (folder / "lock").unlink()
                folder.rmdir()
        os.close(descriptor)


def check_replaceable(target: Path, overwrite: bool, stale: Iterable[Path] = ()) -> None:
    """Refuse a target that exists, or has left side files, unless it may be overwritten.

    Raises
    ------
    OutputExistsError, OutputUnwritableError
    """
    if target.is_dir():
        raise unwritable(target, IsADirectoryError(errno.EISDIR, "is a folder"))
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
        raise OutputExistsError(what, "Add --overwrite to replace it, or choose another name.")


def fsync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, where the platform can."""
    with suppress(PermissionError):  # Windows does not open folders
        _fsync_path(folder)


def write_fully(descriptor: int, data: bytes, offset: int) -> None:
    """Write all of `data` at `offset` of an open file."""
    os.lseek(descriptor, offset, os.SEEK_SET)
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


def _private_folder(target: Path) -> Path:
    name = target.name
    if len(os.fsencode(name)) > 200:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()
    return target.with_name(f".{name}.geodelreg")


def _acquire(folder: Path, target: Path) -> int:
    """Descriptor of the locked file in `folder`; both are created."""
    lock = folder / "lock"
    while True:
        try:
            folder.mkdir()
        except FileExistsError:
            with suppress(FileNotFoundError):  # by now, its owner may have removed it
                if not stat.S_ISDIR(folder.lstat().st_mode):
                    raise
        try:
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
        except FileNotFoundError:  # the previous owner has just removed the folder
            continue
        try:
            _lock(descriptor, target)
            if os.path.samestat(os.fstat(descriptor), lock.stat()):
                return descriptor
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _lock(descriptor: int, target: Path) -> None:
    if sys.platform == "win32":  # no advisory locks there; the rest works
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise FileLockedError(
            f"{target} is being written by another process",
            "Wait for it to end, or give each process its own output.",
        ) from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        logger.warning("%s: the file system has no locks; going on without", target)


def _publish(files: Path, target: Path, overwrite: bool, stale: list[Path]) -> None:
    created = sorted(path for path in files.iterdir() if path.is_file())
    for path in created:
        _fsync_path(path)
    places = {path: target.with_name(path.name) for path in created}
    check_replaceable(target, overwrite, places.values())
    removed = [path for path in stale if path not in places.values()]
    ready = files.with_name("ready")
    if len(created) + len(removed) > 1:
        _write_ready(ready, removed)
    move = _Move(files.parent, target)
    try:
        move.run(removed)
    except BaseException:
        move.undo()
        ready.unlink(missing_ok=True)
        raise
    fsync_folder(target.parent)
    ready.unlink(missing_ok=True)


def _write_ready(ready: Path, removed: list[Path]) -> None:
    """Say that all files are complete: from here on a killed run is finished by the next."""
    draft = ready.with_suffix(".draft")
    draft.write_text(json.dumps([path.name for path in removed]))
    _fsync_path(draft)
    fsync_folder(ready.parent / "files")
    draft.replace(ready)
    fsync_folder(ready.parent)


def _finish_or_discard(folder: Path, target: Path) -> None:
    """Deal with what a killed process left in the private folder."""
    ready = folder / "ready"
    try:
        if ready.exists() and (folder / "files" / target.name).exists():
            logger.warning("%s: finishing a write that was interrupted", target)
            removed = [target.with_name(Path(name).name) for name in json.loads(ready.read_text())]
            _Move(folder, target).run([path for path in removed if os.path.lexists(path)])
        ready.unlink(missing_ok=True)
        _clear(folder)
    except OSError as error:
        raise unwritable(target, error) from error


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "lock":
            path.unlink()


class _Move:
    """Renames complete files into place, the target last."""

    def __init__(self, folder: Path, target: Path) -> None:
        self.folder, self.target = folder, target
        self.complete = folder / "files" / target.name
        self.done: list[tuple[Path, Path]] = []

    def run(self, removed: list[Path]) -> None:
        (self.folder / "replaced").mkdir(exist_ok=True)
        for path in removed:
            self._set_aside(path)
        for path in sorted(self.complete.parent.iterdir()):
            if path != self.complete:
                self._place(path, self.target.with_name(path.name))
        if self.target.exists():
            shutil.copymode(self.target, self.complete)
        self.complete.replace(self.target)

    def undo(self) -> None:
        """Put the side files back, unless the target has already been replaced."""
        if self.complete.exists():
            for now, before in reversed(self.done):
                now.replace(before)

    def _set_aside(self, path: Path) -> None:
        kept = self.folder / "replaced" / path.name
        path.replace(kept)
        self.done.append((kept, path))

    def _place(self, path: Path, place: Path) -> None:
        if os.path.lexists(place):
            self._set_aside(place)
        path.replace(place)
        self.done.append((place, path))


def _fsync_path(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
