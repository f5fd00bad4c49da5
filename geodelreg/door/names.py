"""What the name of a raster may make GDAL open: local files, unless the user allows more.

Names may come from a list that someone else has written, and so may the files.  GDAL would fetch
addresses, query databases and read the memory of the process for a name that asks for it.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from geodelreg.errors import AccessNotAllowedError, RasterUnreadableError

if TYPE_CHECKING:
    from zipfile import Path as ZipPath

LOCAL, NETWORK, ALL = "local", "network", "all"

_LOCAL_HANDLERS = {"vsizip", "vsitar", "vsigzip", "vsi7z", "vsirar", "vsisubfile", "vsimem"}
_OTHER_HANDLERS = {"vsistdin", "vsistdout", "vsistdout_redirect", "vsihdfs"}
_LOCAL_SCHEMES = {"file", "zip", "tar", "gzip"}
_OTHER_SCHEMES = {"vrt", "gdal", "derived"}
_CONTAINERS = {
    "BAG": "BAG", "ESRIC": "ESRIC", "GPKG": "GPKG", "GTIFF_DIR": "GTiff", "HDF4_EOS": "HDF4Image",
    "HDF4_GR": "HDF4Image", "HDF4_SDS": "HDF4Image", "HDF5": "HDF5Image", "ISIS3": "ISIS3",
    "MVT": "MVT", "NETCDF": "netCDF", "NITF_IM": "NITF", "PDF": "PDF", "PDF_IMAGE": "PDF",
    "PDS4": "PDS4", "RADARSAT_2_CALIB": "RS2", "S102": "S102", "S104": "S104", "S111": "S111",
    "SENTINEL1_CALIB": "SAFE", "SENTINEL1_DS": "SAFE", "SENTINEL2_L1B": "SENTINEL2",
    "SENTINEL2_L1B_WITH_GEOLOC": "SENTINEL2", "SENTINEL2_L1C": "SENTINEL2",
    "SENTINEL2_L1C_TILE": "SENTINEL2", "SENTINEL2_L2A": "SENTINEL2", "TSX": "TSX",
    "VICAR": "VICAR", "ZARR": "Zarr",
}  # fmt: skip
_WEB_SERVICES = re.compile(
    r"(WMS|WCS|WMTS|EEDA|EEDAI|PLMOSAIC|PLSCENES|STACTA|STACIT|HTTP|NGW|OAPIF\w*|OGCAPI|DAAS):",
    re.IGNORECASE,
)
_SCHEMES = re.compile(r"(?:^|[\"/:,{ ])([A-Za-z][\w+-]*)://")
_ZIP = re.compile(r"(?:/vsizip/|zip://)(.*)", re.DOTALL)


def refuse(what: str, allow: str) -> AccessNotAllowedError:
    """Error for something that needs another `allow`."""
    return AccessNotAllowedError(
        what, f"If you trust where the name or the file comes from, add `allow={allow!r}`."
    )


def is_local(name: str) -> bool:
    """Whether a name that the user gave is a file's, even if GDAL would read it otherwise."""
    return not name.startswith("/vsi") and (is_there(name) or not is_special(name))


def is_there(name: str) -> bool:
    """Whether a file or folder of the disk has a name, however odd."""
    return os.path.exists(name)  # noqa: PTH110 - that of Path raises for names that are too long


def is_encodable(name: str) -> bool:
    """Whether GDAL can be given a name: rasterio passes names on as UTF-8."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def is_special(name: str) -> bool:
    """Whether GDAL takes a name for a URL, a ``/vsi…`` path or a subdataset, by its looks."""
    return name.startswith("/vsi") or "://" in name or re.match(r"[^/\\:]{2,}:", name) is not None


def gdal_name(name: str) -> str:
    """Name under which GDAL and rasterio open what the user has named."""
    if is_local(name):
        return os.path.join(".", name) if is_special(name) else name  # noqa: PTH118
    inside = in_zip(name)
    if inside is not None and "}" not in str(inside.root.filename):
        return f"/vsizip/{{{inside.root.filename}}}/{inside.at}"  # as it was understood here
    prefix, colon, rest = name.partition(":")
    # rasterio lists subdatasets in lower case
    return prefix.upper() + colon + rest if prefix.upper() in _CONTAINERS else name


def as_path(name: str) -> Path:
    """Path that stays GDAL's name: braces keep the two slashes after ``/vsizip`` from becoming one.

    Parameters
    ----------
    name : str
        As the user gives it.
    """
    inside = re.search(r"/vsizip/(/[^:\"]*)", name)
    if is_local(name) or inside is None:
        return Path(name)
    archive, rest = _split(inside[1])
    return Path(name.replace(inside[0], f"/vsizip/{{{archive}}}{rest}")) if archive else Path(name)


def check_name(name: str, allow: str, where: str = "") -> None:
    """Refuse a name that reaches further than the user allows.

    Parameters
    ----------
    name : str
        Of a raster, as the user or a VRT gives it.
    allow : str
        ``local``, ``network`` or ``all``.
    where : str
        What names it, for the message; a user's own name may look special and yet be a file's.

    Raises
    ------
    AccessNotAllowedError
    """
    needed = LOCAL if not where and is_local(name) else needed_access(name)
    if allow != ALL and needed not in (LOCAL, allow):
        what = "is on the network" if needed == NETWORK else "is no file of this machine"
        raise refuse(f"{name}{where} {what}, and only local files may be opened", needed)


def needed_access(name: str) -> str:
    """Least value of `allow` under which GDAL may be given a name."""
    if not is_special(name):
        return LOCAL
    handlers = set(re.findall(r"/(vsi\w+)", name))
    schemes = {one for word in _SCHEMES.findall(name) for one in word.split("+")}
    if handlers & _OTHER_HANDLERS or schemes & _OTHER_SCHEMES:
        return ALL
    if handlers - _LOCAL_HANDLERS or schemes - _LOCAL_SCHEMES or _WEB_SERVICES.match(name):
        return NETWORK
    if handlers or schemes or name.partition(":")[0].upper() in _CONTAINERS:
        return LOCAL
    return ALL


@dataclass(frozen=True, slots=True)
class Subdataset:
    """A raster inside a container, e.g. ``NETCDF:"a.nc":v``.

    Attributes
    ----------
    driver : str
        GDAL's format of the container.
    container : str
        Name of the container.
    """

    driver: str
    container: str


def subdataset_of(name: str) -> Subdataset | None:
    """Take a subdataset's name apart; None for other names."""
    prefix, colon, rest = name.partition(":")
    driver = _CONTAINERS.get(prefix.upper())
    if not colon or driver is None or is_local(name):
        return None
    quoted = re.match(r'[^"]*"([^"]+)"', rest)
    if quoted is not None:
        return Subdataset(driver, quoted[1])
    if driver in ("GTiff", "NITF"):
        return Subdataset(driver, re.sub(r"^(off:)?\d+:", "", rest))
    container = rest
    while ":" in container and not _is_container(container):
        container = container.rpartition(":")[0]
    return Subdataset(driver, container)


def _is_container(name: str) -> bool:
    inside = in_zip(name)
    return is_there(name) if inside is None else inside.exists()


def in_zip(name: str) -> ZipPath | None:
    """File inside a ZIP archive of the disk; None for any other name, also of nested archives.

    Raises
    ------
    RasterUnreadableError
        If the archive is damaged.
    """
    found = _ZIP.match(name)
    if found is None:
        return None
    from zipfile import BadZipFile, is_zipfile
    from zipfile import Path as ZipPath

    archive, inside = _split(found[1])
    if not archive or not os.path.isfile(archive) or not is_zipfile(archive):  # noqa: PTH113
        return None
    try:
        return ZipPath(archive, inside.strip("/"))
    except (BadZipFile, OSError, ValueError) as error:
        raise RasterUnreadableError(
            f"{archive} is no ZIP archive that can be read ({error})", "Obtain it again."
        ) from error


def _split(rest: str) -> tuple[str, str]:
    """Archive and what is inside, of what follows ``/vsizip/`` or ``zip://``."""
    if rest.startswith("{"):
        archive, _, inside = rest[1:].partition("}")
        return archive, inside
    if "!" in rest and not is_there(rest):
        archive, _, inside = rest.partition("!")
        return archive, inside
    for end in (at.start() for at in re.finditer("/|$", rest)):
        if end and os.path.isfile(rest[:end]):  # noqa: PTH113
            return rest[:end], rest[end:]
    return "", ""
