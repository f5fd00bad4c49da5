"""The corrected raster resampled onto a north-up grid, for software that rejects rotated ones."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

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
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import BoolArray, FloatArray, Grid
from geodelreg.values.result import Correction

TOLERANCE_PX = 1e-3
"""Of GDAL's approximation of the way between two CRSs."""

_BLOCK_PX = 256
_SNAP_PX = 1e-6
_EDGE_PLACES = 64  # on each edge of a footprint: what bends curves it
_EXACT_PX = 1e-6
_RASTERIO_NAMES = {"cubicspline": "cubic_spline"}
"""Of resamplings whose name in rasterio is not GDAL's."""

_NOT_CARRIED = metadata.GDAL_DOMAINS | {"GEOLOCATION"}


@dataclass(frozen=True, slots=True)
class Validity:
    """How pixels without a value are marked: by a value, by the alpha band, or by a mask."""

    nodata: float | None = None
    alpha_band: int | None = None

    @property
    def is_mask(self) -> bool:
        """Neither a value nor the alpha band."""
        return self.nodata is None and self.alpha_band is None

    def missing(self, data: NDArray[Any]) -> BoolArray:
        """(B or 1, H, W) where (B, H, W) pixels have no value; of a mask it is the last band."""
        if self.nodata is None:
            band = data[-1 if self.alpha_band is None else self.alpha_band - 1]
            return np.asarray(band == 0)[None]
        return np.isnan(data) if math.isnan(self.nodata) else np.asarray(data == self.nodata)

    @classmethod
    def of(cls, dataset: Any) -> Validity:
        """How an open raster marks them."""
        from rasterio.enums import ColorInterp, MaskFlags

        if dataset.count > 1 and dataset.colorinterp[-1] is ColorInterp.alpha:
            return cls(alpha_band=dataset.count)
        if MaskFlags.per_dataset in dataset.mask_flag_enums[0]:
            return cls()
        if dataset.nodata is not None:
            return cls(nodata=dataset.nodata)
        is_float = all(np.issubdtype(np.dtype(name), np.floating) for name in dataset.dtypes)
        return cls(nodata=math.nan) if is_float else cls()


def write_warped(
    source: Path,
    target: Path,
    correction: Correction,
    reference: Grid,
    tags: Mapping[str, str],
    options: WriteOptions,
    reference_path: Path | None = None,
    placement: PixelMap | None = None,
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
                notes = warp_pixels(source, draft, content, grid, creation, options, placement)
            settled = Correction(correction.model, grid.crs_wkt, grid.transform, grid.transform)
            content = Provenance(settled, (), tags)
            kept = keep(onto, draft, target)
            compare.check_placement(draft, target, content, _EXACT_PX)
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
        grid = reference
    else:
        with open_raster(source) as dataset:
            shape = dataset.shape
        try:
            grid = north_up_grid(correction, shape, placement)
        except (OverflowError, ValueError) as error:
            raise UnsupportedGeoreferenceError(
                f"the corrected geotransform of {source} is too large to be covered by pixels: "
                f"{tuple(correction.corrected)[:6]}",
                "Check the geotransform with gdalinfo, or use `warp_grid='pan'`.",
            ) from error
    return grid


def warp_pixels(
    source: Path,
    out: Path,
    content: Provenance,
    grid: Grid,
    creation: Mapping[str, str],
    options: WriteOptions,
    placement: PixelMap | None,
) -> list[str]:
    """Write a GeoTIFF of a raster on a grid, where it really lies, and return warnings."""
    import rasterio

    notes: list[str] = []
    with corrected_view(source, content, mask_rules=True) as (name, _), open_raster(name) as view:
        resampling, flags = _resampling(source, view, options, notes)
        validity = Validity.of(view)
        if len({repr(value) for value in view.nodatavals}) > 1:
            notes.append(f"{source.name}: bands differ in no-data, the value of band 1 is used")
        profile = _profile(view, grid, validity)
        profile |= {key.lower(): value for key, value in creation.items()}
        lookups = lookups_of(placement, content.correction, grid, view.shape)
        with ExitStack() as stack:
            parts = []
            for lookup in lookups:
                ways = [resampling, *(["nearest"] if flags else [])]
                plain = [stack.enter_context(warped_onto(view, grid, validity, w)) for w in ways]
                if lookup is not None:
                    plain = [stack.enter_context(looked_up(name, one, lookup)) for one in plain]
                parts.append(plain)
            dataset = stack.enter_context(rasterio.open(out, "w", **profile))
            _annotate(view, dataset)
            _copy_pixels(parts, flags, dataset, validity)
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
    names = metadata.attribute(view, "descriptions") or (None,) * view.count
    flags = flag_bands(source.name, names)
    if flags:
        which = " and ".join(f"{n} ({names[n - 1]})" if names[n - 1] else str(n) for n in flags)
        notes.append(
            f"{source.name}: flags in band{'s' * (len(flags) > 1)} {which} cannot be averaged; "
            "these bands, and all overviews, are resampled by nearest neighbour"
        )
    return options.resampling, flags


def _profile(view: Any, grid: Grid, validity: Validity) -> dict[str, Any]:
    from rasterio.enums import ColorInterp

    kinds = {np.dtype(compare.numpy_type(name)).kind for name in view.dtypes}
    predictor = {"f": "3", "i": "2", "u": "2"}.get(kinds.pop()) if len(kinds) == 1 else None
    photometric = {
        (ColorInterp.red, ColorInterp.green, ColorInterp.blue): "RGB",
        (ColorInterp.palette,): None,
    }.get(view.colorinterp[:3], "MINISBLACK")
    height, width = grid.shape
    return {
        "driver": "GTiff",
        "height": height,
        "width": width,
        "count": view.count,
        "dtype": view.dtypes[0],
        "crs": grid.crs_wkt,
        "transform": grid.transform,
        "nodata": validity.nodata,
        "tiled": "YES",
        "blockxsize": str(_BLOCK_PX),
        "blockysize": str(_BLOCK_PX),
        "compress": "DEFLATE",
        "predictor": predictor or "1",
        "bigtiff": "IF_SAFER",
        "interleave": view.interleaving.value if view.interleaving else "pixel",
        **({"photometric": photometric} if photometric else {}),
    }


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


def _annotate(view: Any, dataset: Any) -> None:
    """Give the output what describes the bands, apart from statistics of the old pixels."""
    if view.dtypes[0] in ("uint8", "uint16"):
        _copy_colormaps(view, dataset)
    dataset.colorinterp = view.colorinterp
    dataset.descriptions = metadata.attribute(view, "descriptions") or (None,) * view.count
    dataset.scales, dataset.offsets = view.scales, view.offsets
    dataset.units = [unit or "" for unit in metadata.attribute(view, "units") or [""] * view.count]
    for band in (0, *view.indexes):
        domains = metadata.domains(view, band) - _NOT_CARRIED
        for domain in sorted(name for name in domains if not name.startswith("xml:")):
            items = metadata.tags(view, band, domain)
            kept = {k: v for k, v in items.items() if not k.startswith("STATISTICS_")}
            dataset.update_tags(band, ns=domain or None, **kept)


def _copy_colormaps(view: Any, dataset: Any) -> None:
    for band in view.indexes:
        colormap = metadata.colormap(view, band)
        if colormap is not None:
            dataset.write_colormap(band, colormap)


def _copy_pixels(
    parts: Sequence[Sequence[Any]], flags: Sequence[int], dataset: Any, validity: Validity
) -> None:
    """Copy window by window; of parts that overlap the first that has a pixel gives it."""
    for window in compare.windows_of(dataset):
        data = None
        for warped, *nearest in parts:
            here = warped.read(window=window)
            for flat in nearest:
                here[[number - 1 for number in flags]] = flat.read(list(flags), window=window)
            data = here if data is None else np.where(validity.missing(data), here, data)
        assert data is not None
        dataset.write(data[: dataset.count], window=window)
        if validity.is_mask:
            dataset.write_mask(data[-1] != 0, window=window)


def _copy_overviews(source: Path, out: Path, resampling: str) -> None:
    import rasterio
    from rasterio.enums import Resampling

    with open_raster(source) as dataset:
        factors = dataset.overviews(1)
    if factors:
        with rasterio.open(out, "r+") as dataset:
            dataset.build_overviews(factors, Resampling[resampling])
