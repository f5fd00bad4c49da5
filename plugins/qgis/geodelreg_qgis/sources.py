"""From a layer of QGIS to the name of a file that geodelreg can open; no QGIS in here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

_SAVE = "Save it to a file (right-click the layer ▸ Export ▸ Save As…), and choose that file."
_KINDS = {
    "memory": "is a temporary layer, kept in memory",
    "virtual": "is a virtual layer",
    "virtualraster": "is a virtual raster, computed by QGIS",
    "wms": "is a web map (WMS, WMTS or XYZ), a picture without the values of the pixels",
    "wcs": "is a web coverage (WCS)",
    "wfs": "is a web feature service (WFS)",
    "oapif": "is a web feature service (OGC API)",
    "arcgismapserver": "is a web map (ArcGIS)",
    "arcgisfeatureserver": "is a web feature service (ArcGIS)",
    "postgres": "is a table of a database (PostgreSQL)",
    "postgresraster": "is a table of a database (PostgreSQL)",
    "mssql": "is a table of a database (SQL Server)",
    "oracle": "is a table of a database (Oracle)",
    "spatialite": "is a table of a database (SpatiaLite)",
}


class SourceError(Exception):
    """A layer is no file, or looks otherwise in QGIS; the message says what to do."""


@dataclass(frozen=True)
class Source:
    """What matters of a layer.

    Attributes
    ----------
    name : str
        As the user sees it.
    provider : str
        QGIS's name for where the layer comes from: ``gdal``, ``ogr``, ``memory`` …
    path : str
        Name of the file, as the provider takes it apart.
    crs, file_crs : str
        Name of the CRS that QGIS uses for the layer, and of the one that its file states; empty
        when unknown.
    unsaved : bool
        It has edits that are not saved.
    filter : str
        Expression that hides features.
    """

    name: str
    provider: str
    path: str
    crs: str = ""
    file_crs: str = ""
    unsaved: bool = False
    filter: str = ""


def check_pair(ms: Sequence[str], pan: Sequence[str]) -> None:
    """Refuse a raster as its own reference: QGIS offers the active layer for both.

    Raises
    ------
    SourceError
    """
    for file in pan:
        if file in ms:
            raise SourceError(f"{file} is chosen as MS and as PAN. Choose the other layer.")


def file_of(source: Source) -> str:
    """Name of the file of a layer.

    Raises
    ------
    SourceError
        When the layer is no file, or looks otherwise in QGIS than geodelreg would find it.
    """
    layer = f"The layer “{source.name}”"
    provider = source.provider.lower()
    if provider not in ("gdal", "ogr"):
        kind = _KINDS.get(provider, f"comes from QGIS's provider “{source.provider}”")
        raise SourceError(f"{layer} {kind}; geodelreg reads files. {_SAVE}")
    if source.path.startswith("/vsimem/"):
        raise SourceError(f"{layer} is kept in memory; geodelreg reads files. {_SAVE}")
    if source.unsaved:
        raise SourceError(f"{layer} has edits that are not saved. Save them first.")
    if source.filter:
        raise SourceError(
            f"{layer} shows a part of its file only (filter {source.filter}), and geodelreg would "
            "read all of it. Remove the filter, or export what is shown to a file and choose that."
        )
    if source.crs != source.file_crs:
        says = f"says {source.file_crs}" if source.file_crs else "states none"
        raise SourceError(
            f"{layer} has the CRS {source.crs or '(none)'} in QGIS only; its file {says}, and that "
            "is what geodelreg goes by. Write the right CRS into the file (Raster ▸ Projections ▸ "
            "Assign Projection…), or set the layer back to the CRS of its file."
        )
    return source.path
