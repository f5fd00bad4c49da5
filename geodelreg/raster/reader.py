"""Windows of one image, in one file or in one file per band, full size or averaged down."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geodelreg.door.names import LOCAL
from geodelreg.errors import BandNumberError
from geodelreg.geo.grid import decimated_grid
from geodelreg.raster.bands import FileBand, image_files, list_bands
from geodelreg.raster.drawn import leave_out_drawn
from geodelreg.raster.environment import TILES_BYTES, bounded_cache, passing_through
from geodelreg.raster.inputs import AnyMask, AnyRaster, opened, rasters_of
from geodelreg.raster.raster_file import RasterFile
from geodelreg.values.raster import Band, BoolArray, Float32Array, Grid, Window

if TYPE_CHECKING:
    from geodelreg.raster.masks import Masks

_EXACT_PIXELS = 16_000_000
"""Windows up to this size are averaged from full resolution, whatever the overviews hold."""


class RasterReader:
    """An image open for reading; use it as a context manager.  Safe to share between threads.

    Attributes
    ----------
    paths : tuple of str
        Files that hold the bands.
    other_paths : tuple of str
        Files given with them that lie on another grid, or are masks of the others: a correction
        applies to them, too.
    given : tuple of str
        Both, in the order that they were given in.
    in_memory : bool
        One of them at least is no file; its name stands for its path.
    masks : Masks or None
        What hides pixels beyond what the files themselves say; None when nothing does.
    decimations : tuple of float
        Factors at which a decimated read is cheap: 1.0, then the overviews'.
    """

    def __init__(
        self,
        rasters: Sequence[AnyRaster],
        masks: Sequence[AnyMask] | None = None,
        *,
        allow: str = LOCAL,
    ) -> None:
        self._lock = threading.Lock()
        with ExitStack() as stack:
            stack.enter_context(bounded_cache())
            files = [RasterFile(opened(one, stack, allow), stack) for one in rasters]
            self._files = image_files(files)
            self.paths = tuple(file.path for file in self._files)
            self.masks = self._open_masks(files, masks, stack, allow)
            self._stack = stack.pop_all()
        self.given = tuple(file.path for file in files)
        self.in_memory = not all(file.opened.is_file for file in files)
        self.other_paths = tuple(file.path for file in files if file not in self._files)
        self._bands = list_bands(self._files)
        self._stored = [(self._files[band.file], band.number) for band in self._bands]
        self.decimations = self._common_decimations()

    def __enter__(self) -> RasterReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        with self._lock:
            self._stack.close()

    @property
    def grid(self) -> Grid:
        """Grid of the full raster."""
        return self._files[0].grid

    @property
    def name(self) -> str:
        """File name, for messages; that of the first file and the number of the others."""
        name = Path(self.paths[0]).name
        return name if len(self.paths) == 1 else f"{name} and {len(self.paths) - 1} more"

    @property
    def band_names(self) -> tuple[str, ...]:
        """One name per image band, in the order of band numbers; masks and alpha are none."""
        return tuple(band.name for band in self._bands)

    @property
    def dtypes(self) -> tuple[str, ...]:
        """Pixel type of each band, as stored."""
        return tuple(str(of.dataset.dtypes[n - 1]) for of, n in self._stored)

    @property
    def colours(self) -> tuple[str, ...]:
        """What GDAL takes each band for, as ``red``, ``gray`` or ``undefined``."""
        return tuple(str(of.dataset.colorinterp[n - 1].name) for of, n in self._stored)

    @property
    def stored(self) -> tuple[tuple[str, int], ...]:
        """File of each band, and its number there, from 1."""
        return tuple((of.path, n) for of, n in self._stored)

    @property
    def block_note(self) -> str:
        """Says so when one block is too large for a file to be read in pieces; else empty."""
        return "; ".join(file.block_note for file in self._files if file.block_note)

    def leave_out(self, nodata: float | None) -> str:
        """Take a value for no data; None is for fill at the corners that the files do not declare.

        Returns
        -------
        str
            What was found and is left out; empty when nothing was, or when it was told.
        """
        notes = []
        for file in self._files:
            file.nodata = file.undeclared_fill() if nodata is None else nodata
            if nodata is None and file.nodata is not None:
                notes.append(
                    f"{Path(file.path).name} is filled with {file.nodata:g} up to a corner and "
                    "does not declare it: left out (a no-data value that is told is taken instead)"
                )
        return "; ".join(notes)

    def leave_out_drawn(self) -> str:
        """What is drawn on all bands, and no data from now on, in words; empty when nothing is."""
        return leave_out_drawn(self._files, self.name)

    def read(
        self, bands: Sequence[int], window: Window, shape: tuple[int, int] | None = None
    ) -> list[Band]:
        """Read a window.

        Parameters
        ----------
        bands : sequence of int
            Positions in `band_names`, from 1.
        window : Window
            Inside the raster.
        shape : tuple of int, optional
            ``(height, width)`` to average down to, not above the window's.  A pixel is the
            average of its valid part and valid when that is half of it.

        Returns
        -------
        list of Band
            In the order of `bands`, each with the grid of its pixels.

        Raises
        ------
        BandNumberError
        RasterUnreadableError
            If a block cannot be decoded.
        ValueError
            If `window` is not inside the raster, or `shape` larger than it.
        """
        for number in bands:
            check_band(self, number)
        self._check_window(window, shape)
        grid = decimated_grid(self.grid, window, shape)
        wanted = [self._bands[number - 1] for number in bands]
        by_place = attrgetter("file", "number")
        planes: dict[FileBand, tuple[Float32Array, BoolArray]] = {}
        with self._lock:
            for index, group in groupby(sorted(set(wanted), key=by_place), lambda b: b.file):
                stored = list(group)
                numbers = [band.number for band in stored]
                data, valid = self._read_file(self._files[index], numbers, window, grid.shape)
                planes.update(zip(stored, zip(data, valid, strict=True), strict=True))
        if self.masks is not None:
            self.masks.stop_counting()
        return [Band(*planes[band], grid, band.name) for band in wanted]

    def passing(self) -> AbstractContextManager[None]:
        """While this lasts, what is read does not stay in GDAL's cache."""
        return passing_through(TILES_BYTES)

    def _open_masks(
        self, files: list[RasterFile], names: Sequence[AnyMask] | None, stack: ExitStack, allow: str
    ) -> Masks | None:
        """The masks named, and the quality bands of the files."""
        bands = [
            (file.opened, number, kind)
            for file in files
            for number, kind in file.quality_bands.items()
            if number not in file.image_bands
        ]
        if names is None or not (names or bands):
            return None
        from geodelreg.raster.masks import Masks

        masks = Masks(self.grid, self.name, names, bands, stack, allow)
        for file in self._files:
            file.hides = masks.hides
        return masks

    def _check_window(self, window: Window, shape: tuple[int, int] | None) -> None:
        height, width = self.grid.shape
        if (
            min(window.column, window.row) < 0
            or min(window.width, window.height) < 1
            or window.column + window.width > width
            or window.row + window.height > height
        ):
            raise ValueError(f"{window} is not inside the {width} × {height} pixels of {self.name}")
        if shape is not None and not (
            1 <= shape[0] <= window.height and 1 <= shape[1] <= window.width
        ):
            raise ValueError(f"{window} cannot be averaged down to {shape} (height, width)")

    def _read_file(
        self, file: RasterFile, numbers: list[int], window: Window, shape: tuple[int, int]
    ) -> tuple[Float32Array, BoolArray]:
        if shape == (window.height, window.width):
            return file.read(numbers, window)
        return file.read_decimated(numbers, window, shape, self._best_overview(window, shape))

    def _best_overview(self, window: Window, shape: tuple[int, int]) -> int | None:
        if window.width * window.height <= _EXACT_PIXELS:
            return None
        ratio = min(window.width / shape[1], window.height / shape[0]) * (1 + 1e-6)
        fitting = [i for i, factor in enumerate(self.decimations[1:]) if factor <= ratio]
        return fitting[-1] if fitting else None

    def _common_decimations(self) -> tuple[float, ...]:
        factors = [file.overview_factors for file in self._files]
        shared = min(factors, key=len)
        same = all(np.allclose(other[: len(shared)], shared) for other in factors)
        return (1.0, *(shared if same else ()))


def open_raster(
    source: AnyRaster | Sequence[AnyRaster],
    masks: Sequence[AnyMask] | None = None,
    *,
    allow: str = LOCAL,
) -> RasterReader:
    """Open an image for reading: one file, or one file per band.

    Of several files, those on the grid that most of them share hold the bands (on a tie the
    finest grid); the others are listed in `RasterReader.other_paths`.

    Parameters
    ----------
    source : raster or sequence of rasters
        Paths of anything GDAL opens (URLs and ``/vsi…`` paths are passed to it as they are), open
        datasets of rasterio, arrays with their grids, DataArrays or Datasets of xarray.
    masks : sequence of masks, optional
        Masks of the image, ``FILE`` or ``FILE=HIDE``, or arrays that hide where they are not 0.
        Bands and files that are called QA_PIXEL or
        SCL are masks of the others without being named.  None: nothing is masked.
    allow : str
        What may be opened, `AlignOptions.allow`.

    Returns
    -------
    RasterReader
        A context manager.

    Raises
    ------
    RasterNotFoundError, RasterUnreadableError
        If a file is missing, or not a raster with real pixels.
    MissingGeoreferenceError, UnsupportedGeoreferenceError, MissingCrsError
        If a file does not say where it lies, or not through a geotransform.
    BandGridError
        If the files' CRSs differ.
    MaskError, MissingExtraError
        If a mask cannot be used.
    AccessNotAllowedError
        If a name, or what a VRT names, needs more than `allow`.
    ArrayShapeError
        If an array does not fit its grid.
    TypeError
        If it is no raster at all.
    """
    return RasterReader(rasters_of(source), masks, allow=allow)


def check_band(reader: RasterReader, number: int) -> None:
    """Make sure that a band exists.

    Raises
    ------
    BandNumberError
    """
    count = len(reader.band_names)
    if not 1 <= number <= count:
        raise BandNumberError(
            f"{reader.name} has no band {number}",
            f"Use 1 to {count}." if count > 1 else "It has band 1 only.",
        )
