"""Both rasters in one frame, the pixels of PAN."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.geo.grid import outline, window_around
from geodelreg.geo.maps.header import header_map
from geodelreg.geo.maps.lattice import OnLattice
from geodelreg.product.report import lattice
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray, Window
from geodelreg.values.result import Alignment

_PER_EDGE = 16


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """How MS lies on PAN, before and after.

    Attributes
    ----------
    header : PixelMap
        MS header pixels to PAN pixels.
    found : PixelMap
        MS pixels to MS header pixels: what the images say, believed or not.
    sigma : callable
        (N, 2) MS pixels to standard errors of `found`, MS pixels; on the lattice of the JSON
        report, so that one read back shows the same.
    window : Window
        Part of PAN around MS as `found` puts it; where that is nowhere, as its header does; all of
        PAN where that is nowhere either.
    pan_px_per_ms_px : float
    ms_size : tuple of int
        Width and height of MS.
    """

    header: PixelMap
    found: PixelMap
    sigma: OnLattice
    window: Window
    pan_px_per_ms_px: float
    ms_size: tuple[int, int]

    def to_ms(self, pan_px: FloatArray, corrected: bool) -> FloatArray:
        """(..., 2) PAN pixels to the MS pixels that lie there, by the header or corrected."""
        there = self.header.inverse(pan_px)
        return self.found.inverse(there) if corrected else there


def frame_of(alignment: Alignment) -> Frame:
    """The frame of an alignment, refused or not."""
    source, reference = alignment.source.grid, alignment.reference.grid
    header, found = header_map(source, reference), alignment.solution.map
    around = outline(source, _PER_EDGE)
    window = None
    for points in (header.forward(found.forward(around)), header.forward(around)):
        seen = points[np.isfinite(points).all(axis=1)]
        if window is None and len(seen):
            window = window_around(seen, 0.0, reference)
    height, width = source.shape
    local = header.linearise(np.array([[width / 2, height / 2]]))[0, :, :2]
    scale = float(np.sqrt(abs(np.linalg.det(local))))
    whole = Window(0, 0, reference.shape[1], reference.shape[0])
    scale = scale if np.isfinite(scale) else 1.0
    spots = lattice(source.shape)
    alike = np.nan_to_num(alignment.accuracy.systematic_px) / scale
    errors = np.hypot(found.sigma_at(spots.reshape(-1, 2)), alike)
    sigma = OnLattice(errors.reshape(spots.shape[:2]), source.shape)
    return Frame(header, found, sigma, window or whole, scale, (width, height))
