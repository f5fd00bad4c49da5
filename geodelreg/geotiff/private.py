"""The private folder beside a target, ``.<name>.geodelreg``: its lock, and files in the making.

::

    lock       held by the process that writes the target
    files/     what will be put into place
    replaced/  what was there before
    scratch/   drafts
    plan       what is to be done (see `geodelreg.geotiff.journal`)
    commit     it is to be done, not taken back

Folders come with archives, and other users make them where all may write.  So one that was there
before is used only when it belongs to the user of this process and holds nothing but regular
files whose names belong to the target.  Otherwise it is refused, and nothing in it is touched.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import stat
import sys
from contextlib import suppress
from pathlib import Path

from geodelreg.errors import FileLockedError, OutputUnwritableError
from geodelreg.geotiff.durable import unwritable
from geodelreg.geotiff.sidecars import belongs

if sys.platform != "win32":
    import errno
    import fcntl

    _NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)

logger = logging.getLogger(__name__)

_RECORDS = ("lock", "plan", "plan.draft", "commit")
_FOLDERS = ("files", "replaced", "scratch")
_OPEN_SAFELY = (
    getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
)


def private_path(target: Path) -> Path:
    """Where the private folder of a target (no link) lies."""
    name = target.name
    if len(os.fsencode(name)) > 200:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()
    return target.with_name(f".{name}.geodelreg")


def unsettled(path: Path) -> str:
    """Warning for a file that is to change together with others, which a killed run left undone."""
    place = Path(os.path.realpath(path))
    if not os.path.lexists(private_path(place) / "plan"):
        return ""
    return (
        f"{path} is being written, or a run that wrote it was killed: it may not fit the files "
        "that belong to it; the next align or revert that writes it settles that"
    )


class PrivateFolder:
    """The private folder of a target, locked.

    Parameters
    ----------
    target : Path
        The file itself, no link to it.

    Attributes
    ----------
    target, path : Path
    files, replaced, scratch : Path
        Folders in it, made when they are needed.
    plan, commit : Path

    Raises
    ------
    FileLockedError
        Another process holds it.
    OutputUnwritableError
        It cannot be made, or someone else may have made it.
    """

    def __init__(self, target: Path) -> None:
        self.target, self.path = target, private_path(target)
        self.files, self.replaced, self.scratch = (self.path / name for name in _FOLDERS)
        self.plan, self.commit = self.path / "plan", self.path / "commit"
        try:
            self._descriptor = self._acquire()
        except OSError as error:
            raise unwritable(target, error) from error
        try:
            self._check_content()
        except BaseException:
            os.close(self._descriptor)
            raise

    def release(self) -> None:
        """Give it back; it is removed, unless a plan in it is still to be settled."""
        if not os.path.lexists(self.plan):
            with suppress(OSError):
                self.clear()
                (self.path / "lock").unlink()
                self.path.rmdir()
        os.close(self._descriptor)

    def clear(self) -> None:
        """Remove everything but lock and plan."""
        for folder in (self.files, self.replaced, self.scratch):
            if folder.exists():
                shutil.rmtree(folder)
        for path in (self.path / "plan.draft", self.commit):
            path.unlink(missing_ok=True)

    def foreign(self, why: str) -> OutputUnwritableError:
        """Error that says why the folder is not used."""
        return OutputUnwritableError(
            f"{self.target} cannot be written: {self.path} {why}",
            "Nothing in it was touched. If no other run is writing this file, remove the folder "
            "(or have its owner remove it) and try again.",
        )

    def read(self, path: Path, limit: int) -> bytes:
        """Content of a regular file in the folder, up to `limit` bytes; never through a link."""
        descriptor = os.open(path, os.O_RDONLY | _OPEN_SAFELY)
        with open(descriptor, "rb") as file:  # noqa: PTH123 - a descriptor
            self._check_file(path, os.fstat(descriptor))
            return file.read(limit)

    def _acquire(self) -> int:
        """Descriptor of the locked file; the folder and it are created when missing."""
        while True:
            try:
                os.mkdir(self.path, 0o700)  # noqa: PTH102 - with a mode that no umask widens
                made = True
            except FileExistsError:
                made = False
            with suppress(FileNotFoundError, FileExistsError):  # its owner has just removed it
                status = self.path.lstat()
                if not stat.S_ISDIR(status.st_mode):
                    raise self.foreign("is no folder")
                # some network drives give all that one makes to one and the same user
                if not made and hasattr(os, "geteuid") and status.st_uid != os.geteuid():
                    raise self.foreign(f"belongs to another user ({status.st_uid})")
                descriptor = self._open_lock()
                try:
                    self._check_file(self.path / "lock", os.fstat(descriptor))
                    _lock(descriptor, self.target)
                    if os.path.samestat(os.fstat(descriptor), (self.path / "lock").lstat()):
                        return descriptor
                except BaseException:
                    os.close(descriptor)
                    raise
                os.close(descriptor)

    def _open_lock(self) -> int:
        lock = self.path / "lock"
        try:
            self._check_file(lock, lock.lstat())
        except FileNotFoundError:
            left = [path.name for path in self.path.iterdir()]
            if left and "lock" not in left:  # a run makes its lock first and removes it last
                raise self.foreign(f"holds {left[0]} and no lock") from None
            return os.open(lock, os.O_RDWR | os.O_CREAT | os.O_EXCL | _OPEN_SAFELY, 0o600)
        return os.open(lock, os.O_RDWR | _OPEN_SAFELY)

    def _check_content(self) -> None:
        for path in self.path.iterdir():
            if path.name in _RECORDS:
                self._check_file(path, path.lstat())
            elif path.name in _FOLDERS and stat.S_ISDIR(path.lstat().st_mode):
                for inner in path.iterdir():
                    if not belongs(self.target, inner.name):
                        raise self.foreign(f"holds {inner.name}, which is no part of the file")
                    # what was replaced may have had other names elsewhere
                    self._check_file(inner, inner.lstat(), linked=path == self.replaced)
            else:
                raise self.foreign(f"holds {path.name}, which does not belong there")

    def _check_file(self, path: Path, status: os.stat_result, linked: bool = False) -> None:
        if stat.S_ISLNK(status.st_mode) and linked:
            return
        if not stat.S_ISREG(status.st_mode):
            raise self.foreign(f"holds {path.name}, which is no regular file")
        if status.st_nlink > 1 and not linked:
            raise self.foreign(f"holds {path.name}, which has another name elsewhere (hard link)")


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
