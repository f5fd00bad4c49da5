"""The source as GDAL would read it with a corrected header: a virtual raster in memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from affine import Affine

from geodelreg.door.opening import open_raster, own_name
from geodelreg.geotiff import metadata, sidecars
from geodelreg.geotiff.header import Provenance
from geodelreg.geotiff.srs import SpatialReference, vrt_of


@contextmanager
def corrected_view(
    source: Path, content: Provenance, mask_rules: bool = False
) -> Iterator[tuple[str, str]]:
    """Yield name and XML of a VRT of `source` with corrected georeferencing and provenance.

    Parameters
    ----------
    source : Path
    content : Provenance
    mask_rules : bool
        Leave out no-data values where the raster has a mask as well, which then rules.
    """
    from rasterio.io import MemoryFile

    with open_raster(source) as dataset:
        root, reference = vrt_of(dataset), SpatialReference.of(dataset)
        sidecars.add_metadata(root, _further_domains(dataset, 0))
        for element, band in zip(root.iter("VRTRasterBand"), dataset.indexes, strict=False):
            sidecars.add_metadata(element, _further_domains(dataset, band))
            _set_exactly(element, "Scale", dataset.scales[band - 1])
            _set_exactly(element, "Offset", dataset.offsets[band - 1])
    _replace_placement(root, content, reference)
    _replace_metadata(root, content)
    if mask_rules and root.find("MaskBand") is not None:
        for band in root.findall("VRTRasterBand"):
            for element in band.findall("NoDataValue"):
                band.remove(element)
    text: str = ElementTree.tostring(root, encoding="unicode")
    with (
        MemoryFile(text.encode(), ext=".vrt") as corrected,
        own_name(corrected.name, "VRT") as name,
    ):
        yield name, text


def _set_exactly(band: ElementTree.Element, tag: str, value: float) -> None:
    """Give a number all its digits, of which GDAL writes 16."""
    element = band.find(tag)
    if element is not None:
        element.text = repr(float(value))


def _further_domains(dataset: Any, band: int) -> dict[str, dict[str, str]]:
    """Metadata of the domains that GDAL does not carry over; those of GDAL itself apart."""
    own = metadata.domains(dataset, band) - metadata.GDAL_DOMAINS - {""}
    plain = (domain for domain in own if not domain.startswith("xml:"))
    return {domain: metadata.tags(dataset, band, domain) for domain in plain}


def _replace_placement(
    root: ElementTree.Element, content: Provenance, reference: SpatialReference | None
) -> None:
    for tag in ("SRS", "GeoTransform", "GCPList"):
        for element in root.findall(tag):
            root.remove(element)
    srs = None if reference is None else reference.element()
    if content.georef == "gcps":
        root.insert(0, _gcp_list(content, srs))
        return
    transform = ElementTree.Element("GeoTransform")
    transform.text = _gdal_order(content.correction.corrected)
    root.insert(0, transform)
    if srs is not None:
        root.insert(0, srs)


def _gdal_order(transform: Affine) -> str:
    return ", ".join(repr(float(value)) for value in transform.to_gdal())


def _gcp_list(content: Provenance, srs: ElementTree.Element | None) -> ElementTree.Element:
    attributes = {} if srs is None else {"Projection": srs.text or "", **srs.attrib}
    gcps = ElementTree.Element("GCPList", attributes)
    for gcp in content.gcps:
        position = (gcp.column, gcp.row, gcp.x, gcp.y, gcp.z)
        values = zip(("Pixel", "Line", "X", "Y", "Z"), map(repr, map(float, position)), strict=True)
        ElementTree.SubElement(gcps, "GCP", {"Id": gcp.id, "Info": gcp.info, **dict(values)})
    return gcps


def _replace_metadata(root: ElementTree.Element, content: Provenance) -> None:
    if content.strip_rpc:
        for element in root.findall("Metadata[@domain='RPC']"):
            root.remove(element)
    sidecars.drop_provenance(root)
    sidecars.add_metadata(root, content.domains)
