"""Names of rasters: files of this machine, or addresses that only GDAL understands."""

from __future__ import annotations

from pathlib import Path


def is_local(path: str) -> bool:
    """Whether `path` names a file, not a URL, a ``/vsi…`` path or a subdataset."""
    return not path.startswith("/vsi") and "://" not in path and not _has_driver_prefix(path)


def _has_driver_prefix(path: str) -> bool:
    prefix, colon, _ = path.partition(":")
    return bool(colon) and len(prefix) > 1 and "/" not in prefix and not Path(path).exists()
