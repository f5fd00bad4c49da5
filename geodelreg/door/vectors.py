"""Vector files, looked at before OGR opens them: it chooses the format by content, too."""

from __future__ import annotations

import re
from pathlib import Path, PurePath
from types import ModuleType
from typing import TYPE_CHECKING, cast

from geodelreg.door.files import check_regular
from geodelreg.door.names import ALL, NETWORK, check_name, in_zip, is_local, needed_access, refuse
from geodelreg.errors import MissingExtraError, RasterUnreadableError

if TYPE_CHECKING:
    from zipfile import Path as ZipPath

    AnyFile = Path | ZipPath

_HEAD_BYTES = 65_536
_SQLITE = rb"SQLite format 3\0"
_BEGINNINGS = {
    ".fgb": rb"fgb\x03",
    ".gml": rb"(?=.{,4000}opengis\.net/gml)",
    ".gpkg": _SQLITE,
    ".kml": rb"(?=.{,4000}<(?:\w+:)?kml[\s>])",
    ".kmz": rb"PK\x03\x04",
    ".mif": rb"\s*(?i:version)\s",
    ".shp": rb"\0\0\x27\x0a",
    ".sqlite": _SQLITE,
    ".tab": rb"\s*!(?i:table)",
    ".zip": rb"PK\x03\x04",
}
"""How a file with this extension must begin."""

# services and virtual layers that OGR takes XML and JSON for, and tables made of other tables
_REACHING = re.compile(
    rb"OGR\w*DataSource|Capabilities|gdal_streamed_alg|(?i:open\s+table|IsSeamless)"
)
_TEXTS = {".gml", ".kml", ".mif", ".tab"}
_SHAPEFILE_PARTS = {
    ".atx", ".cpg", ".dbf", ".idm", ".ind", ".prj", ".qix", ".qpj", ".sbn", ".sbx", ".shx",
}  # fmt: skip
_ARCHIVES = {".kmz", ".zip"}
_NO_GEOMETRY = {".gif", ".htm", ".html", ".jpeg", ".jpg", ".md", ".png", ".txt", ".xml", ""}

EXTENSIONS = frozenset(_BEGINNINGS)
"""Of the files that OGR may open."""

GEOJSON, GEOJSON_LINES = {".geojson", ".json"}, {".geojsonl", ".geojsons"}
"""Of the files that need no OGR."""


def is_vector(name: str) -> bool:
    """Whether a file's name is that of a vector file."""
    return PurePath(name).suffix.lower() in GEOJSON | GEOJSON_LINES | EXTENSIONS


def ogr(what: str, instead: str = ".") -> ModuleType:
    """``pyogrio``, with its ``raw``.

    Parameters
    ----------
    what : str
        Needs it, for the message.
    instead : str
        What else could be done, to end the remedy.

    Raises
    ------
    MissingExtraError
    """
    try:
        import pyogrio
        import pyogrio.raw
    except ImportError as error:
        remedy = "Install it: pip install pyogrio (in a clone: pip install '.[vector]')"
        raise MissingExtraError(what, remedy + instead) from error
    return cast("ModuleType", pyogrio)


def check_vector(name: str, allow: str) -> None:
    """Make sure that OGR can take a file only for what its extension says.

    Parameters
    ----------
    name : str
        As the user gives it, with one of `EXTENSIONS`.
    allow : str
        ``local``, ``network`` or ``all``.

    Raises
    ------
    AccessNotAllowedError
        If it could be taken for a format that names others.
    RasterUnreadableError
        If it does not begin as its extension says, or is a device, a pipe, or a damaged archive.
    """
    check_name(name, allow)
    if allow == ALL or (not is_local(name) and needed_access(name) == NETWORK):
        return
    inside = None if is_local(name) else in_zip(name)
    if inside is None and not is_local(name):
        raise refuse(f"{name} cannot be looked at before it is opened", ALL)
    file = inside or Path(name)
    check_regular(file)
    _check(file)
    suffix = PurePath(name).suffix.lower()
    packed = in_zip(f"zip://{name}!") if is_local(name) and suffix in _ARCHIVES else None
    for member in [] if packed is None else _members(packed):
        kind = PurePath(member.name).suffix.lower()
        if kind in _BEGINNINGS and kind not in _ARCHIVES:
            _check(member)
        elif kind not in _SHAPEFILE_PARTS | _NO_GEOMETRY:
            raise refuse(f"{member} is of a format that is not opened inside an archive", ALL)


def _members(folder: ZipPath) -> list[ZipPath]:
    found: list[ZipPath] = []
    for one in folder.iterdir():
        found += _members(one) if one.is_dir() else [one]
    return found


def _check(file: AnyFile) -> None:
    suffix = PurePath(file.name).suffix.lower()
    with file.open("rb") as opened:
        head = opened.read(_HEAD_BYTES)
    text = head.removeprefix(b"\xef\xbb\xbf")
    if suffix in _TEXTS and (found := _REACHING.search(text)) is not None:
        what = found[0].decode(errors="replace")
        raise refuse(f"{file} holds {what!r} and could make OGR open other data", ALL)
    if not re.match(_BEGINNINGS[suffix], text, re.DOTALL):
        raise RasterUnreadableError(
            f"{file} does not begin as files with the ending {suffix} do", "Name another file."
        )
