"""The record that lets an edit of a header in place be taken back, bit by bit.

It lies beside the raster as ``<name>.geodelreg-undo.json`` and is written before the raster is
touched, so that it also tells the next run what a killed one was doing.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, BinaryIO

from geodelreg.errors import UnsafeInPlaceError
from geodelreg.geotiff import sidecars
from geodelreg.geotiff.durable import fsync_folder, replace_bytes, write_fully

_VERSION = 2
_LARGEST_BYTES = 1 << 28
"""Of a record, and of each of its parts; a damaged one may unpack to anything."""


class State(Enum):
    """How far an edit has come on the disk."""

    NONE = "nothing of it shows"
    STARTED = "it was interrupted"
    COMPLETE = "it is done"
    FOREIGN = "another program has changed the file since"


@dataclass(frozen=True, slots=True)
class SidecarChange:
    """Content of a side file before and after; None where there is none."""

    name: str
    before: bytes | None
    after: bytes | None


@dataclass(frozen=True, slots=True, eq=False)
class Edit:
    """One edit of a header: bytes appended, then one pointer replaced.

    Attributes
    ----------
    size : int
        Length of the file before.
    pointer_at : int
        Offset of the pointer to the first directory.
    old_pointer, new_pointer : bytes
    tail : bytes
        What is appended.
    sidecars : tuple of SidecarChange
    """

    size: int
    pointer_at: int
    old_pointer: bytes
    new_pointer: bytes
    tail: bytes
    sidecars: tuple[SidecarChange, ...] = ()

    def state(self, raster: Path, file: BinaryIO, later: Edit | None = None) -> State:
        """Compare the file with what it was and what it should become.

        Parameters
        ----------
        raster : Path
        file : binary file
        later : Edit, optional
            The next edit on record: the file is seen as it will be without that one.
        """
        end = os.fstat(file.fileno()).st_size
        pointer = _read(file, self.pointer_at, len(self.old_pointer))
        if later is not None:
            end, pointer = min(end, later.size), later.old_pointer
        if end < self.size:
            return State.FOREIGN
        added = _read(file, self.size, min(len(self.tail) + 1, end - self.size))
        if pointer == self.new_pointer and added == self.tail:
            waiting = any(
                _content(raster, change.name) == change.before for change in self.sidecars
            )
            return State.STARTED if waiting else State.COMPLETE
        if pointer != self.old_pointer or not self.tail.startswith(added):
            return State.FOREIGN
        return State.STARTED if added else State.NONE

    def apply(self, raster: Path, file: BinaryIO, scratch: Path) -> None:
        """Edit the file; killed at any point, it reads as before or as after.

        Parameters
        ----------
        raster : Path
        file : binary file
        scratch : Path
            Folder for drafts of side files.
        """
        descriptor = file.fileno()
        write_fully(descriptor, self.tail, self.size)
        os.fsync(descriptor)
        write_fully(descriptor, self.new_pointer, self.pointer_at)
        os.fsync(descriptor)
        for change in self.sidecars:
            _replace(raster, change.name, change.after, scratch)

    def undo(self, raster: Path, file: BinaryIO, scratch: Path) -> None:
        """Take the edit back, from whatever point it had come to; parameters as of `apply`."""
        descriptor = file.fileno()
        for change in reversed(self.sidecars):
            if _content(raster, change.name) != change.before:
                _replace(raster, change.name, change.before, scratch)
        if _read(file, self.pointer_at, len(self.old_pointer)) != self.old_pointer:
            write_fully(descriptor, self.old_pointer, self.pointer_at)
            os.fsync(descriptor)
        os.ftruncate(descriptor, self.size)
        os.fsync(descriptor)


def record_path(raster: Path) -> Path:
    """Where the record of a raster lies."""
    return sidecars.beside(raster, sidecars.UNDO_SUFFIX)


def load(raster: Path) -> list[Edit]:
    """Edits in the order in which they were made; empty without a record.

    Raises
    ------
    UnsafeInPlaceError
        The record is damaged.
    """
    path = record_path(raster)
    try:
        if not path.is_file() and os.path.lexists(path):
            raise ValueError("no regular file")
        if path.stat().st_size > _LARGEST_BYTES:
            raise ValueError("too large")
        document = json.loads(path.read_bytes())
        if document["version"] != _VERSION:
            raise ValueError(f"version {document['version']}")
        edits = [_decoded(raster, item) for item in document["edits"]]
        if document["sha256"] != _digest(document["edits"]):
            raise ValueError("its checksum is wrong")
        return edits
    except FileNotFoundError:
        return []
    except (
        ValueError,
        LookupError,
        TypeError,
        ArithmeticError,
        RecursionError,
        zlib.error,
    ) as error:
        raise UnsafeInPlaceError(
            f"{path} is no undo record that this version understands ({error})",
            f"If {raster.name} is as it should be, remove the record and try again.",
        ) from error


def save(raster: Path, edits: Sequence[Edit], scratch: Path) -> None:
    """Replace the record; without edits it is removed.

    Raises
    ------
    OSError
    """
    _replace(raster, record_path(raster).name, encoded(edits) if edits else None, scratch)


def encoded(edits: Sequence[Edit]) -> bytes:
    """Content of a record."""
    items = [_encoded(edit) for edit in edits]
    document = {"version": _VERSION, "sha256": _digest(items), "edits": items}
    return json.dumps(document, indent=1).encode() + b"\n"


def _digest(edits: Any) -> str:
    return hashlib.sha256(json.dumps(edits, sort_keys=True).encode()).hexdigest()


def _encoded(edit: Edit) -> dict[str, Any]:
    return {
        "size": edit.size,
        "pointer_at": edit.pointer_at,
        "old_pointer": edit.old_pointer.hex(),
        "new_pointer": edit.new_pointer.hex(),
        "tail": _text(edit.tail),
        "sidecars": [
            {"name": change.name, "before": _text(change.before), "after": _text(change.after)}
            for change in edit.sidecars
        ],
    }


def _decoded(raster: Path, item: dict[str, Any]) -> Edit:
    old, new = bytes.fromhex(item["old_pointer"]), bytes.fromhex(item["new_pointer"])
    size, pointer_at = int(item["size"]), int(item["pointer_at"])
    if (pointer_at, len(old), len(new)) not in ((4, 4, 4), (8, 8, 8)) or size < 8:
        raise ValueError("impossible offsets")
    allowed = {path.name for path in sidecars.placement_sidecars(raster)}
    changes = []
    for change in item["sidecars"]:
        if change["name"] not in allowed:
            raise ValueError(f"{change['name']} does not belong to the raster")
        before, after = _bytes(change["before"]), _bytes(change["after"])
        changes.append(SidecarChange(change["name"], before, after))
    tail = _bytes(item["tail"])
    if not tail:
        raise ValueError("nothing was appended")
    return Edit(size, pointer_at, old, new, tail, tuple(changes))


def _text(data: bytes | None) -> str | None:
    return None if data is None else base64.b64encode(zlib.compress(data)).decode()


def _bytes(text: str | None) -> bytes | None:
    if text is None:
        return None
    unpacking = zlib.decompressobj()
    data = unpacking.decompress(base64.b64decode(text, validate=True), _LARGEST_BYTES)
    if not unpacking.eof:
        raise ValueError("a part of it is cut off or too large")
    return data


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    parts = b""
    while len(parts) < length:
        part = file.read(length - len(parts))
        if not part:
            break
        parts += part
    return parts


def _content(raster: Path, name: str) -> bytes | None:
    path = raster.with_name(name)
    return path.read_bytes() if path.is_file() else None


def _replace(raster: Path, name: str, content: bytes | None, scratch: Path) -> None:
    path = raster.with_name(name)
    if content is None:
        path.unlink(missing_ok=True)
        fsync_folder(path.parent)
        return
    replace_bytes(path, content, scratch / name, raster)
