"""A TIFF with larger directories, all of them in front of the image data.

Cloud optimised GeoTIFFs (COG) keep their directories first.  Appending a directory would break
that and encoding anew would change lossy pixels, so the file is laid out again: new directories,
then the encoded blocks as they are, all at one constant distance from where they were.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from geodelreg.errors import LossyOutputError
from geodelreg.geotiff.copying import copy_range
from geodelreg.geotiff.durable import write_fully
from geodelreg.tiff import (
    CLASSIC_LIMIT,
    LONG,
    LONG8,
    Directory,
    Entry,
    Layout,
    TiffFile,
    directory_length,
    encode_directory,
)

STRIP_OFFSETS, STRIP_BYTE_COUNTS, TILE_OFFSETS, TILE_BYTE_COUNTS = 273, 279, 324, 325
_SUBFILE_TYPE, _REDUCED_IMAGE = 254, 1
_BLOCK_TAGS = ((STRIP_OFFSETS, STRIP_BYTE_COUNTS), (TILE_OFFSETS, TILE_BYTE_COUNTS))
_OTHER_POINTERS = {288, 330, 400, 513, 519, 520, 521, 34665, 34853, 40965}
"""Free blocks, sub-directories, EXIF, old-style JPEG: tags that hold further file offsets."""

_GHOST = re.compile(rb"GDAL_STRUCTURAL_METADATA_SIZE=(\d{6}) bytes\n")
_ALIGNMENT = 16


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Where the parts of a TIFF lie.

    Attributes
    ----------
    directories : list of Directory
    ghost : bytes
        What GDAL writes between header and first directory of a COG; b"" elsewhere.
    directories_end : int
        End of the last directory or value of one.
    data_start, data_end : int
        Extent of the encoded blocks.
    """

    directories: list[Directory]
    ghost: bytes
    directories_end: int
    data_start: int
    data_end: int

    @classmethod
    def read(cls, tiff: TiffFile) -> Structure:
        """Read it from a file.

        Raises
        ------
        RasterUnreadableError
            Directories are broken.
        """
        chain = tiff.directories()
        ends = [d.offset + d.byte_length(tiff.layout) for d in chain]
        for directory in chain:
            outside = [entry for entry in directory.entries if tiff.is_outside(entry)]
            ends += [tiff.place(entry) + entry.size for entry in outside]
        extents = [_block_extent(tiff, directory) for directory in chain]
        starts = [start for start, end in extents if end]
        return cls(
            chain,
            _read_ghost(tiff),
            max(ends),
            min(starts, default=tiff.size),
            max((end for _, end in extents), default=0),
        )

    @property
    def is_marked_cog(self) -> bool:
        """GDAL wrote it as a COG, and nobody has edited it since."""
        return b"LAYOUT=IFDS_BEFORE_DATA" in self.ghost and (
            b"KNOWN_INCOMPATIBLE_EDITION=NO" in self.ghost
        )

    def is_cog(self, tiff: TiffFile) -> bool:
        """Tiled, directories first, and with overviews or GDAL's mark."""
        main = self.directories[0]
        if main.find(TILE_OFFSETS) is None or self.directories_end > self.data_start:
            return False
        if not self.is_marked_cog and not _block_extent(tiff, main)[1]:
            return False  # nothing is stored that could come after the directories
        kinds = [tiff.integers(directory.find(_SUBFILE_TYPE)) for directory in self.directories]
        return self.is_marked_cog or any(len(k) and int(k[0]) & _REDUCED_IMAGE for k in kinds)


def check_movable(tiff: TiffFile, structure: Structure) -> None:
    """Refuse files with offsets that are not understood.

    Raises
    ------
    LossyOutputError
    """
    for directory in structure.directories:
        for entry in directory.entries:
            if entry.tag in _OTHER_POINTERS or not entry.size or entry.type in (13, 18):
                raise LossyOutputError(
                    f"{tiff.path} cannot be laid out again: its TIFF tag {entry.tag} may point to "
                    "data that would be lost",
                    "Write it anew with options of your choice, e.g. "
                    "`creation_options=['COMPRESS=ZSTD']`.",
                )


def write(
    tiff: TiffFile,
    source: BinaryIO,
    target: BinaryIO,
    structure: Structure,
    main_entries: Sequence[Entry],
) -> None:
    """Write `source` to `target` with the entries of its main directory replaced.

    The result becomes a BigTIFF when it would be too large otherwise.

    Raises
    ------
    LossyOutputError
        The file holds offsets that are not understood.
    OSError
    """
    check_movable(tiff, structure)
    keep_from = structure.directories_end
    if keep_from > structure.data_start:
        keep_from = tiff.layout.header_bytes
    layouts = [tiff.layout, Layout(tiff.layout.order, True)]
    for layout in layouts:
        front = _front(tiff, layout, structure, main_entries, 0)
        shift = len(front) - keep_from
        if layout.big or tiff.size + shift <= CLASSIC_LIMIT:
            break
    front = _front(tiff, layout, structure, main_entries, shift)
    write_fully(target.fileno(), front, 0)
    copy_range(source, target, keep_from, len(front), tiff.size - keep_from)


def _front(
    tiff: TiffFile, layout: Layout, structure: Structure, main_entries: Sequence[Entry], shift: int
) -> bytes:
    """Header and directories, for blocks that move by `shift` bytes."""
    first = layout.header_bytes + len(structure.ghost)
    first += first % 2
    front = (layout.header(first) + structure.ghost).ljust(first, b"\0")
    last = len(structure.directories) - 1
    for number, directory in enumerate(structure.directories):
        entries = main_entries if number == 0 else directory.entries
        moved = [_moved(tiff, entry, layout, shift) for entry in entries]
        at = len(front)
        following = 0 if number == last else at + directory_length(layout, moved)
        front += encode_directory(layout, moved, at, following)
    return front.ljust(-(-len(front) // _ALIGNMENT) * _ALIGNMENT, b"\0")


def _moved(tiff: TiffFile, entry: Entry, layout: Layout, shift: int) -> Entry:
    if entry.tag not in (STRIP_OFFSETS, TILE_OFFSETS):
        return replace(entry, data=tiff.value(entry))
    offsets = tiff.integers(entry).astype(np.int64)
    offsets[offsets != 0] += shift  # 0 marks a block that is not stored
    data = offsets.astype(f"{layout.order}u{layout.offset_bytes}").tobytes()
    return replace(entry, type=LONG8 if layout.big else LONG, data=data)


def _block_extent(tiff: TiffFile, directory: Directory) -> tuple[int, int]:
    """First and last byte of the blocks of one image; (0, 0) without any."""
    for offsets_tag, counts_tag in _BLOCK_TAGS:
        offsets = tiff.integers(directory.find(offsets_tag))
        counts = tiff.integers(directory.find(counts_tag))
        if len(offsets) != len(counts):
            raise tiff.broken("its lists of offsets and of lengths differ")
        stored: NDArray[np.bool_] = (offsets != 0) & (counts != 0)
        if stored.any():
            ends = offsets[stored].astype(np.float64) + counts[stored].astype(np.float64)
            return int(offsets[stored].min()), int(ends.max())
    return 0, 0


def _read_ghost(tiff: TiffFile) -> bytes:
    start = tiff.layout.header_bytes
    head = tiff.read(start, min(43, tiff.size - start))
    match = _GHOST.match(head)
    if match is None:
        return b""
    length = len(match.group(0)) + int(match.group(1))
    return tiff.read(start, min(length, tiff.size - start))


def check_complete(tiff: TiffFile, structure: Structure) -> None:
    """Refuse a file that ends before its last block.

    Raises
    ------
    RasterUnreadableError
    """
    if structure.data_end > tiff.size:
        raise tiff.broken(
            f"it is truncated, {structure.data_end - tiff.size} bytes of its blocks are missing"
        )
