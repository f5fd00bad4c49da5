"""The files behind a VRT.

GDAL looks for them only when pixels are read; it then says little about what is missing, and after
a VRT that contains itself it can return zeros for missing files without an error.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from geodelreg.errors import RasterNotFoundError, RasterUnreadableError
from geodelreg.image.paths import is_local

_SOURCE_TAGS = ("SourceFilename", "SourceDataset")
_LARGEST_VRT_BYTES = 64_000_000


def check_vrt_sources(path: str) -> None:
    """Make sure that the local files behind a VRT exist and that it does not contain itself.

    Raises
    ------
    RasterNotFoundError
        If a source is missing.
    RasterUnreadableError
        If the VRT is one of its own sources, directly or through others.
    """
    if is_local(path):
        _check(Path(path), (), set())


def _check(vrt: Path, parents: tuple[Path, ...], checked: set[Path]) -> None:
    here = vrt.resolve()
    if here in parents:
        raise RasterUnreadableError(
            f"{parents[0]} contains itself, through {parents[-1]}", "Build the VRT again."
        )
    if here in checked:
        return
    checked.add(here)
    for source in _local_sources(vrt):
        if not source.exists():
            raise RasterNotFoundError(
                f"{source}, a source of {vrt}, does not exist",
                "Restore it, or build the VRT again.",
            )
        if _is_vrt(source):
            _check(source, (*parents, here), checked)


def _is_vrt(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return b"<VRTDataset" in file.read(4096)


def _local_sources(vrt: Path) -> list[Path]:
    if vrt.stat().st_size > _LARGEST_VRT_BYTES:
        return []
    try:
        root = ElementTree.parse(vrt).getroot()
    except ElementTree.ParseError:
        return []  # GDAL is more tolerant
    sources = []
    for element in root.iter():
        name = (element.text or "").strip()
        if element.tag in _SOURCE_TAGS and name and not name.startswith("<") and is_local(name):
            relative = element.get("relativeToVRT", element.get("relativetoVRT")) == "1"
            sources.append(vrt.parent / name if relative else Path(name))
    return sources
