"""The header of a TIFF corrected where it lies, whatever the size of the file.

The edit is planned, tried on a preview and kept on record here; `undo.Edit.apply` makes it: a new
directory is appended and flushed to the disk, then the pointer to it is replaced in one write.
Killed at any moment, the file reads as before or as after.  GDAL's own edit passes through states
that cannot be read.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import BinaryIO

from geodelreg.door.opening import own_name
from geodelreg.errors import OutputUnwritableError, RasterNotFoundError, UnsafeInPlaceError
from geodelreg.geotiff import compare, metadata, relayout, sidecars, undo
from geodelreg.geotiff.atomic import exclusive, together
from geodelreg.geotiff.corrected import check_source
from geodelreg.geotiff.durable import unwritable
from geodelreg.geotiff.environment import gdal_session
from geodelreg.geotiff.header import Georeference, Provenance, corrected_entries
from geodelreg.geotiff.srs import SpatialReference, is_kept_in_pam, spatial_reference
from geodelreg.geotiff.tiffwrite import appended_directory, fits, new_pointer
from geodelreg.geotiff.undo import Edit, SidecarChange, State
from geodelreg.tiff import TiffFile, is_tiff
from geodelreg.values.points import Gcp
from geodelreg.values.result import Correction

logger = logging.getLogger(__name__)

_TO_OUT = "Write the result to another file (`write`)."


def edit_in_place(
    path: Path, correction: Correction, gcps: Sequence[Gcp], tags: Mapping[str, str]
) -> list[str]:
    """Correct the header of a TIFF without copying or touching its pixels.

    Parameters
    ----------
    path : Path
        The raster; a symbolic link is followed.
    correction : Correction
        ``corrected`` becomes its geotransform.
    gcps : sequence of Gcp
        Kept as JSON in the metadata domain ``GEODELREG``.
    tags : mapping of str to str
        Provenance, ``GEODELREG_*``.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    UnsafeInPlaceError
        No TIFF, a COG (its layout would break), or a classic TIFF at its limit of 4 GB.
    OutputUnwritableError
        The file or its folder is read-only, or the disk is full.
    FileLockedError
        Another process is writing the file.
    RasterNotFoundError, RasterUnreadableError
    """
    content = Provenance(correction, gcps, tags)
    raster = Path(os.path.realpath(path))
    check_editable(path)
    with together([raster]) as run, gdal_session(path), _opened(path, raster) as file:
        edits = _recovered(raster, file, run.lock(raster).scratch)
        check_source(raster)
        notes = []
        if edits and edits[-1].state(raster, file) is State.FOREIGN:
            notes.append(f"{path}: changed by another program since; earlier edits stay for good")
            edits = []
        edit = _planned(path, raster, file, content)
        if metadata.has_rpc(raster):
            notes.append(f"{path}: its RPCs do not know the correction; write to OUT to drop them")
        run.add_edit(raster, [*edits, edit])
    return notes


def revert(*paths: str | os.PathLike[str]) -> None:
    """Take back what `write_in_place` did: each file is bit by bit what it was before the first.

    Parameters
    ----------
    *paths : path
        Nothing is done unless it can be done to all of them.

    Raises
    ------
    UnsafeInPlaceError
        There is no record of an edit, or another program has changed a file since.
    OutputUnwritableError, FileLockedError, RasterNotFoundError
    """
    with ExitStack() as stack:
        waiting = []
        for path in dict.fromkeys(map(Path, paths)):
            raster = Path(os.path.realpath(path))
            check_editable(path)
            folder = stack.enter_context(exclusive(raster))
            file = stack.enter_context(_opened(path, raster))
            waiting.append((raster, file, folder.scratch, _revertible(path, raster, file)))
        for raster, file, scratch, edits in waiting:
            while edits:
                edits[-1].undo(raster, file, scratch)
                edits.pop()
                undo.save(raster, edits, scratch)


def _revertible(path: Path, raster: Path, file: BinaryIO) -> list[Edit]:
    edits = undo.load(raster)
    if not edits:
        raise UnsafeInPlaceError(
            f"{path} has no record of an edit in place",
            f"The record would be {undo.record_path(raster).name} in the same folder.",
        )
    following = [*edits[1:], None]
    states = [one.state(raster, file, two) for one, two in zip(edits, following, strict=True)]
    if State.FOREIGN in states:
        raise UnsafeInPlaceError(
            f"{path} was changed by another program after its header was edited",
            "Taking the edit back would lose those changes; use a backup.",
        )
    return edits


def check_editable(path: Path) -> None:
    """Refuse a file that is no TIFF or cannot be written.

    Raises
    ------
    UnsafeInPlaceError, OutputUnwritableError, RasterNotFoundError
    """
    if not path.is_file():
        raise RasterNotFoundError(f"{path} does not exist", "Check the name.")
    if not is_tiff(path):
        raise UnsafeInPlaceError(f"{path} is no TIFF, its header cannot be edited", _TO_OUT)
    if not os.access(path, os.W_OK):
        raise OutputUnwritableError(
            f"{path} cannot be written: the file is read-only", "Change its permissions."
        )


@contextmanager
def _opened(path: Path, raster: Path) -> Iterator[BinaryIO]:
    """Open a raster whose lock is held, for an edit."""
    try:
        with raster.open("r+b", buffering=0) as file:
            yield file
    except OSError as error:
        raise unwritable(path, error) from error


def _recovered(raster: Path, file: BinaryIO, scratch: Path) -> list[Edit]:
    """Edits on record, after taking back one that shows only in part: a backup was put back."""
    edits = undo.load(raster)
    if edits and edits[-1].state(raster, file) in (State.NONE, State.STARTED):
        logger.warning("%s: taking back an edit that was interrupted", raster)
        edits[-1].undo(raster, file, scratch)
        edits.pop()
        undo.save(raster, edits, scratch)
    return edits


def _planned(path: Path, raster: Path, file: BinaryIO, content: Provenance) -> Edit:
    tiff = TiffFile(raster, file)
    structure = relayout.Structure.read(tiff)
    relayout.check_complete(tiff, structure)
    if structure.is_cog(tiff):
        raise UnsafeInPlaceError(
            f"{path} is a cloud optimised GeoTIFF, an edit in place would break its layout", _TO_OUT
        )
    georeference = Georeference.read(raster)
    entries = corrected_entries(tiff, structure.directories[0], georeference, content)
    if not fits(tiff, entries):
        raise UnsafeInPlaceError(
            f"{path} is a classic TIFF at its limit of 4 GB, nothing can be appended", _TO_OUT
        )
    edit = Edit(
        tiff.size,
        tiff.layout.pointer_at,
        tiff.layout.offset(tiff.first_offset),
        new_pointer(tiff),
        appended_directory(tiff, entries),
    )
    reference = georeference.reference_with_sidecars
    with _preview(raster, edit, tiff.layout.header_bytes) as name:
        compare.check_placement(name, path, content)
        if reference is not None and reference.is_same(spatial_reference(name)):
            reference = None
    if reference is not None and not is_kept_in_pam(reference):
        raise UnsafeInPlaceError(
            f"{path} would lose its coordinate reference system {reference.name}", _TO_OUT
        )
    return replace(edit, sidecars=_sidecar_changes(path, raster, content, reference))


def _sidecar_changes(
    path: Path, raster: Path, content: Provenance, reference: SpatialReference | None
) -> tuple[SidecarChange, ...]:
    """Side files that would contradict the new header: PAM overrides it, world files go stale.

    PAM keeps the spatial reference that has no place inside, if any.
    """
    changes = []
    pam = sidecars.pam_path(raster)
    before = pam.read_bytes() if pam.is_file() else None
    try:
        after = None if before is None else sidecars.without_placement(before)
        if reference is not None:
            after = sidecars.with_srs(after, reference.element())
    except ValueError as error:
        raise UnsafeInPlaceError(
            f"{pam} may override the header of {path.name}, and is no PAM file ({error})",
            "Remove or repair it.",
        ) from error
    if after != before:
        changes.append(SidecarChange(pam.name, before, after))
    text = sidecars.world_file_text(content.correction.corrected).encode()
    worlds = [(path, path.read_bytes()) for path in sidecars.world_files(raster)]
    changes += [SidecarChange(path.name, old, text) for path, old in worlds if old != text]
    return tuple(changes)


@contextmanager
def _preview(raster: Path, edit: Edit, header_bytes: int) -> Iterator[str]:
    """Yield a name under which GDAL reads the file as it will be."""
    from rasterio.io import MemoryFile

    with raster.open("rb") as file:
        header = file.read(header_bytes)
    header = header[: edit.pointer_at] + edit.new_pointer
    with MemoryFile(header) as start, MemoryFile(edit.tail) as end:
        parts = [
            (start.name, 0, 0, header_bytes),
            (str(raster), header_bytes, header_bytes, edit.size - header_bytes),
            (end.name, edit.size, 0, len(edit.tail)),
        ]
        xml = f"<VSISparseFile><Length>{edit.size + len(edit.tail)}</Length>"
        for name, place, offset, length in parts:
            xml += (
                f"<SubfileRegion><Filename>{escape(name)}</Filename>"
                f"<DestinationOffset>{place}</DestinationOffset>"
                f"<SourceOffset>{offset}</SourceOffset><RegionLength>{length}</RegionLength>"
                "</SubfileRegion>"
            )
        xml += "</VSISparseFile>"
        with (
            MemoryFile(os.fsencode(xml), ext=".xml") as description,
            own_name(f"/vsisparse/{description.name}", "GTiff") as preview,
        ):
            yield preview
