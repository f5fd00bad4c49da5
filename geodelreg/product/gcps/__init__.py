"""Ground control points in the formats of other tools, half a pixel right in each.

`gcps_from_alignment` makes them, `write_gcps` and `read_gcps` are the doors; one module per format.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geodelreg.errors import GcpFormatError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geotiff.atomic import write_bytes_atomically
from geodelreg.geotiff.targets import STDOUT
from geodelreg.product.gcps import envi, geojson, optfile, qgis, table, vector, vrt
from geodelreg.product.gcps.context import (
    Decoded,
    Decoder,
    Encoder,
    GcpContext,
    gcp_context,
    gcps_at,
    ground_of,
    reading_order,
)
from geodelreg.product.gcps.facts import band_of, facts_of, of_bands
from geodelreg.values.points import Gcp, TiePoints
from geodelreg.values.raster import Grid, IntArray
from geodelreg.values.result import Alignment

__all__ = [
    "GCP_FORMATS",
    "GcpContext",
    "GcpFormat",
    "gcp_context",
    "gcps_from_alignment",
    "in_crs_of",
    "read_gcps",
    "write_gcps",
]

_LARGEST_BYTES = 50_000_000
"""Of a file, 100 000 points in the wordiest format; its parsers take 25 times as much memory."""


@dataclass(frozen=True, slots=True)
class GcpFormat:
    """One file format: its extensions (the first format that names one is its default).

    Attributes
    ----------
    extensions : tuple of str
    description : str
    encode, decode : callable
    is_text : bool
        False of what is read by its path.
    has_fields : bool
        Each point tells its status, its accuracy, and the band it belongs to.
    keeps_rejected : bool
        Points can say that they were rejected.
    """

    extensions: tuple[str, ...]
    description: str
    encode: Encoder
    decode: Decoder
    is_text: bool = True
    has_fields: bool = False
    keeps_rejected: bool = False


GCP_FORMATS = {
    "qgis": GcpFormat(
        (".points",), "QGIS georeferencer", qgis.encode, qgis.decode, keeps_rejected=True
    ),
    "gdal": GcpFormat((".gcp", ".txt"), "gdal_translate --optfile", optfile.encode, optfile.decode),
    "csv": GcpFormat(
        (".csv",), "gdal raster edit --gcp @FILE", table.encode, table.decode, has_fields=True
    ),
    "geojson": GcpFormat(
        (".geojson", ".json"), "GeoJSON, as rio gcps", geojson.encode, geojson.decode,
        has_fields=True, keeps_rejected=True,
    ),
    "gpkg": GcpFormat(
        (".gpkg",), "GeoPackage", vector.encode_geopackage, vector.decode,
        is_text=False, has_fields=True, keeps_rejected=True,
    ),
    "flatgeobuf": GcpFormat(
        (".fgb",), "FlatGeobuf", vector.encode_flatgeobuf, vector.decode,
        is_text=False, has_fields=True, keeps_rejected=True,
    ),
    "vrt": GcpFormat((".vrt",), "VRT of the source raster with GCPs", vrt.encode, vrt.decode),
    "envi": GcpFormat(
        (".pts",), "ENVI image to image", envi.encode_image_to_image, envi.decode_image_to_image
    ),
    "envi-map": GcpFormat(
        (), "ENVI image to map", envi.encode_image_to_map, envi.decode_image_to_map
    ),
}  # fmt: skip


def gcps_from_alignment(
    alignment: Alignment, every: bool = False, bands: bool = False
) -> tuple[Gcp, ...]:
    """Ground control points of the kept tie points, by MS row, then column.

    Parameters
    ----------
    alignment : Alignment
    every : bool
        Those of the rejected tie points, too.
    bands : bool
        After those of the common map those of each band that lies apart.

    Returns
    -------
    tuple of Gcp
        MS pixel ↔ map coordinates of the same feature in the reference raster, carried exactly into
        the CRS of the MS raster.  Identifiers are "1" … "N".

    Raises
    ------
    CrsTransformError
        If the two CRSs are not connected.
    """
    points, reference = alignment.tie_points, alignment.reference.grid
    order = reading_order(points, every)
    ground = map_points(
        apply_affine(reference.transform, points.reference_px[order]),
        reference.crs_wkt,
        alignment.source.grid.crs_wkt,
    )
    known = zip(
        gcps_at(points.source_px[order], ground), _infos(points, order),
        points.kept[order].tolist(), facts_of(alignment, order), strict=True,
    )  # fmt: skip
    common = tuple(
        replace(gcp, info=info, enabled=enabled, facts=facts, form=alignment.solution.form)
        for gcp, info, enabled, facts in known
    )
    return (*common, *of_bands(alignment, common)) if bands else common


def _infos(points: TiePoints, order: IntArray) -> Iterator[str]:
    """Residual and standard deviation of each, in PAN pixels, as far as they are known."""
    named = ("residual", points.residual_px[order]), ("sigma", points.sigma_px[order])
    for each in zip(*(values.tolist() for _, values in named), strict=True):
        yield "; ".join(
            f"{name} {x:.4f} {y:.4f} px"
            for (name, _), (x, y) in zip(named, each, strict=True)
            if math.isfinite(x) and math.isfinite(y)
        )


def write_gcps(
    path: str | Path,
    gcps: Sequence[Gcp],
    format: str | None = None,  # noqa: A002 - the field's word
    *,
    context: GcpContext,
    overwrite: bool = False,
) -> None:
    """Write GCPs to a file, whole or not at all.

    Parameters
    ----------
    path : str or Path
    gcps : sequence of Gcp
        Pixels in the outer-corner convention, map coordinates in the CRS of ``context.source``.
    format : str, optional
        Key of `GCP_FORMATS`; by the extension of `path` when not given.
    context : GcpContext
        What the formats say beside the points.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    GcpFormatError
        If the format is unknown, lacks something in `context`, or a coordinate is not finite.
    OutputExistsError, OutputUnwritableError
        As `write_text_atomically` raises them.
    """
    target = Path(path)
    name = format_of(target, format)
    chosen = _format(name)
    if not chosen.keeps_rejected and not all(gcp.enabled for gcp in gcps):
        raise GcpFormatError(
            f"{target}: the format {name} cannot say which points were rejected",
            "Use QGIS points, GeoJSON, GeoPackage or FlatGeobuf, or leave the rejected ones out "
            "(`points='kept'`).",
        )
    for gcp in gcps:
        if not all(map(math.isfinite, (gcp.column, gcp.row, gcp.x, gcp.y, gcp.z))):
            raise GcpFormatError(
                f"{target}: point {gcp.id} has a coordinate that is not finite",
                "Leave the point out.",
            )
    if not chosen.is_text and target == STDOUT:
        raise GcpFormatError(f"{name} cannot be written to standard output", "Name a file.")
    content = chosen.encode(gcps, context, target)
    data = content.encode() if isinstance(content, str) else content
    write_bytes_atomically(target, data, overwrite)


def read_gcps(
    path: str | Path,
    format: str | None = None,  # noqa: A002 - the field's word
    context: GcpContext | None = None,
    every: bool = False,
) -> Decoded:
    """Read GCPs.

    Parameters
    ----------
    path : str or Path
    format : str, optional
        Key of `GCP_FORMATS`; by the extension (and first line, for ENVI) when not given.
    context : GcpContext, optional
        Grids that QGIS (``source``) and ENVI image-to-image files (both) refer to.
    every : bool
        Also those that are not enabled or were rejected, those of single bands, and those whose
        pixel of MS is not known (NaN).

    Returns
    -------
    gcps : tuple of Gcp
    crs_wkt : str or None
        CRS of the map coordinates, None when the file does not tell.

    Raises
    ------
    GcpFormatError
        If the file cannot be read as that format; the message names file and line.  Files of
        more than 50 MB are not read.
    """
    source = Path(path)
    name = format_of(source, format)
    chosen = _format(name)
    content = _content(source, chosen.is_text)
    if format is None and name == "envi" and envi.is_image_to_map(str(content)):
        chosen = _format(name := "envi-map")
    try:
        gcps, crs_wkt = chosen.decode(content, context)
        if not every:
            gcps = tuple(gcp for gcp in gcps if gcp.enabled and not band_of(gcp))
            nowhere = [gcp.id for gcp in gcps if not math.isfinite(gcp.column + gcp.row)]
            if nowhere:
                raise GcpFormatError(
                    f"point {nowhere[0]} lacks the pixel of MS, row and col",
                    "Fill it in, take the point out, or let geodelreg refit look for it (`snap`).",
                )
        return gcps, crs_wkt
    except GcpFormatError as error:
        remedy = error.remedy or f"Correct the file, or name its format; {name} was read."
        raise GcpFormatError(f"{source}: {error.cause}", remedy) from error


def in_crs_of(source: Grid, gcps: Sequence[Gcp], crs_wkt: str | None) -> tuple[Gcp, ...]:
    """Points whose map coordinates are in the CRS that their file names, in that of MS.

    Parameters
    ----------
    source : Grid
        Of MS.
    gcps, crs_wkt
        As from `read_gcps`.

    Raises
    ------
    CrsTransformError
    """
    if crs_wkt is None:
        return tuple(gcps)
    moved = map_points(ground_of(gcps), crs_wkt, source.crs_wkt).tolist()
    return tuple(replace(gcp, x=x, y=y) for gcp, (x, y) in zip(gcps, moved, strict=True))


def _content(source: Path, is_text: bool) -> str | Path:
    """Text of a file of bearable size; of what is no text the path."""
    try:
        with source.open("rb") as file:
            data = file.read(_LARGEST_BYTES + 1)
        if len(data) > _LARGEST_BYTES:
            raise GcpFormatError(
                f"{source} is too large for a file of control points, it has more than "
                f"{_LARGEST_BYTES // 1_000_000} MB",
                "Check that it is the right file, or split it into several.",
            )
        if not is_text:
            return source
        return io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig").read()
    except (OSError, UnicodeDecodeError) as error:
        raise GcpFormatError(
            f"{source} cannot be read ({error})", "Check the path; the text must be UTF-8."
        ) from error


def _format(name: str) -> GcpFormat:
    if name not in GCP_FORMATS:
        raise GcpFormatError(f"GCP format {name!r} is unknown", _choices())
    return GCP_FORMATS[name]


def format_of(path: Path, format: str | None = None) -> str:  # noqa: A002 - the field's word
    """The format named, else that of the extension.

    Raises
    ------
    GcpFormatError
    """
    if format is not None:
        return format
    for name, spec in GCP_FORMATS.items():
        if path.suffix.lower() in spec.extensions:
            return name
    raise GcpFormatError(
        f"the extension of {path.name} is that of no GCP format", f"{_choices()} Or name it."
    )


def _choices() -> str:
    texts = [
        f"{name} ({', '.join((*spec.extensions, spec.description))})"
        for name, spec in GCP_FORMATS.items()
    ]
    return f"Formats: {'; '.join(texts)}."
