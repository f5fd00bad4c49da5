"""Where a result came from: fingerprints of the inputs and the ``GEODELREG_*`` tags of outputs."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from geodelreg.errors import GeodelregError
from geodelreg.values.result import Alignment
from geodelreg.version import __version__

_END_BYTES = 1 << 20
_BLOCK_BYTES = 1 << 16
_BLOCKS = 64
_WHOLE_BYTES = 2 * _END_BYTES + _BLOCKS * _BLOCK_BYTES


def fingerprint(path: str | Path) -> str:
    """Digest that tells files apart after reading at most 6 MiB of them.

    SHA-256 over the size (8 bytes, little-endian) and the contents: all of them up to 6 MiB; of a
    larger file the first and the last MiB and 64 blocks of 64 KiB spaced evenly between them.  So
    it sees any change of size or header, but not every change of single pixels of a huge file.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    str
        ``sha256:`` (everything read) or ``sha256-sampled:`` and 64 hexadecimal digits; "" when
        `path` is no local file, as for GDAL's ``/vsi…`` names.
    """
    if not Path(path).is_file():
        return ""
    with Path(path).open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        digest = hashlib.sha256(size.to_bytes(8, "little"))
        if size <= _WHOLE_BYTES:
            digest.update(stream.read(_WHOLE_BYTES))
            return f"sha256:{digest.hexdigest()}"
        last = size - _END_BYTES
        room = last - _END_BYTES - _BLOCK_BYTES
        starts = [_END_BYTES + room * block // (_BLOCKS - 1) for block in range(_BLOCKS)]
        blocks = ((start, _BLOCK_BYTES) for start in starts)
        for start, length in [(0, _END_BYTES), *blocks, (last, _END_BYTES)]:
            stream.seek(start)
            digest.update(stream.read(length))
    return f"sha256-sampled:{digest.hexdigest()}"


def source_date() -> str | None:
    """Date of ``SOURCE_DATE_EPOCH`` as ISO 8601 in UTC, so that outputs can be reproduced.

    None without that variable, or when it is no number of seconds.
    """
    try:
        moment = datetime.fromtimestamp(int(os.environ.get("SOURCE_DATE_EPOCH", "")), UTC)
    except (ValueError, OverflowError, OSError):
        return None
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def provenance_tags(alignment: Alignment) -> dict[str, str]:
    """``GEODELREG_*`` tags of a corrected raster; equal inputs and options give equal tags.

    Parameters
    ----------
    alignment : Alignment

    Returns
    -------
    dict of str to str
        Sorted by name; input files without their folders.  What is not known has no tag.
    """
    correction, accuracy = alignment.correction, alignment.accuracy
    source, reference, points = alignment.source, alignment.reference, alignment.points
    after = correction.corrected.to_gdal() if alignment.fits_a_header else ()
    tags = {
        "VERSION": __version__,
        "MS": "; ".join(Path(path).name for path in source.paths),
        "MS_FINGERPRINT": "; ".join(source.fingerprints) if all(source.fingerprints) else "",
        "PAN": Path(reference.paths[0]).name if alignment.has_pan else "",
        "PAN_FINGERPRINT": reference.fingerprints[0] if alignment.has_pan else "",
        "POINTS": Path(points.paths[0]).name if points else "",
        "POINTS_FINGERPRINT": points.fingerprints[0] if points else "",
        "MASKS": "; ".join(f"{Path(use.path).name} ({use.kind})" for use in alignment.masks),
        "METHOD": "points" if points else alignment.options.method,
        "MODEL": correction.model,
        "VERDICT": alignment.verdict.outcome.value,
        "GEOTRANSFORM_BEFORE": _numbers(correction.original.to_gdal()),
        "GEOTRANSFORM_AFTER": _numbers(after),
        "TIE_POINTS": str(accuracy.kept),
        "UNCERTAINTY_PX": _rounded(accuracy.uncertainty_px),
        "CHECK_RMSE_PX": _rounded(accuracy.check_rmse_px),
        "CHECK_RMSE_M": _rounded(accuracy.check_rmse_m),
        "CHECK_CE90_PX": _rounded(accuracy.check_ce90_px),
        "CHECK_CE90_M": _rounded(accuracy.check_ce90_m),
        "DATE": source_date() or "",
    }
    return {f"GEODELREG_{name}": text for name, text in sorted(tags.items()) if text}


FINGERPRINTS = (
    "GEODELREG_MS_FINGERPRINT",
    "GEODELREG_PAN_FINGERPRINT",
    "GEODELREG_POINTS_FINGERPRINT",
)
"""Tags that tell of which rasters, and points, a correction was found."""


def written_tags(path: Path) -> dict[str, str]:
    """``GEODELREG_*`` tags that a raster carries; none when it is no raster of geodelreg's."""
    from rasterio.errors import RasterioError

    from geodelreg.door.opening import open_raster

    try:
        with open_raster(path) as dataset:
            tags = dataset.tags()
    except (RasterioError, GeodelregError):
        return {}
    return {name: text for name, text in tags.items() if name.startswith("GEODELREG_")}


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _rounded(value: float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else ""


def versions(*, with_proj: bool) -> dict[str, str]:
    """Versions of everything that can change a result.

    Parameters
    ----------
    with_proj : bool
        That of pyproj and its PROJ, too: coordinates went through them.
    """
    import platform

    import cv2
    import numpy
    import rasterio

    found = {
        "geodelreg": __version__,
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "opencv": cv2.__version__,
        "rasterio": rasterio.__version__,
        "gdal": rasterio.__gdal_version__,
    }
    if with_proj:
        import pyproj

        found |= {"pyproj": pyproj.__version__, "proj": pyproj.proj_version_str}
    return found
