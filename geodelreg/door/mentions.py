"""Names of other files inside files: VRT, PAM, GDAL's metadata, DIMAP, TIL and HFA."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING
from xml.etree import ElementTree

from geodelreg.door.names import ALL, refuse
from geodelreg.errors import RasterUnreadableError

if TYPE_CHECKING:
    from zipfile import Path as ZipPath

    AnyFile = Path | ZipPath

_SOURCE_NAMES = ("sourcefilename", "sourcedataset", "overview_file")
_PROSE = ("srs", "metadata", "gcplist", "description", "categorynames", "colortable", "unittype")
_LARGEST_VRT_BYTES = 64_000_000
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f]")
_BASE = ":::BASE:::"
_HFA_MOST_NODES = 100_000
_HFA_MOST_BYTES = 1_000_000
_HFA_NAMING = (b"externalrasterdms", b"dependentfile", b"rrdnameslist")
_RUN = re.compile(rb"[^\0-\x1f]*[/\\][^\0-\x1f]*")
_LONGEST_RUN = 4096


@dataclass(frozen=True, slots=True)
class Mention:
    """A name in a file.

    Attributes
    ----------
    name : str
        Or a whole VRT.
    relative : bool
        To the folder of the file.
    raw : bool
        Whether bytes are read from it whatever it is.
    below : bool
        Whether it has to lie in the folder of the file.
    needed : bool
        Whether it has to exist and to be a raster.
    """

    name: str
    relative: bool = False
    raw: bool = False
    below: bool = False
    needed: bool = True


def text_of(vrt: AnyFile) -> str:
    """Text of a VRT.

    Raises
    ------
    AccessNotAllowedError
        If it is too large to be looked through.
    """
    with vrt.open("rb") as file:
        data = file.read(_LARGEST_VRT_BYTES + 1)
    if len(data) > _LARGEST_VRT_BYTES:
        raise refuse(f"{vrt} is too large to be checked ({_LARGEST_VRT_BYTES:.0e} bytes)", ALL)
    return _decoded(data)


def _decoded(data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _parsed(file: AnyFile | str, text: str) -> ElementTree.Element:
    """Root element; GDAL is more tolerant."""
    try:
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("it has a document type")
        return ElementTree.fromstring(_CONTROL.sub("", text))
    except (ElementTree.ParseError, ValueError) as error:
        raise RasterUnreadableError(
            f"{file} is no XML that can be checked ({error})",
            "Build it again; `allow='all'` leaves it to GDAL.",
        ) from error


def in_vrt(vrt: AnyFile, text: str, allow: str) -> Iterator[Mention]:
    """Whatever GDAL may open for a VRT: it tells neither case nor attributes from elements.

    Parameters
    ----------
    vrt : Path
        For messages.
    text : str
        Its own, or that of a VRT inside it.
    allow : str
        With ``all``, code is let through, and so is what is no XML.

    Raises
    ------
    RasterUnreadableError
        If it cannot be parsed.
    AccessNotAllowedError
        If it contains code.
    """
    try:
        root = _parsed(vrt, text)
    except RasterUnreadableError:
        if allow == ALL:
            return
        raise
    if allow != ALL:
        _check_code(vrt, root)
    waiting = [(root, False)]
    while waiting:
        element, raw = waiting.pop()
        values = {key.lower(): value for key, value in element.attrib.items()}
        raw = raw or values.get("subclass", "").lower() == "vrtrawrasterband"
        tag = element.tag.lower()
        content = (element.text or "").strip()
        if tag in _SOURCE_NAMES and content:
            yield Mention(content, values.get("relativetovrt") == "1", raw)
        elif tag == "mdi" and values.get("key", "").lower() in _SOURCE_NAMES and content:
            yield _overview(content)
        for key, value in (*values.items(), ("", content if len(element) == 0 else "")):
            if tag != "mdi" and value and (key in _SOURCE_NAMES or _is_address(value)):
                yield Mention(value.strip(), False, raw)
        waiting += [
            (child, raw)
            for child in element
            if child.tag.lower() not in _PROSE or _is_overview_list(child)
        ]


def _overview(name: str) -> Mention:
    is_relative = name.startswith(_BASE)
    return Mention(name.removeprefix(_BASE), is_relative, needed=False)


def _is_overview_list(element: ElementTree.Element) -> bool:
    return element.tag.lower() == "metadata" and element.get("domain", "").lower() == "overviews"


def _is_address(text: str) -> bool:
    return "://" in text or text.startswith("/vsi")


def _check_code(vrt: AnyFile, root: ElementTree.Element) -> None:
    for element in root.iter():
        values = [*element.attrib.items(), (element.tag, element.text or "")]
        for key, value in values:
            if key.lower() == "pixelfunctionlanguage" and value.strip().lower() != "c":
                raise refuse(f"{vrt} contains {value.strip()} code (a pixel function)", ALL)


def in_pam(file: AnyFile, data: bytes) -> list[Mention]:
    """Overview files that a PAM file names; where it cannot be parsed, it may name none."""
    return _overview_files(_parsed(file, _decoded(data)))


def in_metadata(file: AnyFile, data: bytes) -> list[Mention]:
    """Overview files that GDAL's metadata inside a TIFF name."""
    if b"overview" not in data.lower() and b"&#" not in data:
        return []
    return _overview_files(_parsed(f"GDAL's metadata in {file}", _decoded(data.rstrip(b"\0"))))


def _overview_files(root: ElementTree.Element) -> list[Mention]:
    """GDAL tells neither case nor attributes from elements, here too."""
    found = []
    for element in root.iter():
        values = {key.lower(): value for key, value in element.attrib.items()}
        keys = {values.get(key, "").lower() for key in ("key", "name")}
        content = (element.text or "").strip()
        if "overview_file" in (*keys, element.tag.lower()) and content:
            found.append(_overview(content))
    return found


def _in_dimap(file: AnyFile) -> list[Mention]:
    """Bands of a product, and of the products that are its parts."""
    found = []
    for element in _parsed(file, text_of(file)).iter():
        tag = element.tag.lower()
        if tag in ("data_file_path", "component_path"):
            values = [*element.attrib.items(), *((one.tag, one.text or "") for one in element)]
            names = [value.strip() for key, value in values if key.lower() == "href"]
            found += [
                Mention(name, relative=True, below=True, needed=tag == "data_file_path")
                for name in names
                if tag == "data_file_path" or name.lower().endswith(".xml")
            ]
    return found


def _in_til(file: AnyFile) -> list[Mention]:
    names = re.findall(r'filename\s*=\s*"?([^";\r\n]+)', text_of(file), re.IGNORECASE)
    return [Mention(name.strip(), relative=True, below=True) for name in names]


PRODUCTS: dict[str | None, Callable[[AnyFile], list[Mention]]] = {
    "DIMAP": _in_dimap,
    "TIL": _in_til,
}
"""Formats that name their parts in a text."""


def in_hfa(file: AnyFile, folder: Sequence[str]) -> list[Mention]:
    """Files of its folder that an HFA file names, for pixels or overviews.

    Parameters
    ----------
    file : Path or zipfile.Path
    folder : sequence of str
        Names of the files in its folder.

    Raises
    ------
    AccessNotAllowedError
        If it names any in another folder, or this cannot be told.
    """
    try:
        with file.open("rb") as opened:
            values = b"\0".join(_hfa_values(opened))
    except (struct.error, OSError, ValueError) as error:
        raise refuse(f"{file}: names of files inside cannot be checked ({error})", ALL) from error
    outside = next((path for run in _RUN.findall(values) for path in _reached(file, run)), None)
    if outside is not None:
        raise refuse(f"{file} names {outside}, which is not in its folder", ALL)
    return [
        Mention(name, relative=True, needed=False)
        for name in folder
        if name != file.name and os.fsencode(name).lower() in values.lower()
    ]


def _reached(file: AnyFile, run: bytes) -> Iterator[str]:
    """Files that a path in an HFA value reaches; where in the run it begins is not known.

    Paths of the machine that an image was made on are common, and reach nothing.
    """
    if len(run) > _LONGEST_RUN:
        raise refuse(f"{file} names a path of {len(run)} letters", ALL)
    for start in range(len(run)):
        name = os.fsdecode(run[start:]).partition("(")[0]
        if "/" not in name and "\\" not in name:
            return
        # a path that is too long is none, for `os`
        if os.path.isfile(Path(str(file.parent), name)):  # noqa: PTH113
            yield name


def _hfa_values(file: IO[bytes]) -> Iterator[bytes]:
    """Values of all nodes of an HFA tree that name files."""

    def read(offset: int, length: int) -> bytes:
        file.seek(offset)
        return file.read(length)

    (header,) = struct.unpack("<I", read(16, 4))
    waiting, seen = list(struct.unpack("<I", read(header + 8, 4))), set[int]()
    while waiting:
        place = waiting.pop()
        if not place or place in seen:
            continue
        seen.add(place)
        if len(seen) > _HFA_MOST_NODES:
            raise ValueError(f"more than {_HFA_MOST_NODES} nodes")
        after, _, _, child, value, size, name = struct.unpack("<6I64s", read(place, 88))
        waiting += [after, child]
        if name.partition(b"\0")[0].lower().startswith(_HFA_NAMING):
            yield read(value, min(size, _HFA_MOST_BYTES))
