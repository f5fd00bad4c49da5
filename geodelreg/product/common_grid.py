"""MS files and PAN laid onto one grid, lazily: virtual rasters that GDAL reads when asked."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np
from affine import Affine

from geodelreg.door.opening import open_raster
from geodelreg.errors import NoOverlapError, UsageError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geo.grid import gsd_px_m
from geodelreg.geotiff import metadata
from geodelreg.geotiff.header import Provenance
from geodelreg.geotiff.view import corrected_view
from geodelreg.options import WriteOptions
from geodelreg.product.pixels import Validity, grid_of
from geodelreg.product.warp import TOLERANCE_PX, edge_on_ground, warp_pixels, warped_onto
from geodelreg.sharpen_options import PansharpenOptions
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import BoolArray, Grid
from geodelreg.values.result import Correction

_ROUNDING = 1e-3  # of pixel sizes in unlike CRSs


@dataclass(frozen=True, slots=True)
class SpectralFile:
    """An MS file, as it was when it was opened.

    Attributes
    ----------
    path : Path
    correction : Correction
        Where its pixels lie.
    placement : PixelMap or None
        Its pixels to those of its original header, where no geotransform holds that.
    shape : tuple of int
        ``(height, width)`` in pixels.
    bands : sequence of int
        Numbers of the spectral bands, from 1; alpha is none.
    names : sequence of (str or None)
        Of all its bands.
    nodata : float or None
    """

    path: Path
    correction: Correction
    placement: PixelMap | None
    shape: tuple[int, int]
    bands: Sequence[int]
    names: Sequence[str | None]
    nodata: float | None

    @classmethod
    def of(
        cls, path: Path, dataset: Any, correction: Correction, placement: PixelMap | None = None
    ) -> SpectralFile:
        """What must be known of an open file."""
        from rasterio.enums import ColorInterp

        meanings = zip(dataset.indexes, dataset.colorinterp, strict=True)
        bands = [band for band, meaning in meanings if meaning is not ColorInterp.alpha]
        names = metadata.descriptions(dataset)
        return cls(path, correction, placement, dataset.shape, bands, names, dataset.nodata)


@dataclass(frozen=True, slots=True)
class Sharpening:
    """What is sharpened with what.

    Attributes
    ----------
    sources : sequence of SpectralFile
    reference : Path
    pan_band : int
        Band of `reference`, from 1.
    bands : sequence of (int, int)
        The spectral bands: number of the file, from 0, and of the band in it, from 1.
    """

    sources: Sequence[SpectralFile]
    reference: Path
    pan_band: int
    bands: Sequence[tuple[int, int]]


def target_grid(what: Sharpening, pan: Any, extent: str) -> Grid:
    """PAN's grid, or the window of it that covers what MS and PAN share."""
    grid = grid_of(pan)
    if extent == "pan":
        return grid
    low, high = np.zeros(2), np.array(pan.shape[::-1], dtype=np.float64)
    for file in what.sources:
        edge = edge_on_ground(file.correction, file.shape, file.placement)
        ground = map_points(edge, file.correction.crs_wkt, grid.crs_wkt)
        seen = apply_affine(~pan.transform, ground)
        seen = seen[np.isfinite(seen).all(axis=1)]
        if len(seen):
            low, high = np.maximum(low, seen.min(axis=0)), np.minimum(high, seen.max(axis=0))
    first, last = np.floor(low + TOLERANCE_PX), np.ceil(high - TOLERANCE_PX)
    if (last <= first).any():
        raise NoOverlapError(
            f"{what.sources[0].path} and {what.reference} share no ground",
            "Check that both show the same place, or use `extent='pan'`.",
        )
    width, height = (int(n) for n in last - first)
    moved = pan.transform @ Affine.translation(*map(float, first))
    return Grid(moved, (height, width), grid.crs_wkt)


def check_finer(what: Sharpening) -> None:
    """Refuse PAN whose pixels are larger than those of MS: there is nothing to sharpen with.

    Raises
    ------
    UsageError
    """
    with open_raster(what.reference) as pan:
        grid = grid_of(pan)
    for file in what.sources:
        own = Grid(file.correction.corrected, file.shape, file.correction.crs_wkt)
        mine, others = (math.prod(gsd_px_m(one)) ** 0.5 for one in (own, grid))
        if others > mine * (1 + _ROUNDING):
            raise UsageError(
                f"the pixels of PAN ({what.reference.name}, {others:.3g} m) are larger than those "
                f"of MS ({file.path.name}, {mine:.3g} m)",
                "Give the finer raster last, as PAN.",
            )


@contextmanager
def on_grid(what: Sharpening, grid: Grid, resampling: str, scratch: Path) -> Iterator[list[Any]]:
    """The MS files, where their corrections put them, resampled onto a grid when read.

    What no geotransform holds is resampled at once, into a file of the folder `scratch`.
    """
    with ExitStack() as stack:
        files = []
        for number, file in enumerate(what.sources, start=1):
            content = Provenance(file.correction, (), {})
            if file.placement is not None:
                warped = scratch / f"placed{number}.tif"
                options = WriteOptions(warp=True, resampling=resampling)
                warp_pixels(file.path, warped, content, grid, {}, options, file.placement)
                files.append(stack.enter_context(open_raster(warped)))
                continue
            view = corrected_view(file.path, content, mask_rules=True)
            name, _ = stack.enter_context(view)
            dataset = stack.enter_context(open_raster(name))
            lazy = warped_onto(dataset, grid, Validity.of(dataset), resampling)
            files.append(stack.enter_context(lazy))
        yield files


def cover_of(dataset: Any, band: int) -> str:
    """What says where a band is covered, as a source band of GDAL's VRTs: alpha, or its mask.

    GDAL makes masks of alpha for two and four bands only.
    """
    from rasterio.enums import ColorInterp

    is_alpha = dataset.count > 1 and dataset.colorinterp[-1] is ColorInterp.alpha
    return str(dataset.count) if is_alpha else f"mask,{band}"


def covered(dataset: Any, source: str, window: Any = None) -> BoolArray:
    """(H, W) where something covers a dataset, by what `cover_of` says."""
    kind, _, band = source.rpartition(",")
    read = dataset.read_masks if kind else dataset.read
    return np.asarray(read(int(band), window=window) > 0)


@dataclass(frozen=True, slots=True)
class Source:
    """A band of a raster that GDAL opens itself.

    Attributes
    ----------
    path : Path
    band : int or str
        From 1; ``mask,1`` is the mask of band 1.
    kind : str
        GDAL's name of its type.
    """

    path: Path
    band: int | str
    kind: str = "Byte"

    @classmethod
    def of(cls, vrt: Path, band: int) -> Source:
        """A band of a virtual raster, which tells its type."""
        found = ElementTree.parse(vrt).findall("VRTRasterBand")[band - 1]
        return cls(vrt, band, found.get("dataType", "Byte"))

    @property
    def is_mask(self) -> bool:
        """Whether it is the mask of a band."""
        return str(self.band).startswith("mask")

    @property
    def place(self) -> tuple[Path, int]:
        """File, and number of the band, also of a mask."""
        return self.path, int(str(self.band).rpartition(",")[2])

    def xml(self, folder: Path | None) -> str:
        """Name it, relative to `folder` if it lies there."""
        relative, name = self.path.parent == folder, str(self.path)
        if relative:
            name = self.path.name
        elif not name.startswith("/vsi"):
            name = str(self.path.absolute())
        return (
            f'<SourceFilename relativeToVRT="{int(relative)}">{escape(name)}</SourceFilename>'
            f"<SourceBand>{self.band}</SourceBand>"
        )


@dataclass(frozen=True, slots=True)
class Recipe:
    """Everything on one grid, as files that GDAL reads when pixels are asked for.

    Attributes
    ----------
    folder : Path or None
        Of the virtual rasters.
    spectral : list of Source
        Bands to sharpen.
    pan : Source
    covers : list of Source
        What says, all together, what is covered.
    weights : sequence of float
        Of each spectral band in the image that PAN is compared with.
    bit_depth : int or None
        Bits that pixels have at most.
    """

    folder: Path | None
    spectral: list[Source]
    pan: Source
    covers: list[Source]
    weights: Sequence[float]
    bit_depth: int | None


def recipe_of(
    what: Sharpening, out: Path, grid: Grid, weights: Sequence[float], options: PansharpenOptions
) -> Recipe:
    """Write virtual rasters beside `out` that lay everything onto the grid."""
    import rasterio
    import rasterio.shutil

    files = [out.with_name(f"{out.name}.ms{n}.vrt") for n in range(1, len(what.sources) + 1)]
    covers: list[Source] = []
    with on_grid(what, grid, options.resampling, out.parent) as warped:
        for number, (path, lazy) in enumerate(zip(files, warped, strict=True)):
            rasterio.shutil.copy(lazy, path, driver="VRT")
            if what.sources[number].placement is None:
                _name_source(path, what.sources[number].path)
            used = [band for file, band in what.bands if file == number]
            each = used if lazy.nodata is not None else used[:1]
            covers += [Source(path, cover_of(lazy, band)) for band in each]
    pan = Source(what.reference, what.pan_band)
    with open_raster(what.reference) as dataset:
        flags = {flag.name for flag in dataset.mask_flag_enums[what.pan_band - 1]}
        if "all_valid" not in flags or grid.shape != dataset.shape:
            pan = Source(out.with_name(f"{out.name}.pan.vrt"), what.pan_band)
            with warped_onto(dataset, grid, Validity.of(dataset), "nearest") as lazy:
                rasterio.shutil.copy(lazy, pan.path, driver="VRT")
                covers.append(Source(pan.path, cover_of(lazy, what.pan_band)))
            _name_source(pan.path, what.reference)
    spectral = [Source.of(files[file], band) for file, band in what.bands]
    return Recipe(out.parent, spectral, pan, covers, weights, options.bit_depth)


def _name_source(vrt: Path, source: Path) -> None:
    """Let a warped VRT read the file itself; where its pixels lie stands in the VRT."""
    text = vrt.read_text(encoding="utf-8")
    head, _, rest = text.partition("<SourceDataset")
    _, _, tail = rest.partition("</SourceDataset>")
    name = escape(str(source if str(source).startswith("/vsi") else source.absolute()))
    named = f'<SourceDataset relativeToVRT="0">{name}</SourceDataset>'
    vrt.write_text(head + named + tail, encoding="utf-8")
