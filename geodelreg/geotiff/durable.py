"""Bytes and names on the disk: whole, flushed, with the access rights of what they replace."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from pathlib import Path

from geodelreg.errors import OutputUnwritableError

_CAUSES = {
    errno.ENOENT: ("its folder does not exist", "Create the folder."),
    errno.ENOTDIR: ("a file is where its folder should be", "Name another folder."),
    errno.EACCES: ("permission denied", "Choose a place you may write to."),
    errno.EPERM: ("permission denied", "Choose a place you may write to."),
    errno.EROFS: ("the file system is read-only", "Choose another place."),
    errno.ENOSPC: ("the disk is full", "Free some space or choose another disk."),
    errno.EDQUOT: ("the disk quota is used up", "Free some space or choose another disk."),
    errno.EFBIG: ("it is too large for the file system", "Choose another disk."),
    errno.EISDIR: ("it is a folder", "Name a file."),
}
_ACL = "system.posix_acl_access"
_OF_THE_SYSTEM = ("security.ima", "security.evm")
"""Attributes that sign the content, which is another one now."""


def unwritable(target: Path, error: OSError) -> OutputUnwritableError:
    """What to tell the user when writing `target` failed with `error`."""
    default = (error.strerror or str(error), "Check the disk, or choose another place.")
    cause, remedy = _CAUSES.get(error.errno or 0, default)
    return OutputUnwritableError(f"{target} cannot be written: {cause}", remedy)


def write_fully(descriptor: int, data: bytes, offset: int) -> None:
    """Write all of `data` at `offset` of an open file."""
    os.lseek(descriptor, offset, os.SEEK_SET)
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


def fsync_path(path: Path) -> None:
    """Flush a file to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fsync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, where the platform can."""
    with suppress(PermissionError):  # Windows does not open folders
        fsync_path(folder)


def replace_bytes(path: Path, data: bytes, draft: Path, like: Path) -> list[str]:
    """Put `data` in place of a file, in one step.

    Parameters
    ----------
    path : Path
    data : bytes
    draft : Path
        Where they are written first, on the same file system.
    like : Path
        File whose access rights `path` gets when it does not exist.

    Returns
    -------
    list of str
        Attributes of the old file that are lost.
    """
    draft.parent.mkdir(exist_ok=True)
    draft.write_bytes(data)
    lost = inherit(draft, path, like)
    fsync_path(draft)
    draft.replace(path)
    fsync_folder(path.parent)
    return lost


def inherit(new: Path, replaced: Path, like: Path) -> list[str]:
    """Give a file the attributes of the one that it replaces.

    Parameters
    ----------
    new : Path
    replaced : Path
        Owner, mode, ACL and extended attributes are its own.
    like : Path
        When there is no `replaced`: owner, mode and ACL are those of this file, if it exists.

    Returns
    -------
    list of str
        What could not be given.
    """
    old, everything = (replaced, True) if replaced.is_file() else (like, False)
    if not old.is_file():
        return []
    mode, lost = _inherit_owner(new, old)
    lost += _inherit_extended(new, old, everything)
    try:
        new.chmod(mode)
    except OSError:
        lost.append("permissions")
    return lost


def _inherit_owner(new: Path, old: Path) -> tuple[int, list[str]]:
    """Mode that is right for the owner and group that `new` now has, and what is lost."""
    before, after = old.stat(), new.stat()
    mode = stat.S_IMODE(before.st_mode)
    if (before.st_uid, before.st_gid) == (after.st_uid, after.st_gid) or not hasattr(os, "chown"):
        return mode, []
    with suppress(OSError):
        os.chown(new, before.st_uid, before.st_gid)
        return mode, []
    with suppress(OSError):
        os.chown(new, -1, before.st_gid)
        return mode & 0o777, [f"owner {before.st_uid}"]
    others = mode & 0o007  # another group may do no more than anybody
    return mode & 0o700 | others << 3 | others, [f"owner {before.st_uid}, group {before.st_gid}"]


def _inherit_extended(new: Path, old: Path, everything: bool) -> list[str]:
    if not hasattr(os, "listxattr"):
        return []
    lost = []
    wanted, present = _attributes(old), _attributes(new)
    if not everything:
        wanted = {name: value for name, value in wanted.items() if name == _ACL}
    if _ACL in present and _ACL not in wanted:  # from the folder's default ACL
        with suppress(OSError):
            os.removexattr(new, _ACL)
    for name, value in wanted.items():
        if present.get(name) == value or name in _OF_THE_SYSTEM:
            continue
        try:
            os.setxattr(new, name, value)
        except OSError:
            lost.append("ACL" if name == _ACL else f"extended attribute {name}")
    return lost


def _attributes(path: Path) -> dict[str, bytes]:
    found = {}
    with suppress(OSError):
        for name in os.listxattr(path):
            with suppress(OSError):
                found[name] = os.getxattr(path, name)
    return found
