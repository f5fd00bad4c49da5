"""What the name of a raster may make GDAL open: local files, unless the user allows more.

Names may come from a list that someone else has written, and so may the files.  GDAL would fetch
addresses, query databases and read the memory of the process for a name that asks for it.
"""

from __future__ import annotations

import re
from collections.abc import MutableMapping
from functools import cache

from geodelreg.errors import AccessNotAllowedError
from geodelreg.image.paths import is_local

LOCAL, NETWORK, ALL = "local", "network", "all"

_LOCAL_HANDLERS = {"vsizip", "vsitar", "vsigzip", "vsi7z", "vsirar", "vsisubfile", "vsimem"}
_OTHER_HANDLERS = {"vsistdin", "vsistdout", "vsistdout_redirect", "vsihdfs"}
_LOCAL_SCHEMES = {"file", "zip", "tar", "gzip"}
_OTHER_SCHEMES = {"vrt", "gdal", "derived"}
_LOCAL_CONTAINERS = re.compile(
    r"(NETCDF|HDF4_SDS|HDF4_EOS|HDF4_GR|HDF5|BAG|S10\d|S111|GTIFF_DIR|NITF_IM|GPKG|ZARR|"
    r"SENTINEL2_\w+|SENTINEL1_\w+|RADARSAT_2_\w+|TSX|PDF|PDF_IMAGE|ESRIC|MVT|ISIS3|PDS4|VICAR):"
)
_WEB_SERVICES = re.compile(
    r"(WMS|WCS|WMTS|EEDA|EEDAI|PLMOSAIC|PLSCENES|STACTA|STACIT|HTTP|NGW|OAPIF\w*|OGCAPI|DAAS):",
    re.IGNORECASE,
)
_WEB_DRIVERS = {
    *("DAAS", "EEDA", "EEDAI", "GTI", "HTTP", "NGW", "OGCAPI", "PLMOSAIC", "RASDAMAN"),
    *("STACIT", "STACTA", "WCS", "WMS", "WMTS"),
}
"""Formats whose files, even local ones, say what to fetch."""


def refuse(what: str, allow: str) -> AccessNotAllowedError:
    """Error for something that needs ``--allow``."""
    return AccessNotAllowedError(
        what, f"If you trust where the name or the file comes from, add --allow {allow}."
    )


def check_name(name: str, allow: str, where: str = "") -> None:
    """Refuse a name that reaches further than the user allows.

    Parameters
    ----------
    name : str
        Of a raster, as the user or a VRT gives it.
    allow : str
        ``local``, ``network`` or ``all``.
    where : str
        What names it, for the message.

    Raises
    ------
    AccessNotAllowedError
    """
    needed = needed_access(name)
    if allow != ALL and needed not in (LOCAL, allow):
        what = "is on the network" if needed == NETWORK else "is no file of this machine"
        raise refuse(f"{name}{where} {what}, and only local files may be opened", needed)


def needed_access(name: str) -> str:
    """Least value of ``--allow`` under which a name may be opened."""
    if is_local(name):
        return LOCAL
    handlers = set(re.findall(r"/(vsi\w+)", name))
    schemes = {one for word in re.findall(r"([\w+.-]+)://", name) for one in word.split("+")}
    if handlers & _OTHER_HANDLERS or schemes & _OTHER_SCHEMES:
        return ALL
    if handlers - _LOCAL_HANDLERS or schemes - _LOCAL_SCHEMES or _WEB_SERVICES.match(name):
        return NETWORK
    if handlers or schemes or _LOCAL_CONTAINERS.match(name):
        return LOCAL
    return ALL


@cache
def drivers(with_vrt: bool = True) -> tuple[str, ...]:
    """Formats of GDAL that open local files only; call it with GDAL ready.

    Parameters
    ----------
    with_vrt : bool
        VRTs too, whose sources were checked.
    """
    import rasterio

    with rasterio.Env() as env:
        return tuple(sorted(set(env.drivers()) - _WEB_DRIVERS - (set() if with_vrt else {"VRT"})))


def close_the_network(environment: MutableMapping[str, str]) -> None:
    """Take what fetches out of a GDAL that is not loaded yet.

    `check_name` and the check of VRTs come first; this also covers what a raster deep inside a
    VRT could name.

    Parameters
    ----------
    environment : mapping
        Variables of the process, changed; what the user has set stays.
    """
    skipped = environment.get("GDAL_SKIP", "").split()
    environment["GDAL_SKIP"] = " ".join(dict.fromkeys([*skipped, *sorted(_WEB_DRIVERS)]))
    environment.setdefault("CPL_VSIL_CURL_ALLOWED_FILENAME", "none")
