"""Where a registration stands between its steps."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geodelreg.errors import CrsTransformError, UnsupportedGeoreferenceError
from geodelreg.fit.models import Frame
from geodelreg.geo.affine import affine_from_matrix, apply_affine
from geodelreg.geo.crs import HeaderMapping, header_mapping, linearise
from geodelreg.geo.grid import gsd_px_m
from geodelreg.options import AlignOptions
from geodelreg.types import FloatArray, WindowReader

MOST_BANDS = 12
"""Bands of a hyperspectral image that are matched on at most."""

_LARGEST_RATIO = 1e4
"""Of the largest pixel size of the two rasters to the smallest."""

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """The two rasters and how their headers relate them.

    Attributes
    ----------
    source, reference : WindowReader
        MS and PAN.
    source_bands : tuple of int
        MS bands to match on, from 1.
    mapping : HeaderMapping
        MS pixels to PAN pixels, as the headers claim.
    source_gsd_m, reference_gsd_m : (float, float)
        Ground size of a pixel along columns and rows.
    options : AlignOptions
    """

    source: WindowReader
    reference: WindowReader
    source_bands: tuple[int, ...]
    mapping: HeaderMapping
    source_gsd_m: tuple[float, float]
    reference_gsd_m: tuple[float, float]
    options: AlignOptions

    @property
    def source_is_coarser(self) -> bool:
        """True when an MS pixel is at least as large as a PAN pixel."""
        return self.source_area_ratio >= 1.0 - 1e-6

    @property
    def source_area_ratio(self) -> float:
        """Area of an MS pixel over that of a PAN pixel."""
        mine, other = self.source_gsd_m, self.reference_gsd_m
        return (mine[0] * mine[1]) / (other[0] * other[1])

    @property
    def pan_px_per_source_px(self) -> float:
        """GSD ratio: PAN pixels to one MS pixel."""
        return float(np.sqrt(self.source_area_ratio))

    @property
    def through_proj(self) -> bool:
        """True when coordinates, or sizes of pixels, come from PROJ."""
        return self.mapping.matrix is None or None in (
            self.source.grid.unit_m,
            self.reference.grid.unit_m,
        )

    @property
    def threads(self) -> int:
        """Threads to use."""
        return self.options.threads or os.cpu_count() or 1

    def frame(self) -> Frame:
        """Coordinates for fitting: the MS raster's centre, half its longer side, metric axes."""
        height, width = self.source.grid.shape
        t = self.source.grid.transform
        unit = np.array([[t.a, t.b], [t.d, t.e]])
        unit = unit / np.hypot(unit[0], unit[1])
        skew = unit * np.array(self.source_gsd_m)
        return Frame((width / 2, height / 2), max(height, width) / 2, tuple(skew.ravel().tolist()))

    def corners(self) -> FloatArray:
        """(4, 2) corners of the MS raster, pixels."""
        height, width = self.source.grid.shape
        return np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])

    def lattice(self) -> FloatArray:
        """(25, 2) pixels spread over the MS raster, its corners included."""
        height, width = self.source.grid.shape
        columns, rows = np.meshgrid(np.linspace(0, width, 5), np.linspace(0, height, 5))
        return np.stack([columns.ravel(), rows.ravel()], axis=1)

    def to_reference(self, matrix: FloatArray, source_px: FloatArray) -> FloatArray:
        """(..., 2) MS pixels to PAN pixels through a correction `matrix` (2, 3) and the headers."""
        return self.mapping.forward(apply_affine(affine_from_matrix(matrix), source_px))

    def to_source(self, matrix: FloatArray, reference_px: FloatArray) -> FloatArray:
        """(..., 2) PAN pixels to MS pixels, the inverse of `to_reference`."""
        header_px = self.mapping.inverse(reference_px)
        return apply_affine(~affine_from_matrix(matrix), header_px)

    def header_px(
        self, reference_px: FloatArray, covariance_px2: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """PAN positions with covariances, as MS header pixels.

        Parameters
        ----------
        reference_px : (N, 2) float64
        covariance_px2 : (N, 2, 2) float64
            In PAN pixels squared.

        Returns
        -------
        (N, 2) and (N, 2, 2) float64, in MS pixels.
        """
        local = linearise(self.mapping.inverse, reference_px)
        jacobian = local[:, :, :2]
        covariance = np.einsum("pij,pjk,plk->pil", jacobian, covariance_px2, jacobian)
        return local[:, :, 2], covariance


def bands_asked(source: WindowReader, options: AlignOptions) -> tuple[int, ...]:
    """MS bands to look at, from 1: the one asked for, or all, or as many as help, evenly spread."""
    count = len(source.band_names)
    if options.band:
        return (options.band,)
    spread = np.linspace(1, count, min(count, MOST_BANDS)).round()
    return tuple(int(number) for number in spread)


def make_pair(source: WindowReader, reference: WindowReader, options: AlignOptions) -> Pair:
    """Relate two rasters by their headers.

    Raises
    ------
    CrsTransformError
        If PROJ knows no operation between the CRSs.
    UnsupportedGeoreferenceError
        If the pixels of the two cannot be compared.
    """
    try:
        sizes = gsd_px_m(source.grid), gsd_px_m(reference.grid)
        mapping = header_mapping(source.grid, reference.grid)
    except CrsTransformError as error:
        raise CrsTransformError(
            f"{source.name} and {reference.name}: {error.cause}", error.remedy
        ) from error
    _check_sizes(source, reference, np.array(sizes))
    return Pair(source, reference, bands_asked(source, options), mapping, *sizes, options)


def _check_sizes(source: WindowReader, reference: WindowReader, gsd_m: FloatArray) -> None:
    """Refuse headers whose pixels are absurd: filters and grids grow with the ratio of sizes."""
    known = np.isfinite(gsd_m).all() and gsd_m.min() > 0
    if known and gsd_m.max() <= _LARGEST_RATIO * gsd_m.min():
        return
    texts = [f"{across:.4g} × {down:.4g} m" for across, down in gsd_m.tolist()]
    raise UnsupportedGeoreferenceError(
        f"by their headers, pixels of {source.name} measure {texts[0]} and those of "
        f"{reference.name} {texts[1]}, which cannot be compared",
        "Correct the geotransform that is wrong: gdal_edit.py -a_ullr ULX ULY LRX LRY FILE.",
    )


def part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Progress of one of several equal parts."""
    if progress is None:
        return None
    show = progress
    return lambda fraction, step: show((number + fraction) / count, step)
