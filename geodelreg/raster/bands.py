"""Which of the files given are one image, and its bands."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geodelreg.errors import BandGridError
from geodelreg.raster.environment import gdal_calls
from geodelreg.raster.raster_file import RasterFile
from geodelreg.values.raster import Grid


@dataclass(frozen=True, slots=True)
class FileBand:
    """Where a band of the image is stored.

    Attributes
    ----------
    file : int
        Index of the file.
    number : int
        Band of that file, from 1.
    name : str
    """

    file: int
    number: int
    name: str


def image_files(files: list[RasterFile]) -> list[RasterFile]:
    """Files that make up the image: they show something, on the grid that most of them share.

    Raises
    ------
    BandGridError
        Files have different coordinate reference systems.
    """
    return _on_the_common_grid(_with_image_bands(files))


def _with_image_bands(files: list[RasterFile]) -> list[RasterFile]:
    """Files that show something; of nothing but quality bands, their bands are the image."""
    showing = [file for file in files if file.image_bands]
    for file in [] if showing else files:
        file.image_bands = tuple(file.quality_bands)
    return showing or files


def _on_the_common_grid(files: list[RasterFile]) -> list[RasterFile]:
    """Files on the grid that most of them share; on a tie the finest."""
    from rasterio.crs import CRS

    first = files[0]
    with gdal_calls():
        crs = CRS.from_wkt(first.grid.crs_wkt)
        for file in files[1:]:
            if file.grid.crs_wkt != first.grid.crs_wkt and CRS.from_wkt(file.grid.crs_wkt) != crs:
                raise BandGridError(
                    f"{first.path} and {file.path} have different coordinate reference systems",
                    "Bands of one image share one; align images with different ones separately.",
                )
    groups: list[list[RasterFile]] = []
    for file in files:
        group = next((g for g in groups if _same_grid(g[0].grid, file.grid)), None)
        if group is None:
            groups.append([file])
        else:
            group.append(file)
    return max(groups, key=lambda g: (len(g), -abs(g[0].grid.transform.determinant)))


def _same_grid(one: Grid, other: Grid) -> bool:
    """Same size, and no corner apart by more than a thousandth of a pixel."""
    if one.shape != other.shape:
        return False
    height, width = one.shape
    offset = ~one.transform @ other.transform
    corners = ((0, 0), (width, 0), (0, height), (width, height))
    return all(np.hypot(*np.subtract(offset @ corner, corner)) <= 1e-3 for corner in corners)


def list_bands(files: list[RasterFile]) -> list[FileBand]:
    """Image bands of the files, in their order; no two have one name."""
    bands: list[FileBand] = []
    taken: set[str] = set()
    for index, file in enumerate(files):
        descriptions = file.dataset.descriptions
        for number in file.image_bands:
            name = descriptions[number - 1] or f"band {number}"
            if len(files) > 1:
                stem = Path(file.path).stem
                name = stem if len(file.image_bands) == 1 else f"{stem} {name}"
            if name in taken:
                name = f"{name} ({len(bands) + 1})"
            taken.add(name)
            bands.append(FileBand(index, number, name))
    return bands
