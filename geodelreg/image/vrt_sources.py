"""The files behind a VRT, looked at before GDAL opens it.

GDAL looks for them only when pixels are read; it then says little about what is missing, and after
a VRT that contains itself it can return zeros for missing files without an error.  A VRT can also
name addresses, bytes of any file, and Python code.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

from geodelreg.errors import RasterNotFoundError, RasterUnreadableError
from geodelreg.fatal import check_survivable
from geodelreg.image.access import ALL, LOCAL, check_name, drivers, refuse
from geodelreg.image.paths import is_local

_SOURCE_NAMES = ("sourcefilename", "sourcedataset", "overview_file")
_PROSE = ("srs", "metadata", "gcplist", "description", "categorynames", "colortable", "unittype")
_LARGEST_VRT_BYTES = 64_000_000
_DEEPEST = 20
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f]")
_IMAGE_SIGNATURES = (
    *(b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    *(b"\x89PNG", b"\xff\xd8\xff", b"\0\0\0\x0cjP"),
)


def is_vrt(path: Path) -> bool:
    """Whether GDAL would take a file for a VRT."""
    return b"<VRTDataset" in _head(path)


def check_vrt_sources(path: Path, allow: str) -> int:
    """Make sure that what is behind a VRT exists, is allowed, and does not contain the VRT.

    Parameters
    ----------
    path : Path
    allow : str
        ``local``, ``network`` or ``all``.

    Returns
    -------
    int
        Bytes of all local files together.

    Raises
    ------
    RasterNotFoundError
        If a source is missing.
    RasterUnreadableError
        If the VRT is one of its own sources, directly or through others, or no XML.
    AccessNotAllowedError
        If it names something else than local files, or runs code.
    """
    look = _Look(allow)
    look.at(path, ())
    return look.stored_bytes


@dataclass(slots=True)
class _Look:
    """What was seen so far of a VRT and those inside it."""

    allow: str
    stored_bytes: int = 0
    checked: set[Path] = field(default_factory=set)

    def at(self, vrt: Path, parents: tuple[Path, ...]) -> None:
        here = vrt.resolve()
        if here in parents:
            raise RasterUnreadableError(
                f"{parents[0]} contains itself, through {parents[-1]}", "Build the VRT again."
            )
        if len(parents) > _DEEPEST:
            raise RasterUnreadableError(
                f"{parents[0]} contains VRTs inside each other, more than {_DEEPEST} deep",
                "Build one VRT of the rasters themselves.",
            )
        if here in self.checked:
            return
        self.checked.add(here)
        text = _text(vrt, self.allow)
        if text is not None:
            self._in_text(vrt, text, (*parents, here))

    def _in_text(self, vrt: Path, text: str, parents: tuple[Path, ...]) -> None:
        root = _parsed(vrt, text, self.allow)
        if root is None:
            return
        if self.allow != ALL:
            _check_code(vrt, root)
        for item in _named(root):
            if item.text.lstrip().startswith("<"):
                if len(parents) > _DEEPEST:
                    raise RasterUnreadableError(
                        f"{vrt} contains VRTs inside each other, more than {_DEEPEST} deep",
                        "Build one VRT of the rasters themselves.",
                    )
                self._in_text(vrt, item.text, (*parents, vrt / str(len(parents))))
                continue
            check_name(item.text, self.allow, f", named in {vrt},")
            if is_local(item.text):
                self._source(vrt, item, parents)

    def _source(self, vrt: Path, item: _Named, parents: tuple[Path, ...]) -> None:
        source = vrt.parent / item.text if item.relative else Path(item.text)
        if not source.exists():
            raise RasterNotFoundError(
                f"{source}, a source of {vrt}, does not exist",
                "Restore it, or build the VRT again.",
            )
        if item.raw and self.allow != ALL and not _is_below(source, vrt.parent):
            raise refuse(f"{vrt} reads the bytes of {source}, which is not in its folder", ALL)
        check_regular(source)
        check_survivable(source)
        self.stored_bytes += source.stat().st_size
        if is_vrt(source):
            self.at(source, parents)
        elif self.allow == LOCAL and source.is_file() and not item.raw:
            _check_format(source, vrt)


@dataclass(frozen=True, slots=True)
class _Named:
    """A name in a VRT."""

    text: str
    relative: bool
    raw: bool


def _named(root: ElementTree.Element) -> Iterator[_Named]:
    """Whatever GDAL may open: GDAL tells neither case nor attributes from elements."""
    waiting = [(root, False)]
    while waiting:
        element, raw = waiting.pop()
        values = {key.lower(): value for key, value in element.attrib.items()}
        raw = raw or values.get("subclass", "").lower() == "vrtrawrasterband"
        tag = element.tag.lower()
        text = (element.text or "").strip()
        if tag in _SOURCE_NAMES and text:
            yield _Named(text, values.get("relativetovrt") == "1", raw)
        elif tag == "mdi" and values.get("key", "").lower() in _SOURCE_NAMES and text:
            yield _Named(text, False, raw)
        for key, value in (*values.items(), ("", text if len(element) == 0 else "")):
            if tag != "mdi" and value and (key in _SOURCE_NAMES or _is_address(value)):
                yield _Named(value.strip(), False, raw)
        waiting += [
            (child, raw)
            for child in element
            if child.tag.lower() not in _PROSE or _is_overview_list(child)
        ]


def _is_overview_list(element: ElementTree.Element) -> bool:
    return element.tag.lower() == "metadata" and element.get("domain", "").lower() == "overviews"


def _is_address(text: str) -> bool:
    return "://" in text or text.startswith("/vsi")


def _check_code(vrt: Path, root: ElementTree.Element) -> None:
    for element in root.iter():
        values = [*element.attrib.items(), (element.tag, element.text or "")]
        for key, value in values:
            if key.lower() == "pixelfunctionlanguage" and value.strip().lower() != "c":
                raise refuse(f"{vrt} contains {value.strip()} code (a pixel function)", ALL)


def check_regular(path: Path) -> None:
    """Refuse devices and pipes, which can be read for ever.

    Raises
    ------
    RasterUnreadableError
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise RasterUnreadableError(
            f"{path} is a device or a pipe, not a file", "Write it to a file first."
        )


def _check_format(source: Path, vrt: Path) -> None:
    """Refuse a source that is a list of addresses; common images are not looked into."""
    if _head(source).startswith(_IMAGE_SIGNATURES):
        return
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.io import DatasetReader

    try:
        with rasterio.Env():
            DatasetReader(str(source), driver=list(drivers(with_vrt=False))).close()
    except (RasterioError, OSError, ValueError, SystemError) as error:
        raise RasterUnreadableError(
            f"{source}, a source of {vrt}, is not a raster that may be opened ({error})",
            "Restore it, or build the VRT again; --allow network opens web services.",
        ) from error


def _is_below(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())


def _head(path: Path) -> bytes:
    if not path.is_file():
        return b""
    try:
        with path.open("rb") as file:
            return file.read(4096)
    except OSError:
        return b""


def _text(vrt: Path, allow: str) -> str | None:
    if vrt.stat().st_size > _LARGEST_VRT_BYTES:
        if allow == ALL:
            return None
        raise refuse(f"{vrt} is too large to be checked ({_LARGEST_VRT_BYTES:.0e} bytes)", ALL)
    data = vrt.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _parsed(vrt: Path, text: str, allow: str) -> ElementTree.Element | None:
    """Root element; GDAL is more tolerant, so None when that may be left to it."""
    try:
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("it has a document type")
        return ElementTree.fromstring(_CONTROL.sub("", text))
    except (ElementTree.ParseError, ValueError) as error:
        if allow == ALL:
            return None
        raise RasterUnreadableError(
            f"{vrt} is no XML that can be checked ({error})",
            "Build the VRT again; --allow all leaves it to GDAL.",
        ) from error
