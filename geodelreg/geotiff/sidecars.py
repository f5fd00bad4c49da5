"""Files beside a raster that belong to it: PAM (``.aux.xml``), overviews, masks, world files.

A PAM file overrides the georeferencing inside a TIFF, so that a stale one undoes a correction.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from geodelreg.geotiff.copying import copy_file

if TYPE_CHECKING:
    from affine import Affine

DOMAIN = "GEODELREG"
"""Metadata domain of the GCPs; also the prefix of the provenance tags."""

PIXEL_SUFFIXES = (".ovr", ".msk", ".msk.ovr", ".ovr.msk")
"""Side files of pixels: valid beside any copy of the raster."""

UNDO_SUFFIX = ".geodelreg-undo.json"
"""Of the record of edits in place, which is about one file alone."""

_PLACEMENT_ELEMENTS = ("SRS", "GeoTransform", "GCPList")
_ESRI_DOMAIN = "xml:ESRI"
_MAX_PAM_BYTES = 64_000_000
_LONGEST_EXTENSION = 5


def beside(raster: Path, suffix: str) -> Path:
    """Side file whose name is the raster's with `suffix` added."""
    return raster.with_name(raster.name + suffix)


def pam_path(raster: Path) -> Path:
    """GDAL's PAM file of a raster."""
    return beside(raster, ".aux.xml")


def placement_sidecars(raster: Path) -> list[Path]:
    """All names, existing or not, of side files that can hold georeferencing."""
    extension = raster.suffix.lstrip(".")
    names = ["wld"]
    if extension:
        names += [extension[0] + extension[-1] + "w", extension + "w"]
    world = [raster.with_suffix("." + case) for n in names for case in (n, n.upper())]
    return [pam_path(raster), *world]


def world_files(raster: Path) -> list[Path]:
    """Existing world files of a raster."""
    found: list[Path] = []
    for path in placement_sidecars(raster)[1:]:
        # a file system that ignores case shows one file under both spellings
        if path.is_file() and not any(path.samefile(other) for other in found):
            found.append(path)
    return found


def possible_sidecars(raster: Path) -> list[Path]:
    """All names, existing or not, of files that GDAL, or `revert`, takes for a part of `raster`."""
    suffixed = [beside(raster, suffix) for suffix in (*PIXEL_SUFFIXES, UNDO_SUFFIX)]
    return [*suffixed, *placement_sidecars(raster)]


def belongs(target: Path, name: str) -> bool:
    """Whether a file of that name, beside `target`, is it or can be a part of it.

    Formats of several files name them after the stem (``x.bil``, ``x.hdr``) or the whole name;
    databases have journals (``x.gpkg-journal``).
    """
    extension = name.removeprefix(target.stem + ".")
    of_stem = name != extension and "." not in extension and len(extension) <= _LONGEST_EXTENSION
    is_plain = name not in ("", ".", "..") and "/" not in name and os.sep not in name
    return is_plain and (
        name == target.name or name.startswith((target.name + ".", target.name + "-")) or of_stem
    )


def all_sidecars(raster: Path) -> list[Path]:
    """Existing side files that GDAL, or `revert`, would take for a part of `raster`."""
    suffixed = [beside(raster, s) for s in (".aux.xml", *PIXEL_SUFFIXES, UNDO_SUFFIX)]
    return [path for path in suffixed if os.path.lexists(path)] + world_files(raster)


def stale_beside(target: Path, source: Path) -> list[Path]:
    """Side files that an earlier `target` has left, and that are not those of `source`.

    World files whose name could belong to another raster count only where `target` exists.
    """
    candidates = all_sidecars(target)
    if not target.exists():
        candidates = [path for path in candidates if path.suffix.lower() != ".wld"]
    kept = all_sidecars(source)
    return [path for path in candidates if not any(path.samefile(other) for other in kept)]


def carry(source: Path, out: Path, strip_rpc: bool) -> list[str]:
    """Copy the side files of `source` that stay valid beside a corrected copy of it.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    RasterUnreadableError
    OSError
        The copy cannot be written.
    """
    for suffix in PIXEL_SUFFIXES:
        path = beside(source, suffix)
        if path.is_file():
            copy_file(path, beside(out, suffix))
    path = pam_path(source)
    if not path.is_file():
        return []
    try:
        content = without_placement(path.read_bytes(), strip_rpc)
    except ValueError as error:
        return [f"{path} is not carried over, it is no PAM file ({error})"]
    if content is not None:
        pam_path(out).write_bytes(content)
    return []


def world_file_text(transform: Affine) -> str:
    """World file of a geotransform: it gives the centre of the upper-left pixel."""
    from geodelreg.geo.pixel import HALF_PIXEL

    x, y = transform @ (HALF_PIXEL, HALF_PIXEL)
    values = (transform.a, transform.d, transform.b, transform.e, x, y)
    return "".join(f"{value!r}\n" for value in map(float, values))


def without_placement(pam: bytes, strip_rpc: bool = False) -> bytes | None:
    """What a PAM file says apart from georeferencing and an earlier alignment.

    Parameters
    ----------
    pam : bytes
        Content of the file.
    strip_rpc : bool
        Drop RPC metadata too.

    Returns
    -------
    bytes or None
        `pam` itself when there is nothing to drop; None when nothing is left.

    Raises
    ------
    ValueError
        The file is no PAM file.
    """
    root = _parse(pam)
    dropped = [child for child in root if _places(child) or (strip_rpc and _is_rpc(child))]
    for child in dropped:
        root.remove(child)
    provenance = drop_provenance(root)
    if not dropped and not provenance:
        return pam
    return _serialise(root) if len(root) else None


def with_metadata(pam: bytes | None, domains: Mapping[str, Mapping[str, str]]) -> bytes:
    """PAM file with metadata items of the raster added; "" is the default domain."""
    root = ElementTree.Element("PAMDataset") if pam is None else _parse(pam)
    add_metadata(root, domains)
    return _serialise(root)


def srs_text(xml: bytes) -> str | None:
    """CRS of a PAM file or a VRT as it is stored; None without one.

    Raises
    ------
    ValueError
        The file is neither.
    """
    return _parse(xml, "PAMDataset", "VRTDataset").findtext("SRS")


def with_srs(pam: bytes | None, srs: ElementTree.Element) -> bytes:
    """PAM file with another CRS, an ``SRS`` element."""
    root = ElementTree.Element("PAMDataset") if pam is None else _parse(pam)
    for old in root.findall("SRS"):
        root.remove(old)
    root.insert(0, srs)
    return _serialise(root)


def add_metadata(root: ElementTree.Element, domains: Mapping[str, Mapping[str, str]]) -> None:
    """Add metadata items of the raster to the XML of a PAM file or a VRT."""
    for domain, items in sorted(domains.items()):
        parent = next((c for c in root.findall("Metadata") if c.get("domain", "") == domain), None)
        if parent is None:
            parent = ElementTree.SubElement(root, "Metadata", {"domain": domain} if domain else {})
        for key, value in sorted(items.items()):
            for old in [item for item in parent if item.get("key") == key]:
                parent.remove(old)
            ElementTree.SubElement(parent, "MDI", {"key": key}).text = value


def drop_provenance(root: ElementTree.Element) -> bool:
    """Drop what an earlier alignment has left in the XML of a PAM file or a VRT.

    Returns
    -------
    bool
        Whether there was anything.
    """
    found = False
    for parent in root.findall("Metadata"):
        domain = parent.get("domain", "")
        if domain == DOMAIN:
            root.remove(parent)
            found = True
            continue
        for item in list(parent):
            if not domain and item.get("key", "").startswith(DOMAIN + "_"):
                parent.remove(item)
                found = True
    return found


def _parse(pam: bytes, *tags: str) -> ElementTree.Element:
    if len(pam) > _MAX_PAM_BYTES or b"<!DOCTYPE" in pam or b"<!ENTITY" in pam:
        raise ValueError("too large, or with a document type")
    try:
        root = ElementTree.fromstring(pam)
    except ElementTree.ParseError as error:
        raise ValueError(str(error)) from error
    if root.tag not in (tags or ("PAMDataset",)):
        raise ValueError(f"root element {root.tag}")
    return root


def _serialise(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    text: str = ElementTree.tostring(root, encoding="unicode")
    return text.encode() + b"\n"


def _places(child: ElementTree.Element) -> bool:
    if child.tag in _PLACEMENT_ELEMENTS:
        return True
    return child.get("domain") == _ESRI_DOMAIN and child.find(".//GeodataXform") is not None


def _is_rpc(child: ElementTree.Element) -> bool:
    return child.tag == "Metadata" and child.get("domain") == "RPC"
