"""Arrays that read like open raster files: numpy's, dask's, and those of xarray with rioxarray."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from geodelreg.errors import (
    ArrayShapeError,
    MissingCrsError,
    MissingExtraError,
    RasterUnreadableError,
)
from geodelreg.geo.pixel import corner_to_centre, pixel_centres
from geodelreg.raster.chunks import Chunks, Fetch
from geodelreg.values.raster import Grid

_CODE = re.compile(r"[A-Za-z]+:[\w.]+$")
_UNEVEN_PX = 1e-2
"""Coordinates may stray by as much from a grid: some formats keep them in single precision."""
_EXACT_PX = 1e-6
"""A geotransform that agrees with the coordinates so well is their origin, and has more digits."""


@dataclass(frozen=True, slots=True)
class ArrayDataset:
    """What `RasterFile` and `RasterMask` ask an open rasterio dataset, answered from an array.

    Attributes
    ----------
    name : str
        For messages.
    fetch : callable
        Pixels of a window of a band; called for what is needed only.
    shape : tuple of int
        ``(height, width)``.
    dtypes : tuple of str
        Of each band.
    transform : Affine
    crs : rasterio.crs.CRS or None
    descriptions : tuple of (str or None)
    nodatavals : tuple of (float or None)
    block : tuple of int
        Rows and columns that are cheap to read together.
    is_masked : bool
        Windows are masked arrays.
    """

    name: str
    fetch: Fetch
    shape: tuple[int, int]
    dtypes: tuple[str, ...]
    transform: Affine
    crs: Any
    descriptions: tuple[str | None, ...]
    nodatavals: tuple[float | None, ...]
    block: tuple[int, int]
    is_masked: bool = False
    gcps: tuple[tuple[()], None] = field(default=((), None), init=False)
    rpcs: None = field(default=None, init=False)

    @property
    def count(self) -> int:
        """Number of bands."""
        return len(self.dtypes)

    @property
    def height(self) -> int:
        """Rows."""
        return self.shape[0]

    @property
    def width(self) -> int:
        """Columns."""
        return self.shape[1]

    @property
    def block_shapes(self) -> list[tuple[int, int]]:
        """`block` of each band."""
        return [self.block] * self.count

    @property
    def profile(self) -> dict[str, str]:
        """Bands are read one by one."""
        return {"interleave": "band"}

    @property
    def colorinterp(self) -> tuple[None, ...]:
        """No band is known to be alpha."""
        return (None,) * self.count

    @property
    def mask_flag_enums(self) -> list[list[Any]]:
        """Bands of masked arrays have masks of their own, as GDAL says it."""
        from rasterio.enums import MaskFlags

        return [[] if self.is_masked else [MaskFlags.all_valid]] * self.count

    def overviews(self, band: int) -> list[int]:
        """There are none of an array."""
        return []

    def read(self, bands: int | Sequence[int], window: tuple[Any, Any]) -> NDArray[Any]:
        """Pixels (h, w) of a band, or (B, h, w) of several, counted from 1.

        Raises
        ------
        RasterUnreadableError
            Whatever has made the pixels failed.
        """
        if isinstance(bands, int):
            return np.ma.getdata(self._pixels(bands, window))
        return np.stack([np.ma.getdata(self._pixels(band, window)) for band in bands])

    def read_masks(
        self, band: int, window: tuple[Any, Any], out_shape: tuple[int, int] | None = None
    ) -> NDArray[np.uint8]:
        """(h, w) 255 where a masked array is valid."""
        hidden = np.ma.getmaskarray(self._pixels(band, window))
        return np.where(hidden, np.uint8(0), np.uint8(255))

    def _pixels(self, band: int, window: tuple[Any, Any]) -> NDArray[Any]:
        rows, columns = (slice(*edges) for edges in window)
        try:
            pixels = self.fetch(band - 1, rows, columns)
            pixels = pixels if isinstance(pixels, np.ma.MaskedArray) else np.asarray(pixels)
            expected = (rows.stop - rows.start, columns.stop - columns.start)
            if pixels.shape != expected:
                raise ValueError(f"shape {pixels.shape} instead of {expected}")
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise RasterUnreadableError(
                f"{self.name}: the pixels of columns {columns.start} to {columns.stop}, rows "
                f"{rows.start} to {rows.stop} cannot be computed ({reason})",
                "Compute that part of the array by itself to see what fails.",
            ) from error
        return pixels.astype(np.uint8) if pixels.dtype.kind == "b" else pixels


def is_xarray(raster: object) -> bool:
    """Whether it is an xarray DataArray or Dataset."""
    module = type(raster).__module__.partition(".")[0]
    return module == "xarray" and hasattr(raster, "dims")


def array_dataset(array: Any, grid: Grid, name: str) -> ArrayDataset:
    """Give an array of (H, W) or (B, H, W) its grid.

    Parameters
    ----------
    array : array
        Anything that has a shape and a dtype and gives numpy arrays when it is cut: of numpy,
        masked or not, memory-mapped, of dask, zarr or h5py.
    grid : Grid
        Its `crs_wkt` may be a code, ``EPSG:32618``.
    name : str
        For messages.

    Raises
    ------
    ArrayShapeError, MissingCrsError
    TypeError
        It holds no numbers, or the grid no geotransform.
    """
    if not isinstance(grid.transform, Affine):
        raise TypeError(f"the transform of the grid of {name} is no Affine: {grid.transform!r}")
    shape = tuple(int(side) for side in array.shape)
    if len(shape) not in (2, 3) or shape[-2:] != tuple(grid.shape) or 0 in shape:
        raise ArrayShapeError(
            f"{name} has the shape {shape}, and its grid is {grid.shape[0]} rows of "
            f"{grid.shape[1]} columns",
            "Give an array (rows, columns) or (bands, rows, columns), and the grid of its pixels.",
        )
    count = shape[0] if len(shape) == 3 else 1

    def fetch(band: int, rows: slice, columns: slice) -> Any:
        return array[band, rows, columns] if len(shape) == 3 else array[rows, columns]

    chunks = getattr(array, "chunks", None)
    return ArrayDataset(
        name=name,
        fetch=_kept(fetch, chunks[-2:] if chunks else (), array.dtype),
        shape=(shape[-2], shape[-1]),
        dtypes=(_number_type(array.dtype, name),) * count,
        transform=grid.transform,
        crs=_crs(grid.crs_wkt, name),
        descriptions=(None,) * count,
        nodatavals=(None,) * count,
        block=_block(chunks[-2:] if chunks else (), shape),
        is_masked=isinstance(array, np.ma.MaskedArray),
    )


def xarray_dataset(raster: Any, name: str) -> ArrayDataset:
    """A DataArray, or the variables of a Dataset, read window by window.

    Parameters
    ----------
    raster : xarray.DataArray or xarray.Dataset
        It is placed by its coordinates; where it has none, by the geotransform that rioxarray
        has written.  Dask arrays are computed where a window needs them.
    name : str
        For messages.

    Raises
    ------
    ArrayShapeError
        Its dimensions are not rows, columns and perhaps bands, or its coordinates no grid.
    MissingExtraError
        rioxarray is not installed.
    TypeError
        It holds no numbers.
    """
    if find_spec("rioxarray") is None:
        raise MissingExtraError(
            f"{name}: where it lies is read with rioxarray", "Install it: pip install rioxarray."
        )
    import rioxarray
    from rioxarray.exceptions import MissingSpatialDimensionError

    del rioxarray  # it adds `rio` to what xarray makes
    try:
        rows, columns = raster.rio.y_dim, raster.rio.x_dim
    except MissingSpatialDimensionError as error:
        raise ArrayShapeError(
            f"{name} has no rows and columns among its dimensions {tuple(raster.dims)}",
            'Name them: raster.rio.set_spatial_dims("x", "y").',
        ) from error
    is_array = not hasattr(raster, "data_vars")
    variables = [raster] if is_array else list(raster.data_vars.values())
    planes = [
        plane
        for variable in variables
        if {rows, columns} <= set(variable.dims)
        for plane in _planes(variable, rows, columns, name)
    ]
    if not planes:
        raise ArrayShapeError(f"{name} has no variable with rows and columns", "Select some.")

    def fetch(band: int, in_rows: slice, in_columns: slice) -> Any:
        return planes[band][1].isel({rows: in_rows, columns: in_columns}).values

    shape = (int(raster.sizes[rows]), int(raster.sizes[columns]))
    first = planes[0][1]
    preferred = first.encoding.get("preferred_chunks", {})
    chunks = first.chunks or tuple(preferred.get(side, 0) for side in (rows, columns))
    return ArrayDataset(
        name=name,
        fetch=_kept(fetch, chunks, first.dtype),
        shape=shape,
        dtypes=tuple(_number_type(plane.dtype, name) for _, plane in planes),
        transform=_transform(raster, rows, columns, name),
        crs=raster.rio.crs,
        descriptions=tuple(text for text, _ in planes),
        nodatavals=tuple(_finite(plane.rio.nodata) for _, plane in planes),
        block=_block(chunks, shape),
    )


def placed_again(raster: Any, transform: Affine) -> Any:
    """The same DataArray or Dataset on a grid of other coordinates.

    Parameters
    ----------
    raster : xarray.DataArray or xarray.Dataset
    transform : Affine
        A rotated one has no coordinates along rows and columns; they are dropped.
    """
    rows, columns = raster.rio.y_dim, raster.rio.x_dim
    placed = raster.drop_vars([side for side in (rows, columns) if side in raster.coords])
    if transform.b == 0 and transform.d == 0:
        x = transform.c + transform.a * pixel_centres(np.arange(raster.sizes[columns]))
        y = transform.f + transform.e * pixel_centres(np.arange(raster.sizes[rows]))
        kept = {s: raster.coords[s].attrs for s in (rows, columns) if s in raster.coords}
        placed = placed.assign_coords(
            {columns: (columns, x, kept.get(columns)), rows: (rows, y, kept.get(rows))}
        )
    return placed.rio.write_transform(transform)


def _planes(variable: Any, rows: str, columns: str, name: str) -> list[tuple[str | None, Any]]:
    """Name and (H, W) DataArray of each band of a variable."""
    others = [side for side in variable.dims if side not in (rows, columns)]
    if len(others) > 1 or 0 in variable.shape:
        raise ArrayShapeError(
            f"{name} has the dimensions {dict(variable.sizes)}",
            f"Select one of all but rows, columns and bands, e.g. .isel({others[0]}=0)."
            if others
            else "Give one with pixels.",
        )
    if not others:
        return [(str(variable.name) if variable.name else None, variable.transpose(rows, columns))]
    count = variable.sizes[others[0]]
    return [
        (text, variable.isel({others[0]: band}).transpose(rows, columns))
        for band, text in enumerate(_band_names(variable, others[0], count))
    ]


def _band_names(variable: Any, side: str, count: int) -> Iterable[str | None]:
    """Descriptions as rioxarray keeps them, or labels of the dimension."""
    texts = variable.attrs.get("long_name")
    if isinstance(texts, tuple | list) and len(texts) == count:
        return map(str, texts)
    if side in variable.coords and variable.coords[side].dtype.kind in "UOT":
        return map(str, variable.coords[side].values)
    return (None,) * count


def _transform(raster: Any, rows: str, columns: str, name: str) -> Affine:
    """Geotransform by the coordinates, which count more than what is written beside them."""
    written = raster.rio.transform(recalc=False)
    if not {rows, columns} <= set(raster.coords):
        return Affine(*tuple(written)[:6])
    steps = []
    for side in (columns, rows):
        values = np.asarray(raster.coords[side].values, dtype=np.float64)
        step = (values[-1] - values[0]) / (len(values) - 1) if len(values) > 1 else np.nan
        even = values[0] + step * np.arange(len(values))
        if len(values) > 1 and not np.abs(values - even).max() <= _UNEVEN_PX * abs(step):
            raise ArrayShapeError(
                f"the coordinates {side} of {name} are not evenly spaced",
                "Resample it onto a grid first: raster.rio.reproject(…).",
            )
        steps.append((values, step))
    (x, across), (y, down) = steps
    across = written.a if np.isnan(across) else across
    down = written.e if np.isnan(down) else down
    corner = Affine.translation(x[0], y[0]) @ Affine.scale(across, down)
    found = corner @ Affine.translation(*corner_to_centre(np.zeros(2)))
    if abs(found.determinant) > 0:
        apart = ~found @ written
        corners = [(0, 0), (len(x), len(y))]
        if all(np.abs(np.subtract(apart @ c, c)).max() <= _EXACT_PX for c in corners):
            return Affine(*tuple(written)[:6])
    return Affine(*(float(value) for value in tuple(found)[:6]))


def _kept(fetch: Fetch, chunks: Sequence[Any], dtype: Any) -> Fetch:
    """Keep chunks of dask, which would be computed again for the next window."""
    if len(chunks) != 2 or not all(isinstance(sizes, tuple) for sizes in chunks):
        return fetch
    return Chunks(fetch, (chunks[0], chunks[1]), np.dtype(dtype).itemsize)


def _block(chunks: Sequence[Any], shape: Sequence[int]) -> tuple[int, int]:
    """Largest chunk, or a row where there are none."""
    sides = [max(sizes) if isinstance(sizes, tuple) else sizes for sizes in chunks]
    height, width = sides if len(sides) == 2 and all(sides) else (1, shape[-1])
    return int(min(height, shape[-2])), int(min(width, shape[-1]))


def _finite(nodata: Any) -> float | None:
    return None if nodata is None or np.isnan(nodata) else float(nodata)


def _number_type(dtype: Any, name: str) -> str:
    kind = np.dtype(dtype).kind
    if kind == "c":
        raise RasterUnreadableError(f"{name} holds complex numbers", "Give its amplitude: abs(…).")
    if kind not in "iufb":
        raise TypeError(f"{name} holds no numbers but {dtype}")
    return "uint8" if kind == "b" else str(np.dtype(dtype))


def _crs(text: str | None, name: str) -> Any:
    """CRS of WKT or a code, if any; addresses are not fetched and files not opened."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    if not text:
        return None
    try:
        return CRS.from_string(text) if _CODE.match(text) else CRS.from_wkt(text)
    except CRSError as error:
        raise MissingCrsError(
            f"the coordinate reference system of the grid of {name} is unknown ({error})",
            "Give it as WKT, or as a code such as EPSG:32618.",
        ) from error
