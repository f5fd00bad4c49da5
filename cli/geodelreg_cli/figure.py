"""The images that ``--figure`` draws the tie points on."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geodelreg.image.reader import RasterReader
    from geodelreg.values.raster import Band
    from geodelreg.values.result import Alignment

LONG_SIDE_PX = 1000


def bands_to_show(alignment: Alignment) -> tuple[Band, Band]:
    """One band of MS and one of PAN, whole and averaged down to `LONG_SIDE_PX`.

    Parameters
    ----------
    alignment : Alignment
        Names the bands: of MS the one with the largest weight, unless the user chose one.

    Returns
    -------
    tuple of Band
    """
    from geodelreg.image.reader import open_raster

    options, weights = alignment.options, alignment.solution.band_weights
    with (
        open_raster(alignment.source.paths, allow=options.allow) as ms,
        open_raster(alignment.reference.paths[0], allow=options.allow) as pan,
    ):
        heaviest = max(weights, key=lambda name: weights[name], default="")
        number = ms.band_names.index(heaviest) + 1 if heaviest in ms.band_names else 1
        return _overview(ms, options.band or number), _overview(pan, options.pan_band)


def _overview(reader: RasterReader, number: int) -> Band:
    from geodelreg.values.raster import Window

    height, width = reader.grid.shape
    factor = max(1.0, max(height, width) / LONG_SIDE_PX)
    shape = max(1, round(height / factor)), max(1, round(width / factor))
    return reader.read([number], Window(0, 0, width, height), shape)[0]
