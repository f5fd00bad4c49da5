"""What users name as a raster, opened: paths, open rasterio datasets, arrays."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias, Union, cast

from numpy.typing import NDArray

from geodelreg.door.names import LOCAL, is_local
from geodelreg.errors import (
    GeodelregError,
    MissingCrsError,
    MissingGeoreferenceError,
    RasterUnreadableError,
    UnsupportedGeoreferenceError,
    UsageError,
)
from geodelreg.raster.arrays import array_dataset, is_xarray, xarray_dataset
from geodelreg.raster.opening import dataset_grid, open_dataset
from geodelreg.values.raster import Grid

if TYPE_CHECKING:
    import xarray
    from rasterio.io import DatasetReader
    from rasterio.vrt import WarpedVRT

AnyRaster: TypeAlias = Union[
    str,
    PathLike[str],
    "DatasetReader",
    "WarpedVRT",
    tuple[NDArray[Any], Grid],
    "xarray.DataArray",
    "xarray.Dataset",
]
"""One raster."""

AnyMask: TypeAlias = AnyRaster | NDArray[Any]
"""A mask: a bare array lies on the pixels of its image."""

_REMEDIES: dict[type[GeodelregError], str] = {
    MissingCrsError: 'Assign the right one: raster.rio.write_crs("EPSG:…"), or Grid(…, "EPSG:…").',
    MissingGeoreferenceError: "Give it coordinates: raster.assign_coords(x=…, y=…).",
    UnsupportedGeoreferenceError: "Give it valid coordinates, or a valid geotransform.",
}


@dataclass(frozen=True, slots=True)
class Opened:
    """An open raster.

    Attributes
    ----------
    name : str
        Path, or what it is called in messages.
    dataset : rasterio.io.DatasetReader, or what reads like one
    allow : str
        What may be opened, `AlignOptions.allow`.
    is_file : bool
        Whether `name` opens it again.
    """

    name: str
    dataset: Any
    allow: str = LOCAL
    is_file: bool = True

    def grid(self) -> Grid:
        """Where it lies.

        Raises
        ------
        MissingGeoreferenceError, UnsupportedGeoreferenceError, MissingCrsError, CrsTransformError
        """
        try:
            return dataset_grid(self.name, self.dataset)
        except tuple(_REMEDIES) as error:
            if self.is_file:
                raise
            raise type(error)(error.cause, _REMEDIES[type(error)]) from error

    def again(self, stack: ExitStack, overview: int | None = None) -> DatasetReader:
        """Another handle of a file."""
        return stack.enter_context(open_dataset(self.name, overview, self.allow))


def as_list(source: AnyRaster | Sequence[AnyRaster]) -> list[AnyRaster]:
    """One raster, or one for each band.

    Raises
    ------
    TypeError
    """
    if not isinstance(source, list | tuple) or is_placed_array(source):
        return [cast("AnyRaster", source)]
    return list(source)


def rasters_of(source: AnyRaster | Sequence[AnyRaster]) -> list[AnyRaster]:
    """As `as_list`, of rasters that are needed.

    Raises
    ------
    UsageError, TypeError
    """
    rasters = as_list(source)
    if not rasters:
        raise UsageError("no raster was named", "Give at least one.")
    return rasters


def is_placed_array(source: object) -> bool:
    """Whether it is an array with its grid."""
    return isinstance(source, tuple) and len(source) == 2 and isinstance(source[1], Grid)


def opened(raster: AnyRaster, stack: ExitStack, allow: str) -> Opened:
    """Open a raster, or look at one that is open.

    An open file that rasterio reads without options is opened anew: it is then read by several
    threads, and from overviews, as if it had been named.

    Raises
    ------
    TypeError
        It is none of what `AnyRaster` lists.
    GeodelregError
    """
    if isinstance(raster, str | PathLike):
        path = str(raster)
        return Opened(path, stack.enter_context(open_dataset(path, allow=allow)), allow)
    if is_xarray(raster):
        label = getattr(raster, "name", None)
        name = type(raster).__name__ + (f" {label!r}" if label else "")
        return Opened(name, xarray_dataset(raster, name), allow, is_file=False)
    if is_placed_array(raster):
        array, grid = cast("tuple[NDArray[Any], Grid]", raster)
        if not (hasattr(array, "shape") and hasattr(array, "dtype")):
            raise TypeError(f"(array, Grid) holds no array but a {type(array).__name__}")
        return Opened("array", array_dataset(array, grid, "array"), allow, is_file=False)
    return _dataset(raster, stack, allow)


def split_masks(mask: AnyMask | Sequence[AnyMask] | None) -> tuple[list[str], list[AnyMask]]:
    """Masks that have names, and those that have none."""
    masks = as_list(cast("AnyRaster", mask)) if mask is not None else []
    names = [str(one) for one in masks if isinstance(one, str | PathLike)]
    return names, [one for one in masks if not isinstance(one, str | PathLike)]


def mask_opened(mask: AnyMask, image: Grid, stack: ExitStack, allow: str) -> Opened:
    """A mask that has no name.

    Raises
    ------
    TypeError, GeodelregError
    """
    bare = hasattr(mask, "shape") and hasattr(mask, "dtype") and not is_xarray(mask)
    return opened(cast("AnyRaster", (mask, image) if bare else mask), stack, allow)


def _dataset(raster: Any, stack: ExitStack, allow: str) -> Opened:
    from rasterio.io import DatasetReader
    from rasterio.vrt import WarpedVRT

    if not isinstance(raster, DatasetReader | WarpedVRT):
        raise TypeError(
            f"{type(raster).__name__} is no raster: give a path, an open rasterio dataset, "
            "(array, Grid), or a DataArray or Dataset of xarray"
        )
    name = str(raster.name)
    if raster.closed or raster.mode not in ("r", "r+"):
        state = "closed" if raster.closed else f"open for {raster.mode!r}"
        raise RasterUnreadableError(f"the dataset {name} is {state}", "Open it for reading.")
    if type(raster) is DatasetReader and is_local(name) and not raster.options:
        return Opened(name, stack.enter_context(open_dataset(name, allow=allow)), allow)
    return Opened(f"dataset {name}", raster, allow, is_file=False)
