"""Metadata of open rasters, as far as rasterio can decode it.

Old products hold texts in other encodings than UTF-8, on which rasterio raises.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path
from typing import Any

from geodelreg.door.opening import open_raster
from geodelreg.geotiff.sidecars import DOMAIN

logger = logging.getLogger(__name__)

GDAL_DOMAINS = {"DERIVED_SUBDATASETS", "SUBDATASETS", "IMAGE_STRUCTURE", "LocationInfo", "RPC"}
"""Metadata domains that GDAL fills itself."""


def tags(dataset: Any, band: int = 0, domain: str = "") -> dict[str, str]:
    """Items of a metadata domain ("" the default one); empty when they are no UTF-8."""
    try:
        return dict(dataset.tags(band, ns=domain or None))
    except UnicodeDecodeError:
        logger.warning("%s: metadata that is not UTF-8 cannot be read", dataset.name)
        return {}


def domains(dataset: Any, band: int = 0) -> set[str]:
    """Metadata domains, the default one included."""
    try:
        return {"", *dataset.tag_namespaces(band)}
    except UnicodeDecodeError:
        return {""}


def attribute(dataset: Any, name: str) -> Any:
    """Attribute of a dataset; None when it holds texts that are no UTF-8."""
    try:
        return getattr(dataset, name)
    except UnicodeDecodeError:
        return None


def descriptions(dataset: Any) -> tuple[str | None, ...]:
    """What each band is called; None where nothing says it."""
    return tuple(attribute(dataset, "descriptions") or (None,) * dataset.count)


def has_rpc(path: Path) -> bool:
    """Whether a raster carries RPCs."""
    with open_raster(path) as dataset:
        return "RPC" in domains(dataset)


def colormap(dataset: Any, band: int) -> Any:
    """Colour table of a band, None without one."""
    try:
        return dataset.colormap(band)
    except ValueError:
        return None


def lost_metadata(
    source: Path, out: Path, ignored: Collection[str] = ()
) -> list[dict[str, dict[str, str]]]:
    """Metadata items of the source that the output lacks or says differently.

    Parameters
    ----------
    source, out : Path
    ignored : collection of str
        Domains that do not count.

    Returns
    -------
    list of dict
        Items by domain ("" the default one): of the raster first, then of each band.
    """
    with open_raster(source) as before, open_raster(out) as after:
        levels = (0, *(band for band in before.indexes if band <= after.count))
        return [_lost_items(before, after, level, ignored) for level in levels]


def _lost_items(
    before: Any, after: Any, band: int, ignored: Collection[str]
) -> dict[str, dict[str, str]]:
    ignored = {*GDAL_DOMAINS, DOMAIN} - {"RPC"} | set(ignored)
    lost = {}
    for domain in sorted(domains(before, band) - ignored):
        new = tags(after, band, domain)
        items = {
            key: value
            for key, value in tags(before, band, domain).items()
            if not key.startswith(DOMAIN + "_") and new.get(key, "").strip() != value.strip()
        }
        if items:
            lost[domain] = items
    return lost
