"""What the directory of a corrected TIFF says: the old one with new georeferencing and metadata."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from affine import Affine

from geodelreg.door.opening import open_raster
from geodelreg.errors import RasterUnreadableError
from geodelreg.geotiff import geotags, sidecars
from geodelreg.geotiff.environment import gdal_failures
from geodelreg.geotiff.srs import SpatialReference, spatial_reference
from geodelreg.tiff import DOUBLE, SHORT, Directory, Entry, Layout, TiffFile, replaced
from geodelreg.values.points import Gcp
from geodelreg.values.result import Correction

Domains = Mapping[str, Mapping[str, str]]
Metadata = Sequence[Domains]
_TRUE = ("TRUE", "YES", "ON", "1")


@dataclass(frozen=True, slots=True, eq=False)
class Provenance:
    """What an output carries beside the pixels.

    Attributes
    ----------
    correction : Correction
    gcps : sequence of Gcp
        Kept as JSON in the metadata domain ``GEODELREG``.
    tags : mapping of str to str
        Items of the default metadata domain, ``GEODELREG_*``.
    georef : str
        ``geotransform`` or ``gcps``: what places the raster.
    strip_rpc : bool
        Drop RPCs.
    """

    correction: Correction
    gcps: Sequence[Gcp]
    tags: Mapping[str, str]
    georef: str = "geotransform"
    strip_rpc: bool = False

    @property
    def domains(self) -> dict[str, Mapping[str, str]]:
        """Metadata items by domain; "" is the default one."""
        domains: dict[str, Mapping[str, str]] = {"": self.tags}
        if self.gcps:
            domains[sidecars.DOMAIN] = {"GCPS": geotags.gcps_json(self.gcps)}
        return domains


@dataclass(frozen=True, slots=True)
class Georeference:
    """What GDAL reads from the inside of a TIFF, and with the files beside it.

    Attributes
    ----------
    transform : Affine or None
        Inside; None when there is none.
    reference, reference_with_sidecars : SpatialReference or None
    ignores_point : bool
        GDAL is configured not to tell pixel centres from corners.
    """

    transform: Affine | None
    reference: SpatialReference | None
    reference_with_sidecars: SpatialReference | None
    ignores_point: bool = False

    @classmethod
    def read(cls, path: Path) -> Georeference:
        """Read it from a TIFF.

        Raises
        ------
        RasterUnreadableError
        """
        import rasterio
        from rasterio.env import get_gdal_config
        from rasterio.errors import NotGeoreferencedWarning

        with rasterio.Env(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            ignores = str(get_gdal_config("GTIFF_POINT_GEO_IGNORE")).upper() in _TRUE
            try:
                with open_raster(path, GEOREF_SOURCES="INTERNAL") as inside:
                    transform = inside.transform if _is_placed(inside) else None
                    reference = SpatialReference.of(inside)
                return cls(transform, reference, spatial_reference(path), ignores)
            except gdal_failures() as error:
                raise RasterUnreadableError(
                    f"{path} cannot be read by GDAL: {error}", "Obtain the file again."
                ) from error


def corrected_entries(
    tiff: TiffFile,
    main: Directory,
    georeference: Georeference,
    content: Provenance,
    more: Metadata = (),
) -> tuple[Entry, ...]:
    """Entries of the main directory after the correction.

    Parameters
    ----------
    tiff, main
        The file and its first directory.
    georeference : Georeference
        Of the same file.
    content : Provenance
    more : sequence of mapping, optional
        Further metadata items by domain, of the raster and of each band.
    """
    is_point = geotags.is_pixel_point(tiff, main)
    new = _crs_entries(tiff.layout, georeference, is_point)
    dropped: tuple[int, ...] = geotags.CRS_TAGS if new else ()
    pixel_point = is_point and not georeference.ignores_point
    corrected = content.correction.corrected
    if content.georef == "gcps":
        dropped += geotags.PLACEMENT
        new += geotags.gcp_entries(tiff.layout, content.gcps, pixel_point)
    elif georeference.transform != corrected:
        dropped += geotags.PLACEMENT
        new += geotags.placement_entries(tiff, main, corrected, pixel_point)
    if content.strip_rpc:
        dropped += (geotags.RPC_COEFFICIENTS,)
    existing = tiff.value(main.find(geotags.GDAL_METADATA))
    raster = merged_domains(more[0], content.domains) if more else content.domains
    new.append(geotags.metadata_entry(tiff.layout, existing, (raster, *more[1:])))
    return replaced(main.entries, new, dropped)


def merged_domains(first: Domains, second: Domains) -> dict[str, dict[str, str]]:
    """Metadata items of both, by domain; those of `second` win."""
    return {d: {**first.get(d, {}), **second.get(d, {})} for d in (*first, *second)}


def _crs_entries(layout: Layout, georeference: Georeference, is_point: bool) -> list[Entry]:
    """GeoKeys as GDAL writes them, when those of the file lack or contradict what GDAL reads.

    None when they would say something else: not all CRSs fit in.
    """
    wanted = georeference.reference_with_sidecars
    if wanted is None or wanted.is_same(georeference.reference):
        return []
    template = _template(wanted, is_point)
    if template is None:
        return []
    entries = [template.first_directory().find(tag) for tag in geotags.CRS_TAGS]
    return [_transcribed(template, entry, layout) for entry in entries if entry is not None]


def _template(reference: SpatialReference, is_point: bool) -> TiffFile | None:
    """TIFF that GDAL has written with this spatial reference; None when it does not read so."""
    import rasterio
    import rasterio.shutil
    from rasterio.io import MemoryFile

    root = ElementTree.Element("VRTDataset", {"rasterXSize": "1", "rasterYSize": "1"})
    root.append(reference.element())
    ElementTree.SubElement(root, "GeoTransform").text = "1, 1, 0, 1, 0, -1"
    sidecars.add_metadata(root, {"": {"AREA_OR_POINT": "Point" if is_point else "Area"}})
    ElementTree.SubElement(root, "VRTRasterBand", {"dataType": "Byte", "band": "1"})
    with (
        rasterio.Env(GDAL_PAM_ENABLED=False),
        MemoryFile(ElementTree.tostring(root), ext=".vrt") as virtual,
        MemoryFile(ext=".tif") as memory,
    ):
        rasterio.shutil.copy(virtual.name, memory.name, driver="GTiff")
        if not reference.is_same(spatial_reference(memory.name)):
            return None
        return TiffFile(Path(memory.name), BytesIO(memory.read()))


def _transcribed(template: TiffFile, entry: Entry, layout: Layout) -> Entry:
    if entry.type in (SHORT, DOUBLE):
        return Entry.of(layout, entry.tag, entry.type, template.numbers(entry))
    return Entry.of(layout, entry.tag, entry.type, template.value(entry).rstrip(b"\0"))


def _is_placed(dataset: Any) -> bool:
    return not dataset.transform.is_identity and not dataset.gcps[0]
