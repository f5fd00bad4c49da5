"""Opening rasters through GDAL: looked at first, and bound to the formats that were seen."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from geodelreg.door.files import Inspection, container_of, without_side_files
from geodelreg.door.formats import BY_SIGNATURE, alone, unseen
from geodelreg.door.names import (
    ALL,
    LOCAL,
    NETWORK,
    Subdataset,
    check_name,
    gdal_name,
    is_encodable,
    is_local,
    is_there,
    needed_access,
    subdataset_of,
)
from geodelreg.errors import RasterNotFoundError, RasterUnreadableError, UsageError

if TYPE_CHECKING:
    from zipfile import Path as ZipPath

    from rasterio.io import DatasetReader

    AnyFile = Path | ZipPath

_Function = TypeVar("_Function", bound=Callable[..., Any])

_allowed: ContextVar[str] = ContextVar("allowed", default=LOCAL)
_own: ContextVar[dict[str, str]] = ContextVar("own")


@dataclass(frozen=True, slots=True)
class Entry:
    """What may be opened for a name.

    Attributes
    ----------
    name : str
        For GDAL.
    drivers : tuple of str or None
        Formats that it may be; None for all.
    with_side_files : bool
        Whether side files were looked at; if not, GDAL must not find any.
    stored_bytes : int or None
        Bytes on the disk behind a local name.
    """

    name: str
    drivers: tuple[str, ...] | None = None
    with_side_files: bool = True
    stored_bytes: int | None = None


def allowed() -> str:
    """What `open_raster` may open, as `allowing` says in this thread."""
    return _allowed.get()


@contextmanager
def allowing(allow: str) -> Iterator[None]:
    """Let `open_raster` open more than local files, in this thread.

    Raises
    ------
    UsageError
        There is no such permission.
    """
    if allow not in (LOCAL, NETWORK, ALL):
        raise UsageError(f"`allow={allow!r}` is unknown", "Use local, network or all.")
    token = _allowed.set(allow)
    try:
        yield
    finally:
        _allowed.reset(token)


def as_allowed(function: _Function) -> _Function:
    """Let a function whose first argument is an `Alignment` open what that was allowed to.

    It raises `TypeError` for anything else.
    """

    @wraps(function)
    def inside(alignment: Any, *args: Any, **kwargs: Any) -> Any:
        if not hasattr(alignment, "options"):
            raise TypeError(f"{type(alignment).__name__} is no Alignment")
        with allowing(alignment.options.allow):
            return function(alignment, *args, **kwargs)

    return cast("_Function", inside)


@contextmanager
def own_name(name: str, driver: str) -> Iterator[str]:
    """A name that the program itself has made of checked parts, and the format behind it."""
    token = _own.set({**_own.get({}), name: driver})
    try:
        yield name
    finally:
        _own.reset(token)


@contextmanager
def opened_vrt(text: str) -> Iterator[DatasetReader]:
    """A virtual raster of the program's own that is in no file, open."""
    from rasterio.io import MemoryFile

    with (
        MemoryFile(text.encode(), ext=".vrt") as memory,
        own_name(memory.name, "VRT") as name,
        open_raster(name) as dataset,
    ):
        yield dataset


def look_at(name: str, allow: str) -> Entry:
    """Look at everything behind a name, before GDAL does.

    Parameters
    ----------
    name : str
        As the user gives it.
    allow : str
        ``local``, ``network`` or ``all``.

    Raises
    ------
    RasterNotFoundError, RasterUnreadableError, AccessNotAllowedError
    """
    check_name(name, allow)
    if not is_local(name):
        name = name.removeprefix("file://")
    spoken, part = gdal_name(name), subdataset_of(name)
    if is_local(name):
        if not is_there(name):
            raise RasterNotFoundError(f"{name} does not exist", "Check the path.")
        return _of_file(Path(name), spoken, None, allow)
    if allow == ALL:
        return Entry(spoken)
    if needed_access(name) == NETWORK:
        return Entry(spoken, unseen(), with_side_files=False)
    file = container_of(name, allow)
    if file is not None:
        return _of_file(file, spoken, part, allow)
    return Entry(spoken, BY_SIGNATURE if part is None else (part.driver,), with_side_files=False)


def _of_file(file: AnyFile, name: str, part: Subdataset | None, allow: str) -> Entry:
    inspection = Inspection(allow)
    kind = inspection.raster(file)
    stored = inspection.stored_bytes if isinstance(file, Path) else None
    if allow == ALL:
        return Entry(name, stored_bytes=stored)
    if part is not None:
        return Entry(name, (part.driver,), stored_bytes=stored)
    return Entry(name, alone() if kind is None else (kind,), stored_bytes=stored)


def open_entry(entry: Entry, **options: Any) -> DatasetReader:
    """Open what `look_at` has seen; `options` are GDAL's.

    Raises
    ------
    RasterUnreadableError
        Its name is none that GDAL can be given.
    rasterio.errors.RasterioIOError
    """
    import rasterio
    from rasterio.env import hasenv
    from rasterio.io import DatasetReader

    if not is_encodable(entry.name):
        raise RasterUnreadableError(
            f"{entry.name} cannot be opened by GDAL: its name is not UTF-8", "Rename the file."
        )
    if entry.drivers is not None:
        options["driver"] = list(entry.drivers)
    if entry.with_side_files:
        with nullcontext() if hasenv() else rasterio.Env():
            return DatasetReader(entry.name, **options)
    return without_side_files(lambda: DatasetReader(entry.name, **options))


def open_raster(name: str | os.PathLike[str], **options: Any) -> DatasetReader:
    """Open a raster that `allowing` permits, or one of the program's own; `options` are GDAL's.

    Raises
    ------
    RasterNotFoundError, RasterUnreadableError, AccessNotAllowedError
    rasterio.errors.RasterioIOError
        As `rasterio.open` does.
    """
    given = os.fspath(name)
    driver = _own.get({}).get(given)
    if driver is not None:
        return open_entry(Entry(given, (driver,)), **options)
    return open_entry(look_at(given, _allowed.get()), **options)
