"""TIFF files with a corrected header: copied, or edited where nobody else reads them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from geodelreg.geotiff import relayout
from geodelreg.geotiff.copying import copy_range, open_source, unchanged
from geodelreg.geotiff.durable import write_fully
from geodelreg.geotiff.header import Georeference, Metadata, Provenance, corrected_entries
from geodelreg.tiff import CLASSIC_LIMIT, Entry, TiffFile, directory_length, encode_directory


def copy_with_header(source: Path, out: Path, content: Provenance) -> None:
    """Copy a TIFF, encoded blocks as they are, and give the copy its corrected header.

    COGs stay COGs; a file that would outgrow classic TIFF becomes a BigTIFF.

    Raises
    ------
    RasterUnreadableError
        The source is broken, truncated, or changes meanwhile.
    LossyOutputError
        The file would have to be laid out again, which it does not allow.
    OSError
        The output cannot be written.
    """
    georeference = Georeference.read(source)
    with (
        open_source(source) as reading,
        unchanged(source, reading),
        out.open("w+b", buffering=0) as writing,
    ):
        tiff = TiffFile(source, reading)
        structure = relayout.Structure.read(tiff)
        relayout.check_complete(tiff, structure)
        entries = corrected_entries(tiff, structure.directories[0], georeference, content)
        if structure.is_cog(tiff) or not fits(tiff, entries):
            relayout.write(tiff, reading, writing, structure, entries)
        else:
            copy_range(reading, writing, 0, 0, tiff.size)
            _append(writing, tiff, entries)


def edit_private(path: Path, content: Provenance, more: Metadata) -> None:
    """Correct the header of a TIFF that no one else reads yet.

    Raises
    ------
    OSError
        It cannot be written.
    """
    draft = path.with_name(path.name + ".draft")
    georeference = Georeference.read(path)
    with path.open("r+b", buffering=0) as file:
        tiff = TiffFile(path, file)
        structure = relayout.Structure.read(tiff)
        entries = corrected_entries(tiff, structure.directories[0], georeference, content, more)
        if not structure.is_cog(tiff) and fits(tiff, entries):
            _append(file, tiff, entries)
            return
        with draft.open("w+b", buffering=0) as writing:
            relayout.write(tiff, file, writing, structure, entries)
    draft.replace(path)


def is_cog(source: Path) -> bool:
    """Whether a TIFF is cloud optimised: tiled, with its directories first."""
    with open_source(source) as file:
        tiff = TiffFile(source, file)
        return relayout.Structure.read(tiff).is_cog(tiff)


def is_tiled(source: Path) -> bool:
    """Whether the blocks of a TIFF are tiles; else they are strips."""
    with open_source(source) as file:
        return TiffFile(source, file).first_directory().find(relayout.TILE_OFFSETS) is not None


def appended_directory(tiff: TiffFile, entries: Sequence[Entry]) -> bytes:
    """Bytes to append to a file: padding to an even offset, then its new main directory."""
    following = tiff.first_directory().next_offset
    padding = tiff.size % 2
    return b"\0" * padding + encode_directory(tiff.layout, entries, tiff.size + padding, following)


def new_pointer(tiff: TiffFile) -> bytes:
    """Offset of a directory that `appended_directory` made, as the header holds it."""
    return tiff.layout.offset(tiff.size + tiff.size % 2)


def fits(tiff: TiffFile, entries: Sequence[Entry]) -> bool:
    """Whether the file can hold another directory with new values behind its end."""
    end = tiff.size + tiff.size % 2 + directory_length(tiff.layout, entries)
    return tiff.layout.big or end <= CLASSIC_LIMIT


def _append(file: BinaryIO, tiff: TiffFile, entries: Sequence[Entry]) -> None:
    write_fully(file.fileno(), appended_directory(tiff, entries), tiff.size)
    write_fully(file.fileno(), new_pointer(tiff), tiff.layout.pointer_at)
