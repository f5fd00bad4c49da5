"""The directory of a TIFF file, read and written without touching its image data.

Classic TIFF (revision 6.0, 1992) and BigTIFF in either byte order.  A directory is a list of
`Entry`; an entry whose value already lies in the file is carried over by its offset.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from geodelreg.errors import RasterUnreadableError

ASCII, SHORT, LONG, DOUBLE, LONG8 = 2, 3, 4, 12, 16
_TYPE_BYTES = {
    **dict.fromkeys((1, 2, 6, 7), 1),
    **dict.fromkeys((3, 8), 2),
    **dict.fromkeys((4, 9, 11, 13), 4),
    **dict.fromkeys((5, 10, 12, 16, 17, 18), 8),
}
_INTEGER_CODES = {1: "B", SHORT: "H", LONG: "I", 6: "b", 8: "h", 9: "i", LONG8: "Q", 17: "q"}
_CODES = {**_INTEGER_CODES, DOUBLE: "d"}
_MAX_ENTRIES = 4096
"""Of a directory; libtiff refuses more."""

_MAX_DIRECTORY_BYTES = 2**30
"""Of all directories of a file with their values; a broken file may announce any length."""

CLASSIC_LIMIT = 2**32 - 1
"""Largest offset that a classic TIFF can hold."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Byte order and width of the offsets of a file.

    Attributes
    ----------
    order : str
        ``<`` or ``>``, as in `struct`.
    big : bool
        BigTIFF.
    """

    order: str
    big: bool

    @property
    def offset_bytes(self) -> int:
        """Width of an offset, and of a value that is kept inside its entry."""
        return 8 if self.big else 4

    @property
    def pointer_at(self) -> int:
        """Where the file keeps the offset of its first directory."""
        return 8 if self.big else 4

    @property
    def count_bytes(self) -> int:
        """Width of a number of directory entries."""
        return 8 if self.big else 2

    @property
    def header_bytes(self) -> int:
        """Length of the file header."""
        return 16 if self.big else 8

    @property
    def entry_bytes(self) -> int:
        """Length of one directory entry."""
        return 20 if self.big else 12

    def offset(self, value: int) -> bytes:
        """Encode an offset."""
        return struct.pack(self.order + ("Q" if self.big else "I"), value)

    def count(self, value: int) -> bytes:
        """Encode a number of directory entries."""
        return struct.pack(self.order + ("Q" if self.big else "H"), value)

    def header(self, first_directory: int) -> bytes:
        """Encode the file header."""
        mark = b"II" if self.order == "<" else b"MM"
        version = (43, 8, 0) if self.big else (42,)
        return (
            mark
            + struct.pack(f"{self.order}{len(version)}H", *version)
            + self.offset(first_directory)
        )


@dataclass(frozen=True, slots=True)
class Entry:
    """One tag of a directory.

    Attributes
    ----------
    tag, type, count : int
    field : bytes
        The value if it is short enough, otherwise its offset, in the file's byte order; ignored
        when `data` is given.
    data : bytes or None
        A value that is not in the file yet, in the file's byte order.
    """

    tag: int
    type: int
    count: int
    field: bytes = b""
    data: bytes | None = None

    @property
    def size(self) -> int:
        """Length of the value in bytes; 0 for an unknown type."""
        return _TYPE_BYTES.get(self.type, 0) * self.count

    @classmethod
    def of(cls, layout: Layout, tag: int, type_: int, values: Sequence[float] | bytes) -> Entry:
        """Entry with a new value: numbers, or bytes for `ASCII` (a NUL is added)."""
        if isinstance(values, bytes):
            return cls(tag, type_, len(values) + 1, data=values + b"\0")
        code = f"{layout.order}{len(values)}{_CODES[type_]}"
        return cls(tag, type_, len(values), data=struct.pack(code, *values))


@dataclass(frozen=True, slots=True)
class Directory:
    """One image file directory, with its place in the file."""

    offset: int
    entries: tuple[Entry, ...]
    next_offset: int

    def find(self, tag: int) -> Entry | None:
        """Entry of a tag."""
        return next((entry for entry in self.entries if entry.tag == tag), None)

    def byte_length(self, layout: Layout) -> int:
        """Length of the directory itself, without the values outside it."""
        return layout.count_bytes + len(self.entries) * layout.entry_bytes + layout.offset_bytes


class TiffFile:
    """A TIFF file that is open for reading.

    Parameters
    ----------
    path : Path
        For messages.
    file : binary file
        Open and seekable; the caller closes it.

    Raises
    ------
    RasterUnreadableError
        The file is no TIFF, or its directory is broken.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.size = file.seek(0, os.SEEK_END)
        head = self.read(0, min(16, self.size))
        layout = layout_of(head)
        if layout is None or len(head) < layout.header_bytes:
            raise self.broken("it is no TIFF file")
        self.layout = layout
        self.first_offset = self._offset(head[layout.pointer_at :])

    def broken(self, cause: str) -> RasterUnreadableError:
        """Error for a file that contradicts itself."""
        return RasterUnreadableError(
            f"{self.path} cannot be read: {cause}", "Obtain the file again, or repair it."
        )

    def read(self, offset: int, length: int) -> bytes:
        """Read exactly `length` bytes."""
        if offset < 0 or length < 0 or offset + length > self.size:
            raise self.broken("its TIFF directory points outside the file")
        self.file.seek(offset)
        parts = []
        while length:
            part = self.file.read(min(length, 1 << 24))
            if not part:
                raise self.broken("it was shortened while being read")
            parts.append(part)
            length -= len(part)
        return b"".join(parts)

    def entries(self, offset: int) -> tuple[Entry, ...]:
        """Entries of a directory, even if the file ends before the offset of the next."""
        layout = self.layout
        head = self.read(offset, layout.count_bytes)
        (count,) = struct.unpack(layout.order + ("Q" if layout.big else "H"), head)
        if not 0 < count <= _MAX_ENTRIES:
            raise self.broken(f"its TIFF directory has {count} entries")
        body = self.read(offset + layout.count_bytes, count * layout.entry_bytes)
        code = layout.order + ("HHQ8s" if layout.big else "HHI4s")
        return tuple(Entry(*fields) for fields in struct.iter_unpack(code, body))

    def directory(self, offset: int) -> Directory:
        """Read one directory."""
        layout, entries = self.layout, self.entries(offset)
        end = offset + layout.count_bytes + len(entries) * layout.entry_bytes
        return Directory(offset, entries, self._offset(self.read(end, layout.offset_bytes)))

    def first_directory(self) -> Directory:
        """Directory of the main image."""
        return self.directory(self.first_offset)

    def directories(self) -> list[Directory]:
        """Read the whole chain: main image, overviews, masks, further pages."""
        chain: list[Directory] = []
        seen: set[int] = set()
        offset, total = self.first_offset, 0
        while offset:
            if offset in seen:
                raise self.broken("its TIFF directories form a circle")
            seen.add(offset)
            directory = self.directory(offset)
            total += directory.byte_length(self.layout)
            total += sum(entry.size for entry in directory.entries if self.is_outside(entry))
            if total > _MAX_DIRECTORY_BYTES:
                raise self.broken("its TIFF directories are impossibly long")
            chain.append(directory)
            offset = directory.next_offset
        return chain

    def is_outside(self, entry: Entry) -> bool:
        """Whether the value lies elsewhere in the file."""
        return entry.data is None and entry.size > self.layout.offset_bytes

    def place(self, entry: Entry) -> int:
        """Offset of a value that lies outside its entry."""
        return self._offset(entry.field)

    def value(self, entry: Entry | None) -> bytes:
        """Raw value of an entry, b"" for None."""
        return b"" if entry is None else self._start(entry, entry.size)

    def numbers(self, entry: Entry | None) -> tuple[float, ...]:
        """Value of an integer or DOUBLE entry; () for None or another type."""
        if entry is None or entry.type not in _CODES:
            return ()
        code = f"{self.layout.order}{entry.count}{_CODES[entry.type]}"
        return struct.unpack(code, self.value(entry))

    def first_integer(self, entry: Entry | None) -> int | None:
        """First number of an integer entry; None for no number, for None or another type."""
        if entry is None or not entry.count or entry.type not in _INTEGER_CODES:
            return None
        code = self.layout.order + _INTEGER_CODES[entry.type]
        return int(struct.unpack(code, self._start(entry, _TYPE_BYTES[entry.type]))[0])

    def _start(self, entry: Entry, length: int) -> bytes:
        """First bytes of a raw value."""
        if entry.data is not None:
            return entry.data[:length]
        if self.is_outside(entry):
            return self.read(self.place(entry), length)
        return entry.field[:length]

    def integers(self, entry: Entry | None) -> NDArray[np.uint64]:
        """(count,) uint64 value of a SHORT, LONG or LONG8 entry; empty for None."""
        if entry is None:
            return np.empty(0, dtype=np.uint64)
        if entry.type not in (SHORT, LONG, LONG8):
            raise self.broken(f"TIFF tag {entry.tag} has type {entry.type}")
        kind = f"{self.layout.order}u{_TYPE_BYTES[entry.type]}"
        return np.frombuffer(self.value(entry), dtype=kind).astype(np.uint64)

    def _offset(self, raw: bytes) -> int:
        code = self.layout.order + ("Q" if self.layout.big else "I")
        return int(struct.unpack_from(code, raw)[0])


def layout_of(head: bytes) -> Layout | None:
    """Layout that the first bytes of a file announce; None when it is no TIFF."""
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None or len(head) < 4:
        return None
    (version,) = struct.unpack(order + "H", head[2:4])
    return Layout(order, version == 43) if version in (42, 43) else None


def is_tiff(path: Path) -> bool:
    """Whether a local file starts as a TIFF does."""
    try:
        with path.open("rb") as file:
            return layout_of(file.read(4)) is not None
    except OSError:
        return False


def replaced(
    entries: Iterable[Entry], new: Iterable[Entry], dropped: Iterable[int] = ()
) -> tuple[Entry, ...]:
    """Entries with some tags dropped and others replaced or added, in the order TIFF asks for."""
    new = list(new)
    gone = {entry.tag for entry in new} | set(dropped)
    return tuple(sorted([e for e in entries if e.tag not in gone] + new, key=lambda e: e.tag))


def directory_length(layout: Layout, entries: Sequence[Entry]) -> int:
    """Length of what `encode_directory` returns."""
    values = [len(e.data) for e in entries if e.data and len(e.data) > layout.offset_bytes]
    return _values_offset(layout, entries) + sum(length + length % 2 for length in values)


def encode_directory(layout: Layout, entries: Sequence[Entry], at: int, next_offset: int) -> bytes:
    """Encode a directory for offset `at`, followed by those of its values that are new.

    Returns
    -------
    bytes
        Of even length, so that another directory can follow.
    """
    values_at = at + _values_offset(layout, entries)
    head, values = [layout.count(len(entries))], bytearray()
    for entry in entries:
        field = entry.field
        if entry.data is not None:
            if len(entry.data) <= layout.offset_bytes:
                field = entry.data.ljust(layout.offset_bytes, b"\0")
            else:
                field = layout.offset(values_at + len(values))
                values += entry.data + b"\0" * (len(entry.data) % 2)
        kind = struct.pack(
            layout.order + ("HHQ" if layout.big else "HHI"), entry.tag, entry.type, entry.count
        )
        head.append(kind + field)
    head.append(layout.offset(next_offset))
    return b"".join(head).ljust(values_at - at, b"\0") + bytes(values)


def _values_offset(layout: Layout, entries: Sequence[Entry]) -> int:
    length = Directory(0, tuple(entries), 0).byte_length(layout)
    return length + length % 2
