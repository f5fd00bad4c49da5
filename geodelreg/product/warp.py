"""The corrected raster resampled onto a north-up grid, for software that rejects rotated ones."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from affine import Affine

from geodelreg.door.names import as_path
from geodelreg.door.opening import open_raster
from geodelreg.errors import UnsupportedGeoreferenceError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.grid import outline
from geodelreg.geotiff import compare, metadata, sidecars
from geodelreg.geotiff.atomic import staged
from geodelreg.geotiff.corrected import check_source
from geodelreg.geotiff.environment import gdal_session
from geodelreg.geotiff.header import Provenance
from geodelreg.geotiff.rewrite import gdal_write, output_driver, rewrite, user_creation
from geodelreg.geotiff.srs import keep, spatial_reference
from geodelreg.geotiff.targets import check_not_input
from geodelreg.geotiff.view import corrected_view
from geodelreg.masking import flag_bands
from geodelreg.options import WriteOptions
from geodelreg.product.lookup import looked_up, lookups_of
from geodelreg.product.pixels import Parts, Validity, annotate, copy_pixels, profile_of
from geodelreg.raster.reader import open_raster as open_reader
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import Correction

TOLERANCE_PX = 1e-3
"""Of GDAL's approximation of the way between two CRSs."""

_SNAP_PX = 1e-6
_EDGE_PLACES = 64  # on each edge of a footprint: what bends curves it
_RASTERIO_NAMES = {"cubicspline": "cubic_spline"}
"""Of resamplings whose name in rasterio is not GDAL's."""


def grid_asked(
    options: WriteOptions, reference: Grid, path: Path | None, allow: str
) -> tuple[WriteOptions, Grid, Path | None]:
    """Options with the grid and the file of the reference; those of ``options.like`` stand for it.

    Parameters
    ----------
    options : WriteOptions
    reference : Grid
        Of PAN.
    path : Path, optional
        PAN.
    allow : str
        What may be opened, as in `AlignOptions`.
    """
    if options.like is None:
        return options, reference, path
    with open_reader(options.like, allow=allow) as reader:
        return replace(options, like=None, warp_grid="pan"), reader.grid, as_path(options.like)


def write_warped(
    source: Path,
    target: Path,
    correction: Correction,
    reference: Grid,
    tags: Mapping[str, str],
    options: WriteOptions,
    reference_path: Path | None = None,
    placement: PixelMap | None = None,
    bands: Mapping[int, PixelMap] | None = None,
) -> list[str]:
    """Resample the corrected source raster north-up through GDAL's warper, once.

    Pixels that the source does not cover get its no-data value, or zero alpha, or are masked;
    float rasters that have none of these get NaN.  Colour tables and quality bands are resampled by
    nearest neighbour, whatever is asked for.

    Parameters
    ----------
    source, target : Path
        `target` appears whole or not at all.
    correction : Correction
        ``corrected`` is where the pixels of `source` lie.
    reference : Grid
        Of the PAN raster; the target's with ``options.warp_grid == "pan"``, otherwise unused.
    tags : mapping of str to str
        Provenance, ``GEODELREG_*``.
    options : WriteOptions
    reference_path : Path, optional
        The PAN raster: with its grid the target takes its coordinate epoch, too.
    placement : PixelMap, optional
        Pixels of `source` to those of its original header, where no geotransform holds that:
        ``corrected`` is then not asked.
    bands : mapping of int to PixelMap, optional
        The same of bands, from 1, that lie elsewhere than the others.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    OutputExistsError, OutputIsInputError, OutputUnwritableError, FileLockedError
    LossyOutputError
        The format asked for would change the resampled pixels.
    RasterNotFoundError, RasterUnreadableError, UsageError
    """
    check_not_input(target, [source])
    content = Provenance(correction, (), tags)
    with gdal_session(source):
        check_source(source)
        driver = output_driver(target, options.driver)
        grid = _target_grid(source, correction, reference, options, placement)
        model = reference_path if options.warp_grid == "pan" else source
        onto = None if model is None else spatial_reference(model)
        stale = sidecars.stale_beside(Path(os.path.realpath(target)), source)
        with staged(target, overwrite=options.overwrite, stale=stale) as out:
            creation = user_creation(options) if driver == "GTiff" else {}
            draft = out
            if driver != "GTiff":
                room = max(0, 240 - len(os.fsencode(out.name)))  # the name may tell of flags
                name = f"{out.name}.{source.stem[:room]}.tif"
                draft = out.parent.parent / "scratch" / name
                draft.parent.mkdir()
            with gdal_write(source, target, "GTiff"):
                notes = warp_pixels(
                    source, draft, content, grid, creation, options, placement, bands or {}
                )
            settled = Correction(correction.model, grid.crs_wkt, grid.transform, grid.transform)
            content = Provenance(settled, (), tags)
            kept = keep(onto, draft, target)
            compare.check_placement(draft, target, content)
            if driver != "GTiff":
                notes += rewrite(draft, out, target, content, options)
                kept = keep(onto, out, target)
            notes += kept
    return notes


def north_up_grid(
    correction: Correction, shape: tuple[int, int], placement: PixelMap | None = None
) -> Grid:
    """Grid that covers the corrected footprint with pixels of the original size.

    It continues the original grid where that is north-up, so that rasters which shared a grid
    before still do.

    Parameters
    ----------
    correction : Correction
    shape : tuple of int
        Height and width of the raster.
    placement : PixelMap, optional
        As for `write_warped`.
    """
    places = edge_on_ground(correction, shape, placement)
    (left, bottom), (right, top) = places.min(axis=0), places.max(axis=0)
    original = correction.original
    if original.b == 0 and original.d == 0 and original.a > 0 and original.e < 0:
        pixel_x, pixel_y, anchor = original.a, -original.e, (original.c, original.f)
    else:
        pixel_x, pixel_y = _pixel_size(original)
        anchor = (left, top)
    first_column = math.floor((left - anchor[0]) / pixel_x + _SNAP_PX)
    last_column = math.ceil((right - anchor[0]) / pixel_x - _SNAP_PX)
    first_row = math.floor((anchor[1] - top) / pixel_y + _SNAP_PX)
    last_row = math.ceil((anchor[1] - bottom) / pixel_y - _SNAP_PX)
    x, y = anchor[0] + first_column * pixel_x, anchor[1] - first_row * pixel_y
    transform = Affine(pixel_x, 0.0, float(x), 0.0, -pixel_y, float(y))
    shape = (max(1, last_row - first_row), max(1, last_column - first_column))
    return Grid(transform, shape, correction.crs_wkt)


def edge_on_ground(
    correction: Correction, shape: tuple[int, int], placement: PixelMap | None
) -> FloatArray:
    """(N, 2) map coordinates around what a raster shows, where it really lies."""
    edge = outline(Grid(correction.original, shape, correction.crs_wkt), _EDGE_PLACES)
    if placement is None:
        return apply_affine(correction.corrected, edge)
    return apply_affine(correction.original, placement.forward(edge))


def _pixel_size(transform: Affine) -> tuple[float, float]:
    """Width and height of pixels along the map axes they are nearest to."""
    along_columns = math.hypot(transform.a, transform.d)
    along_rows = math.hypot(transform.b, transform.e)
    if abs(transform.a) >= abs(transform.d):
        return along_columns, along_rows
    return along_rows, along_columns


def _target_grid(
    source: Path,
    correction: Correction,
    reference: Grid,
    options: WriteOptions,
    placement: PixelMap | None,
) -> Grid:
    if options.warp_grid == "pan":
        return reference
    with open_raster(source) as dataset:
        shape = dataset.shape
    try:
        return north_up_grid(correction, shape, placement)
    except (OverflowError, ValueError) as error:
        raise UnsupportedGeoreferenceError(
            f"the corrected geotransform of {source} is too large to be covered by pixels: "
            f"{tuple(correction.corrected)[:6]}",
            "Check the geotransform with gdalinfo, or use `warp_grid='pan'`.",
        ) from error


def warp_pixels(
    source: Path,
    out: Path,
    content: Provenance,
    grid: Grid,
    creation: Mapping[str, str],
    options: WriteOptions,
    placement: PixelMap | None,
    bands: Mapping[int, PixelMap] = MappingProxyType({}),
) -> list[str]:
    """Write a GeoTIFF of a raster on a grid, where it really lies, and return warnings."""
    import rasterio

    notes: list[str] = []
    with corrected_view(source, content, mask_rules=True) as (name, _), open_raster(name) as view:
        resampling, flags = _resampling(source, view, options, notes)
        validity = Validity.of(view)
        if len({repr(value) for value in view.nodatavals}) > 1:
            notes.append(f"{source.name}: bands differ in no-data, the value of band 1 is used")
        profile = profile_of(view, grid, validity)
        profile |= {key.lower(): value for key, value in creation.items()}
        ways = [resampling, *(["nearest"] if flags else [])]
        with ExitStack() as stack:

            def parts_of(placement: PixelMap | None) -> Parts:
                parts = []
                for lookup in lookups_of(placement, content.correction, grid, view.shape):
                    plain = [
                        stack.enter_context(warped_onto(view, grid, validity, w)) for w in ways
                    ]
                    if lookup is not None:
                        plain = [stack.enter_context(looked_up(name, one, lookup)) for one in plain]
                    parts.append(plain)
                return parts

            rest = [number for number in view.indexes if number not in bands]
            layers = [(rest, parts_of(placement))] if rest else []
            layers += [([number], parts_of(bands[number])) for number in sorted(bands)]
            dataset = stack.enter_context(rasterio.open(out, "w", **profile))
            annotate(view, dataset)
            copy_pixels(layers, flags, dataset, validity)
    _copy_overviews(source, out, "nearest" if flags or resampling == "nearest" else "average")
    compare.check_decodable(out)
    return notes


def _resampling(
    source: Path, view: Any, options: WriteOptions, notes: list[str]
) -> tuple[str, tuple[int, ...]]:
    """Resampling of the bands, and numbers of those that are resampled by nearest neighbour."""
    from rasterio.enums import ColorInterp

    if options.resampling == "nearest":
        return "nearest", ()
    if ColorInterp.palette in view.colorinterp:
        notes.append("values of a colour table cannot be averaged; resampled by nearest neighbour")
        return "nearest", ()
    names = metadata.descriptions(view)
    flags = flag_bands(source.name, names)
    if flags:
        which = " and ".join(f"{n} ({names[n - 1]})" if names[n - 1] else str(n) for n in flags)
        notes.append(
            f"{source.name}: flags in band{'s' * (len(flags) > 1)} {which} cannot be averaged; "
            "these bands, and all overviews, are resampled by nearest neighbour"
        )
    return options.resampling, flags


@contextmanager
def warped_onto(view: Any, grid: Grid, validity: Validity, resampling: str) -> Iterator[Any]:
    """An open raster on a grid, resampled when read; its masks say what is covered."""
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    height, width = grid.shape
    settings: dict[str, Any] = {"nodata": validity.nodata, "src_nodata": validity.nodata}
    if validity.alpha_band is not None:
        settings = {"src_alpha": validity.alpha_band, "dst_alpha": validity.alpha_band}
    elif validity.is_mask:
        settings = {"add_alpha": True}
    with WarpedVRT(
        view,
        crs=grid.crs_wkt,
        transform=grid.transform,
        width=width,
        height=height,
        resampling=Resampling[_RASTERIO_NAMES.get(resampling, resampling)],
        tolerance=TOLERANCE_PX,
        UNIFIED_SRC_NODATA="PARTIAL",  # each band has its own gaps
        **settings,
    ) as warped:
        yield warped


def _copy_overviews(source: Path, out: Path, resampling: str) -> None:
    import rasterio
    from rasterio.enums import Resampling

    with open_raster(source) as dataset:
        factors = dataset.overviews(1)
    if factors:
        with rasterio.open(out, "r+") as dataset:
            dataset.build_overviews(factors, Resampling[resampling])
