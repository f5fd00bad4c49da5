"""The files behind the names of inputs: they are read, so nothing may be written to them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from geodelreg.errors import GeodelregError
from geodelreg.image.access import LOCAL
from geodelreg.image.environment import gdal_calls
from geodelreg.image.opening import open_dataset
from geodelreg.image.paths import is_local
from geodelreg.tiff import is_tiff

_WITH_A_VECTOR = {
    ".shp": (".shx", ".dbf", ".prj", ".cpg", ".qpj", ".sbn", ".sbx", ".qix"),
    ".gml": (".xsd", ".gfs"),
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
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        path = _file_of(name)
        if path in found:
            continue
        if path is not None:
            found[path] = None
            for suffix in _WITH_A_VECTOR.get(path.suffix.lower(), ()):
                found[path.with_suffix(suffix)] = None
        with suppress(GeodelregError, OSError), open_dataset(name, allow=allow) as dataset:
            with gdal_calls():
                files = dataset.files
            # of sources, a TIFF has no files but its side files, which are known by name
            parts = [file for file in files if file != name]
            waiting += [file for file in parts if not (is_local(file) and is_tiff(Path(file)))]
            found |= dict.fromkeys(part for part in map(_file_of, parts) if part is not None)
    return list(found)


def _file_of(name: str) -> Path | None:
    """Local file that holds what GDAL calls `name`: itself, or the archive around it."""
    if is_local(name):
        return Path(name)
    inner = re.sub(r"^(/vsi\w+/|\w+(\+\w+)*://|\w+:)+", "", name).strip('{"')
    candidates = [Path(inner.split("!")[0].split('"')[0]), *Path(inner).parents]
    return next((path for path in candidates if path.is_file()), None)
