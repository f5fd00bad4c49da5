"""The files behind a raster, looked at before GDAL opens it: sources, side files, their names.

GDAL opens masks, overviews and the sources of a VRT by content, with every format that it has, and
only when pixels are read; it then says little about what is missing, and after a VRT that contains
itself it can return zeros for missing files without an error.
"""

from __future__ import annotations

import os
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, cast

from geodelreg.door import mentions
from geodelreg.door.formats import BY_SIGNATURE, HEAD_BYTES, alone, format_of, is_markup, needed_for
from geodelreg.door.mentions import Mention
from geodelreg.door.names import (
    ALL,
    LOCAL,
    NETWORK,
    check_name,
    in_zip,
    is_special,
    needed_access,
    refuse,
    subdataset_of,
)
from geodelreg.errors import RasterNotFoundError, RasterUnreadableError
from geodelreg.fatal import check_survivable
from geodelreg.tiff import TiffFile

if TYPE_CHECKING:
    from zipfile import Path as ZipPath

    from rasterio.io import DatasetReader

    AnyFile = Path | ZipPath

_DEEPEST = 20
_SIDE_RASTERS = (".msk", ".ovr")
_HFA_SIDES = (".aux", ".rrd")
_PAM = ".aux.xml"
_GDAL_METADATA = 42112
_SETTLED_NS = 2_000_000_000
"""A folder that changed more recently may change again without another time of change."""


@dataclass(slots=True)
class Inspection:
    """What was seen of the files behind one name.

    Attributes
    ----------
    allow : str
        With ``all``, only what is missing or contains itself is refused.
    stored_bytes : int
        Of all files together, side files apart.
    """

    allow: str
    stored_bytes: int = 0
    _checked: dict[str, str | None] = field(default_factory=dict)
    _folders: dict[str, list[str]] = field(default_factory=dict)

    def raster(self, file: AnyFile, parents: tuple[str, ...] = ()) -> str | None:
        """Look at a file, at those it names, and at those beside it.

        Parameters
        ----------
        file : Path or zipfile.Path
            It exists.
        parents : tuple of str
            Files that led here, outermost first.

        Returns
        -------
        str or None
            The format, None for one that has no signature and reaches nothing else.

        Raises
        ------
        RasterNotFoundError
            If a file that is named is missing.
        RasterUnreadableError
            If a file contains itself, directly or through others, or cannot be looked at.
        AccessNotAllowedError
            If it is of a format that needs more, or names more than local files, or runs code.
        """
        here = os.path.realpath(file) if isinstance(file, Path) else str(file)
        if here in parents:
            raise RasterUnreadableError(
                f"{parents[0]} contains itself, through {parents[-1]}", "Build the VRT again."
            )
        _check_depth(parents)
        if here in self._checked:
            return self._checked[here]
        check_regular(file)
        if isinstance(file, Path):
            check_survivable(file)
        head = _head(file)
        kind = format_of(head)
        self._check_kind(file, kind, head)
        self._checked[here] = kind
        self._named(file, kind, (*parents, here))
        if self.allow != ALL:
            self._beside(file, (*parents, here))
        return kind

    def _check_kind(self, file: AnyFile, kind: str | None, head: bytes) -> None:
        if self.allow == ALL:
            return
        if kind is None and is_markup(head):
            raise RasterUnreadableError(
                f"{file} is not a raster that GDAL can open: it is a text, XML or the like",
                "Give a GeoTIFF or another raster format that gdalinfo reads; `allow='all'` opens "
                "those that are XML.",
            )
        needed = LOCAL if kind is None else needed_for(kind)
        if needed not in (LOCAL, self.allow):
            raise refuse(f"{file} is a file of the format {kind}, which can open others", needed)

    def _named(self, file: AnyFile, kind: str | None, parents: tuple[str, ...]) -> None:
        """Whatever the file itself names."""
        if kind == "VRT":
            if not isinstance(file, Path):
                raise RasterUnreadableError(
                    f"{file} cannot be opened: a VRT inside an archive", "Unpack the archive first."
                )
            self._in_vrt(file, mentions.text_of(file), parents)
            return
        self.stored_bytes += file.stat().st_size if isinstance(file, Path) else 0
        if self.allow == ALL:
            return
        if kind in mentions.PRODUCTS:
            self._check(file, mentions.PRODUCTS[kind](file), parents)
        elif kind == "HFA":
            self._check(file, mentions.in_hfa(file, self._listed(file)), parents)
        elif kind == "GTiff" and (text := _own_metadata(file)):
            self._check(file, mentions.in_metadata(file, text), parents)

    def _in_vrt(self, vrt: AnyFile, text: str, parents: tuple[str, ...]) -> None:
        for item in mentions.in_vrt(vrt, text, self.allow):
            if item.name.lstrip().startswith("<"):
                _check_depth(parents)
                self._in_vrt(vrt, item.name, (*parents, f"{vrt}/{len(parents)}"))
            else:
                self._check(vrt, [item], parents)

    def _check(self, file: AnyFile, items: list[Mention], parents: tuple[str, ...]) -> None:
        for item in items:
            if not _is_joined(item):
                check_name(item.name, self.allow, f", named in {file},")
                if is_special(item.name):
                    self._special(file, item, parents)
                    continue
            source = _folder(file) / item.name if item.relative else Path(item.name)
            if not source.exists():
                if not item.needed:
                    continue
                raise RasterNotFoundError(
                    f"{source}, a source of {file}, does not exist",
                    "Restore it, or build the VRT again.",
                )
            confined = (item.raw or item.below) and self.allow != ALL
            if confined and not _is_below(source, _folder(file)):
                what = "reads the bytes of" if item.raw else "names"
                raise refuse(f"{file} {what} {source}, which is not in its folder", ALL)
            if item.raw:
                check_regular(source)
                self.stored_bytes += source.stat().st_size if isinstance(source, Path) else 0
            elif self.raster(source, parents) is None and item.needed and self.allow != ALL:
                _check_opens(source, file)

    def _special(self, file: AnyFile, item: Mention, parents: tuple[str, ...]) -> None:
        """A name that is no path: of a subdataset, inside an archive, or on the network."""
        if self.allow == ALL:
            return
        if needed_access(item.name) == NETWORK:
            _check_remote(item.name, file)
            return
        folder = _folder(file) if item.relative else Path()
        container = container_of(item.name, self.allow, folder)
        if container is None:
            raise refuse(f"{item.name}, named in {file}, cannot be looked at", ALL)
        self.raster(container, parents)

    def _beside(self, file: AnyFile, parents: tuple[str, ...]) -> None:
        """Side files, which GDAL finds by name."""
        stem = file.name.rpartition(".")[0]
        for name in self._names_beside(file, file.name):
            suffix = name[len(file.name) :].lower()
            side = _folder(file) / name
            if suffix == _PAM:
                check_regular(side)
                data = side.read_bytes()
                if b"overview" in data.lower() or b"&#" in data:
                    self._check(side, mentions.in_pam(side, data), parents)
            elif suffix in _SIDE_RASTERS:
                self.raster(side, parents)
            elif suffix in _HFA_SIDES:
                self._hfa_side(side, parents)
        for name in self._names_beside(file, stem) if stem else ():
            if name[len(stem) :].lower() in _HFA_SIDES:
                self._hfa_side(_folder(file) / name, parents)

    def _hfa_side(self, side: AnyFile, parents: tuple[str, ...]) -> None:
        check_regular(side)
        if format_of(_head(side)) == "HFA":
            self.raster(side, parents)

    def _names_beside(self, file: AnyFile, beginning: str) -> list[str]:
        """Names in the folder that begin so, whatever their case, and go on with a dot."""
        names, wanted = self._listed(file), _folded(f"{beginning}.")
        first = bisect_left(names, wanted, key=_folded)
        same = takewhile(lambda name: _folded(name).startswith(wanted), islice(names, first, None))
        return list(same)

    def _listed(self, file: AnyFile) -> list[str]:
        """Names in the folder of a file, sorted by `_folded`."""
        folder = str(file.parent)
        if folder not in self._folders:
            self._folders[folder] = _names_in(_folder(file))
        return self._folders[folder]


def _names_in(folder: AnyFile) -> list[str]:
    if not isinstance(folder, Path):
        return sorted((one.name for one in folder.iterdir()), key=_folded)
    try:
        changed_ns = folder.stat().st_mtime_ns
        settled = time.time_ns() - changed_ns > _SETTLED_NS
        listing = _names_at if settled else _names_at.__wrapped__
        return listing(folder.resolve(), changed_ns)
    except PermissionError as error:
        raise RasterUnreadableError(
            f"{folder} cannot be listed, and side files in it would be opened unseen",
            "Let yourself read the folder, or copy the raster elsewhere.",
        ) from error


@lru_cache(maxsize=16)
def _names_at(folder: Path, changed_ns: int) -> list[str]:
    """Names in a folder as it was then: a run opens many files of a few folders."""
    return sorted((one.name for one in folder.iterdir()), key=_folded)


def _folder(file: AnyFile) -> AnyFile:
    return cast("AnyFile", file.parent)


def _folded(name: str) -> bytes:
    """Name as GDAL compares names, letters of ASCII alone being equal to their capitals."""
    return os.fsencode(name).lower()


def container_of(name: str, allow: str, folder: AnyFile | None = None) -> AnyFile | None:
    """File that holds a subdataset or lies in a ZIP archive; None if it is not to be looked at.

    `folder` is what the name of the container is relative to; the current one when not given.

    Raises
    ------
    RasterNotFoundError, AccessNotAllowedError, RasterUnreadableError
    """
    part = subdataset_of(name)
    if part is not None and needed_for(part.driver) not in (LOCAL, allow):
        raise refuse(
            f"{name} is a file of the format {part.driver}, which can open others",
            needed_for(part.driver),
        )
    container = name if part is None else part.container
    inside = in_zip(container)
    if inside is not None or not is_special(container):
        file = inside or (folder or Path()) / container
        if not file.exists():
            raise RasterNotFoundError(f"{container} does not exist", "Check the name.")
        return file
    return None


def check_regular(path: AnyFile) -> None:
    """Refuse devices and pipes, which can be read for ever, and folders.

    Raises
    ------
    RasterUnreadableError
    """
    if path.is_dir():
        raise RasterUnreadableError(
            f"{path} is a folder", "Name a raster file, or one file per band."
        )
    if path.exists() and not path.is_file():
        raise RasterUnreadableError(
            f"{path} is a device or a pipe, not a file", "Write it to a file first."
        )


def _is_joined(item: Mention) -> bool:
    """Whether GDAL puts the folder before a name, whatever it looks like."""
    keeps = item.name.startswith(("/", "\\")) or "://" in item.name
    return item.relative and not keeps and subdataset_of(item.name) is None


def _check_depth(parents: tuple[str, ...]) -> None:
    if len(parents) > _DEEPEST:
        raise RasterUnreadableError(
            f"{parents[0]} contains VRTs inside each other, more than {_DEEPEST} deep",
            "Build one VRT of the rasters themselves.",
        )


def _check_opens(source: AnyFile, parent: AnyFile) -> None:
    """Refuse a source that GDAL could only open in a format that needs more."""
    import rasterio
    from rasterio.io import DatasetReader

    with _source(source, parent, "Restore it, or build the VRT again."), rasterio.Env():
        DatasetReader(str(source), driver=list(alone())).close()


def _check_remote(name: str, parent: AnyFile) -> None:
    """Refuse a source on the network that GDAL would not open as one of `BY_SIGNATURE`."""
    from rasterio.io import DatasetReader

    with _source(name, parent, "Check the address and the access to it, or build the VRT again."):
        without_side_files(lambda: DatasetReader(name, driver=list(BY_SIGNATURE))).close()


@contextmanager
def _source(name: AnyFile | str, parent: AnyFile, remedy: str) -> Iterator[None]:
    """Opening of a source, with its errors in words."""
    from rasterio.errors import RasterioError

    try:
        yield
    except (RasterioError, OSError, ValueError, SystemError) as error:
        raise RasterUnreadableError(
            f"{name}, a source of {parent}, is not a raster that may be opened ({error})", remedy
        ) from error


def without_side_files(opening: Callable[[], DatasetReader]) -> DatasetReader:
    """Open with a setting that, on a thread of its own, no other thread of the process sees."""
    import rasterio

    def run() -> DatasetReader:
        with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"):
            return opening()

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(run).result()


def _is_below(path: AnyFile, folder: AnyFile) -> bool:
    if isinstance(path, Path) and isinstance(folder, Path):
        return path.resolve().is_relative_to(folder.resolve())
    return not os.path.normpath(str(path)).startswith("..") and ".." not in str(path).split("/")


def _head(file: AnyFile) -> bytes:
    with suppress(OSError), file.open("rb") as opened:
        return bytes(opened.read(HEAD_BYTES))
    return b""


def _own_metadata(file: AnyFile) -> bytes:
    """GDAL's metadata inside a TIFF; empty where it cannot be read."""
    if not isinstance(file, Path):
        return b""  # archives: looked at once the file is open
    with suppress(OSError, RasterUnreadableError), file.open("rb", buffering=0) as opened:
        tiff = TiffFile(file, opened)
        entries = tiff.entries(tiff.first_offset)
        return tiff.value(next((one for one in entries if one.tag == _GDAL_METADATA), None))
    return b""
