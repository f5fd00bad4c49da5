"""What a GCP file needs beside the points."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine

from geodelreg.errors import GcpFormatError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.values.points import Gcp, TiePoints
from geodelreg.values.raster import FloatArray, Grid, IntArray
from geodelreg.values.result import Alignment

_CRS_TEXT = re.compile(
    r"[A-Za-z]\w*:[\w.]+$|[A-Z]\w+\s*[\[(]|\+|\{|urn:|https?://(www\.)?opengis\.net/def/crs/|"
    r"(WGS84|WGS72|NAD27|NAD83)$"
)


@dataclass(frozen=True, slots=True, eq=False)
class GcpContext:
    """The rasters that the points connect.

    Attributes
    ----------
    source : Grid
        Original grid of the MS raster; its CRS is that of the points' map coordinates.
    corrected : Affine or None
        Corrected geotransform of the MS raster; the residuals in QGIS files refer to it.
    reference : Grid or None
        Grid of the PAN raster, for ENVI image-to-image files.
    source_paths : tuple of str
        MS file, or one file per band.
    reference_path : str
    reference_px : (N, 2) float64 or None
        Outer-corner PAN pixel of every point, in the points' order; worked out from `reference`
        when not given.
    """

    source: Grid
    corrected: Affine | None = None
    reference: Grid | None = None
    source_paths: tuple[str, ...] = ()
    reference_path: str = ""
    reference_px: FloatArray | None = None

    @property
    def source_label(self) -> str:
        """MS file or files, as one line of text."""
        return ", ".join(self.source_paths)


Decoded = tuple[tuple[Gcp, ...], str | None]
Encoder = Callable[[Sequence[Gcp], GcpContext, Path], str | bytes]
Decoder = Callable[[Any, GcpContext | None], Decoded]
"""Of the text of a file, or its path where it is none."""


def reading_order(tie_points: TiePoints, every: bool = False) -> IntArray:
    """Indices (K,) of the kept tie points, by MS row, then column; of all that lie anywhere."""
    known = np.isfinite(np.hstack([tie_points.source_px, tie_points.reference_px])).all(axis=1)
    kept = np.flatnonzero(known if every else tie_points.kept)
    columns, rows = tie_points.source_px[kept].T
    return kept[np.lexsort((columns, rows))]


def gcp_context(alignment: Alignment, every: bool = False) -> GcpContext:
    """Context of `gcps_from_alignment`'s points, in the same order."""
    points = alignment.tie_points
    return GcpContext(
        source=alignment.source.grid,
        corrected=alignment.correction.corrected if alignment.fits_a_header else None,
        reference=alignment.reference.grid,
        source_paths=alignment.source.paths,
        reference_path=alignment.reference.paths[0],
        reference_px=points.reference_px[reading_order(points, every)],
    )


def gcps_at(pixels: FloatArray, ground: FloatArray) -> tuple[Gcp, ...]:
    """Points of (N, 2) MS pixels and map coordinates, which are called by their numbers."""
    pairs = zip(pixels.tolist(), ground.tolist(), strict=True)
    return tuple(Gcp(str(i), *pixel, *xy) for i, (pixel, xy) in enumerate(pairs, start=1))


def pixels_of(gcps: Sequence[Gcp]) -> FloatArray:
    """(N, 2) float64 outer-corner MS pixels."""
    return np.array([(gcp.column, gcp.row) for gcp in gcps], dtype=np.float64).reshape(-1, 2)


def ground_of(gcps: Sequence[Gcp]) -> FloatArray:
    """(N, 2) float64 map coordinates in the MS CRS."""
    return np.array([(gcp.x, gcp.y) for gcp in gcps], dtype=np.float64).reshape(-1, 2)


def reference_pixels(gcps: Sequence[Gcp], context: GcpContext) -> FloatArray:
    """(N, 2) float64 outer-corner PAN pixels of the points.

    Raises
    ------
    GcpFormatError
        If the context knows neither the pixels nor the PAN grid.
    """
    if context.reference_px is not None:
        if len(context.reference_px) != len(gcps):
            raise GcpFormatError(
                f"{len(gcps)} points come with {len(context.reference_px)} reference pixels"
            )
        return context.reference_px
    if context.reference is None:
        raise GcpFormatError(
            "image-to-image points need the reference raster's grid", "Name the reference raster."
        )
    reference = context.reference
    ground = map_points(ground_of(gcps), context.source.crs_wkt, reference.crs_wkt)
    return apply_affine(~reference.transform, ground)


def numbers(fields: Sequence[str], line: int) -> list[float]:
    """Finite floats of text fields.

    Raises
    ------
    GcpFormatError
        Naming the line.
    """
    try:
        values = [float(text) for text in fields]
    except ValueError as error:
        raise GcpFormatError(f"line {line}: {error}") from error
    if not all(math.isfinite(value) for value in values):
        raise GcpFormatError(f"line {line}: a coordinate is not finite")
    return values


def exact(value: float) -> str:
    """Shortest text that reads back as the same float64."""
    return repr(float(value))


def one_line(wkt: str) -> str:
    """WKT without line breaks."""
    return "".join(part.strip() for part in wkt.splitlines())


def crs_name(crs_wkt: str) -> str:
    """``EPSG:code`` when that says exactly the same, else the WKT."""
    from rasterio.crs import CRS

    crs = CRS.from_wkt(crs_wkt)
    code = crs.to_epsg()
    if code is not None and CRS.from_epsg(code) == crs:
        return f"EPSG:{code}"
    return crs_wkt


def crs_wkt_of(name: str) -> str:
    """WKT2 of a CRS given as ``EPSG:code``, WKT, or a PROJ string.

    Raises
    ------
    GcpFormatError
        If it is unknown.
    """
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    if not _CRS_TEXT.match(name.strip()):  # GDAL would fetch addresses, and open files
        raise GcpFormatError(
            f"its CRS {name!r} is unknown: no code, WKT, PROJJSON or PROJ string, and "
            "addresses are not fetched",
            "Write it as EPSG:… or as WKT.",
        )
    try:
        return str(CRS.from_string(name).to_wkt(version="WKT2_2019"))
    except (CRSError, ValueError) as error:  # rasterio lets what int() and split() say through
        raise GcpFormatError(f"its CRS {name!r} is unknown") from error
