"""What the directory of a corrected TIFF says: the old one with new georeferencing and metadata."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from affine import Affine

from geodelreg.errors import RasterUnreadableError
from geodelreg.product import geotags
from geodelreg.product.environment import gdal_failures
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
            domains[geotags.DOMAIN] = {"GCPS": geotags.gcps_json(self.gcps)}
        return domains


@dataclass(frozen=True, slots=True)
class Georeference:
    """What GDAL reads from the inside of a TIFF, and with the files beside it.

    Attributes
    ----------
    transform : Affine or None
        Inside; None when there is none.
    crs, crs_with_sidecars : rasterio CRS or None
    ignores_point : bool
        GDAL is configured not to tell pixel centres from corners.
    """

    transform: Affine | None
    crs: Any
    crs_with_sidecars: Any
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
                with rasterio.open(path, GEOREF_SOURCES="INTERNAL") as inside:
                    transform = inside.transform if _is_placed(inside) else None
                    crs = inside.crs
                with rasterio.open(path) as whole:
                    return cls(transform, crs, whole.crs, ignores)
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
    """GeoKeys as GDAL writes them, when those of the file lack or contradict what GDAL reads."""
    crs = georeference.crs_with_sidecars
    if crs is None or crs == georeference.crs:
        return []
    from rasterio.io import MemoryFile

    with MemoryFile(ext=".tif") as memory:
        profile = {"driver": "GTiff", "width": 1, "height": 1, "count": 1, "dtype": "uint8"}
        with memory.open(**profile, crs=crs, transform=Affine(1, 0, 1, 0, -1, 1)) as dataset:
            dataset.update_tags(AREA_OR_POINT="Point" if is_point else "Area")
        template = TiffFile(Path(memory.name), BytesIO(memory.read()))
    entries = [template.first_directory().find(tag) for tag in geotags.CRS_TAGS]
    return [_transcribed(template, entry, layout) for entry in entries if entry is not None]


def _transcribed(template: TiffFile, entry: Entry, layout: Layout) -> Entry:
    if entry.type in (SHORT, DOUBLE):
        return Entry.of(layout, entry.tag, entry.type, template.numbers(entry))
    return Entry.of(layout, entry.tag, entry.type, template.value(entry).rstrip(b"\0"))


def _is_placed(dataset: Any) -> bool:
    return not dataset.transform.is_identity and not dataset.gcps[0]
