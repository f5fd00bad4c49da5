"""Bytes of a file to another file: holes stay holes, the kernel does the work where it can."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from geodelreg.errors import RasterNotFoundError, RasterUnreadableError
from geodelreg.geotiff.durable import write_fully

_CHUNK = 1 << 23
_NOT_BY_KERNEL = (errno.EXDEV, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.EBADF)
_WHOSE_FAULT = (errno.EIO, errno.ESTALE)
"""Errors of which only separate reads and writes tell whether source or target is bad."""


def copy_range(source: BinaryIO, target: BinaryIO, start: int, place: int, length: int) -> None:
    """Copy `length` bytes at `start` of one file to `place` of another, which grows to hold them.

    Parameters
    ----------
    source, target : binary file
        Unbuffered.
    start, place, length : int

    Raises
    ------
    RasterUnreadableError
        The source cannot be read, or is shorter.
    OSError
        The target cannot be written.
    """
    for first, last in _data_extents(source.fileno(), start, start + length):
        _copy_extent(source, target, first, place + first - start, last - first)
    if os.fstat(target.fileno()).st_size < place + length:
        os.ftruncate(target.fileno(), place + length)


def copy_file(source: Path, target: Path) -> None:
    """Copy the content of a file to a new one.

    Raises
    ------
    RasterUnreadableError
        The source cannot be read, or changes meanwhile.
    OSError
        The target cannot be written.
    """
    with (
        open_source(source) as reading,
        unchanged(source, reading),
        target.open("wb", buffering=0) as writing,
    ):
        copy_range(reading, writing, 0, 0, os.fstat(reading.fileno()).st_size)


def open_source(path: Path) -> BinaryIO:
    """Open an input, unbuffered.

    Raises
    ------
    RasterNotFoundError, RasterUnreadableError
    """
    try:
        return path.open("rb", buffering=0)
    except FileNotFoundError as error:
        raise RasterNotFoundError(f"{path} does not exist", "Check the name.") from error
    except OSError as error:
        raise RasterUnreadableError(
            f"{path} cannot be read: {error.strerror}", "Check its permissions."
        ) from error


def _copy_extent(source: BinaryIO, target: BinaryIO, start: int, place: int, length: int) -> None:
    by_kernel = hasattr(os, "copy_file_range")
    while length:
        size = min(length, _CHUNK)
        if by_kernel:
            try:
                done = os.copy_file_range(source.fileno(), target.fileno(), size, start, place)
            except OSError as error:
                if error.errno not in (*_NOT_BY_KERNEL, *_WHOSE_FAULT):
                    raise
                by_kernel = False
                continue
        else:
            data = _read(source, start, size)
            write_fully(target.fileno(), data, place)
            done = len(data)
        if not done:
            raise _shortened(source)
        start, place, length = start + done, place + done, length - done


def _read(source: BinaryIO, start: int, size: int) -> bytes:
    try:
        source.seek(start)
        return source.read(size)
    except OSError as error:
        raise RasterUnreadableError(
            f"{source.name} cannot be read: {error.strerror}", "Check the disk or the network."
        ) from error


def _shortened(source: BinaryIO) -> RasterUnreadableError:
    return RasterUnreadableError(
        f"{source.name} was shortened while being read", "Wait until it is complete and try again."
    )


def _data_extents(descriptor: int, start: int, end: int) -> Iterator[tuple[int, int]]:
    """Parts of a file between `start` and `end` that are no holes."""
    if not hasattr(os, "SEEK_DATA"):
        yield start, end
        return
    while start < end:
        try:
            first = os.lseek(descriptor, start, os.SEEK_DATA)
        except OSError as error:
            if error.errno != errno.ENXIO:  # the file system cannot tell
                yield start, end
            return
        if first >= end:
            return
        last = min(end, os.lseek(descriptor, first, os.SEEK_HOLE))
        yield first, last
        start = last


@contextmanager
def unchanged(path: Path, file: BinaryIO) -> Iterator[None]:
    """Context in which a file must not change; copying one that does gives neither state.

    Raises
    ------
    RasterUnreadableError
        On leaving, when it has changed.
    """
    before = os.fstat(file.fileno())
    yield
    after = os.fstat(file.fileno())
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        raise RasterUnreadableError(
            f"{path} changed while being read", "Wait until it is complete and try again."
        )
