"""The spatial reference of a raster: its CRS, axis mapping and coordinate epoch.

GeoTIFF has no place for some CRSs, and its keys, or the old WKT that GDAL prefers, turn others into
something else.  A PAM file (``.aux.xml``) holds all of them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

from geodelreg.door.opening import open_raster
from geodelreg.errors import OutputUnwritableError
from geodelreg.geotiff import sidecars

_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f]")
_SRS = re.compile(r"<VRTDataset\b[^>]*>\s*(<SRS\b.*?</SRS>)", re.DOTALL)
_GCP_LIST = re.compile(r"(<GCPList\b[^>]*)>")
_WKT = re.compile(r"\s*\w+\s*\[")
_WKT1 = re.compile(r"\s*(PROJCS|GEOGCS|GEOCCS|COMPD_CS|VERT_CS|LOCAL_CS)\s*\[")


@dataclass(frozen=True, slots=True)
class SpatialReference:
    """What GDAL reads from a raster about its map coordinates.

    Attributes
    ----------
    wkt : str
        As stored where that is WKT2, else WKT2 by GDAL; WKT1 where only GDAL's survives reading.
    mapping : str
        Axes of the CRS, counted from 1, that x and y of the raster are; "" the default.
    epoch : str
        Decimal year at which the coordinates hold, of a dynamic CRS; "" unknown.
    """

    wkt: str
    mapping: str = ""
    epoch: str = ""

    @classmethod
    def of(cls, dataset: Any) -> SpatialReference | None:
        """Spatial reference of an open raster, or of its GCPs; None without one."""
        xml = _vrt_text(dataset)
        if found := _SRS.search(xml):
            element, crs = ElementTree.fromstring(found[1]), dataset.crs
            text = element.text
        elif found := _GCP_LIST.search(xml):
            element, crs = ElementTree.fromstring(found[1] + "/>"), dataset.gcps[1]
            text = element.get("Projection")
        else:
            return None
        if not text or not crs:
            return None
        mapping = element.get("dataAxisToSRSAxisMapping", "")
        return cls(_whole_wkt(dataset, crs, text), mapping, element.get("coordinateEpoch", ""))

    @property
    def name(self) -> str:
        """Name of the CRS, for messages."""
        found = re.search(r'\[\s*"([^"]*)"', self.wkt)
        return found[1] if found else "?"

    def is_same(self, other: SpatialReference | None) -> bool:
        """Whether two spatial references mean the same, by PROJ's strict comparison."""
        if other is None or (self.mapping, self.epoch) != (other.mapping, other.epoch):
            return False
        if self.wkt == other.wkt:
            return True
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        try:
            return CRS.from_wkt(self.wkt).equals(CRS.from_wkt(other.wkt))
        except CRSError:
            return False

    def element(self) -> ElementTree.Element:
        """Element of a PAM file or a VRT."""
        attributes = {"dataAxisToSRSAxisMapping": self.mapping, "coordinateEpoch": self.epoch}
        element = ElementTree.Element("SRS", {k: v for k, v in attributes.items() if v})
        element.text = self.wkt
        return element


def spatial_reference(path: Path | str) -> SpatialReference | None:
    """Spatial reference of a raster file; None without one."""
    with open_raster(path) as dataset:
        return SpatialReference.of(dataset)


def is_kept_in_pam(reference: SpatialReference) -> bool:
    """Whether GDAL reads a spatial reference from the PAM file beside a TIFF as it is."""
    import rasterio

    shape = {"width": 1, "height": 1, "count": 1, "dtype": "uint8"}
    with TemporaryDirectory() as folder:
        probe = Path(folder, "probe.tif")
        transform = rasterio.Affine.translation(1.0, 1.0)
        rasterio.open(probe, "w", driver="GTiff", transform=transform, **shape).close()
        sidecars.pam_path(probe).write_bytes(sidecars.with_srs(None, reference.element()))
        return reference.is_same(spatial_reference(probe))


def keep(wanted: SpatialReference | None, out: Path, target: Path) -> list[str]:
    """Make a finished output say the spatial reference of its source: in a PAM file if need be.

    Parameters
    ----------
    wanted : SpatialReference or None
        None when there is nothing to keep.
    out : Path
        The file as it is now; its PAM file goes beside it.
    target : Path
        Its final name, for messages.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    OutputUnwritableError
        Neither the format nor PAM holds it.
    """
    if wanted is None or wanted.is_same(spatial_reference(out)):
        return []
    pam = sidecars.pam_path(out)
    pam.write_bytes(
        sidecars.with_srs(pam.read_bytes() if pam.is_file() else None, wanted.element())
    )
    if not wanted.is_same(spatial_reference(out)):
        raise OutputUnwritableError(
            f"{target} cannot be written: its format does not keep the coordinate reference "
            f"system {wanted.name}, nor does a file {pam.name} beside it",
            "Keep the format and the encoding of the source, and the geotransform: no `driver`, "
            "`creation_options`, `georef` or `warp`.",
        )
    where = f"{target.name}: the coordinate reference system {wanted.name} is in {pam.name}"
    return [f"{where}, its format has no place for it; keep both files together"]


def vrt_of(dataset: Any) -> ElementTree.Element:
    """What GDAL knows of an open raster, as the XML of a VRT."""
    return ElementTree.fromstring(_vrt_text(dataset))


def _vrt_text(dataset: Any) -> str:
    import rasterio.shutil
    from rasterio.io import MemoryFile

    with MemoryFile(ext=".vrt") as memory:
        rasterio.shutil.copy(dataset, memory.name, driver="VRT")
        xml = memory.read()
    try:
        text = xml.decode()
    except UnicodeDecodeError:  # GDAL passes texts of old products on as they are
        text = xml.decode("latin-1")
    return _CONTROL.sub("", text)


def _whole_wkt(dataset: Any, crs: Any, text: str) -> str:
    """WKT of a CRS that GDAL has written as `text`, which is WKT1 where WKT1 has words for it."""
    from rasterio.enums import WktVersion
    from rasterio.errors import CRSError

    if not _WKT1.match(text):
        return text
    stored = _stored_wkt(dataset)
    try:
        if stored and type(crs).from_wkt(stored).to_wkt() == text:
            return stored
        # rasterio reads through WKT1, which not every CRS survives
        return str(crs.to_wkt(version=WktVersion.WKT2_2019)) if crs.to_wkt() == text else text
    except CRSError:
        return text


def _stored_wkt(dataset: Any) -> str | None:
    """WKT2 in the PAM file of a raster, or in the VRT that it is."""
    path = Path(dataset.name)
    for file in (sidecars.pam_path(path), *([path] if dataset.driver == "VRT" else [])):
        if file.is_file():
            try:
                text = sidecars.srs_text(file.read_bytes())
            except (OSError, ValueError):
                continue
            if text and _WKT.match(text) and not _WKT1.match(text):
                return text
    return None
