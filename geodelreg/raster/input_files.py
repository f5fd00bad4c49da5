"""The files behind the names of inputs: they are read, so nothing may be written to them."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from geodelreg.door.names import LOCAL, is_local
from geodelreg.door.vectors import is_vector
from geodelreg.errors import GeodelregError
from geodelreg.raster.environment import gdal_calls
from geodelreg.raster.opening import open_dataset
from geodelreg.tiff import is_tiff

_WITH_A_VECTOR = {
    ".shp": (".shx", ".dbf", ".prj", ".cpg", ".qpj", ".sbn", ".sbx", ".qix"),
    ".gml": (".xsd", ".gfs"),
    ".tab": (".dat", ".map", ".id", ".ind"),
    ".mif": (".mid",),
}


def input_files(names: Iterable[str], allow: str = LOCAL) -> list[Path]:
    """Local files that the rasters and vectors of some names consist of.

    Parameters
    ----------
    names : iterable of str
        As the user gives them.  What cannot be opened stands for itself.
    allow : str
        What may be opened, `AlignOptions.allow`.

    Returns
    -------
    list of Path
        Also the sources inside VRTs, archives, and the side files that GDAL has found.
    """
    found: dict[Path, None] = {}
    waiting, seen = deque(names), set[str]()
    given = set(waiting)
    while waiting:
        name = waiting.popleft()
        if name in seen:
            continue
        seen.add(name)
        path = _file_of(name)
        if path is not None:
            found[path] = None
            others = _WITH_A_VECTOR.get(path.suffix.lower(), ())
            found |= dict.fromkeys(path.with_suffix(suffix) for suffix in others)
        if is_vector(name) or (path is not None and name not in given and is_tiff(path)):
            continue  # what more belongs to a TIFF, here the source of a VRT, is known by name
        parts: list[str] = []
        with suppress(GeodelregError), open_dataset(name, allow=allow) as dataset, gdal_calls():
            parts = [part for part in dataset.files if part != name]
            if dataset.driver == "VRT":  # side files are not opened as rasters
                waiting += [part for part in parts if not part.startswith(name)]
        found |= dict.fromkeys(path for path in map(_file_of, parts) if path is not None)
    return list(found)


def _file_of(name: str) -> Path | None:
    """Local file that holds what GDAL calls `name`: itself, or the archive around it."""
    if is_local(name):
        return Path(name)
    inner = re.sub(r"^(/vsi\w+/|\w+(\+\w+)*://|\w+:)+", "", name).strip('{"')
    candidates = [Path(inner.split("!")[0].split('"')[0]), *Path(inner).parents]
    return next((path for path in candidates if path.is_file()), None)
