"""An output against its source: pixels must be the same, what else differs is reported."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from geodelreg.door.opening import open_raster
from geodelreg.errors import LossyOutputError, OutputUnwritableError, RasterUnreadableError
from geodelreg.geo.affine import affine_matrix
from geodelreg.geotiff.header import Provenance
from geodelreg.geotiff.metadata import attribute, colormap, lost_metadata

EXACT_PX = 1e-6
"""Displacement of a corner that rounding of a geotransform in float64 explains."""
_WINDOW_BYTES = 16_000_000
_ATTRIBUTES = {
    "nodatavals": "no-data values",
    "descriptions": "band descriptions",
    "colorinterp": "colour interpretation",
    "scales": "scales",
    "offsets": "offsets",
    "units": "units",
}
_ENCODING = {
    "block_shapes": "block size",
    "interleaving": "interleave",
    "compression": "compression",
    "photometric": "photometric interpretation",
}


def check_placement(
    out: Path | str, target: Path, content: Provenance, tolerance_px: float = EXACT_PX
) -> None:
    """Read back through GDAL where the output lies.

    Parameters
    ----------
    out : Path or str
        The file as it is now.
    target : Path
        Its final name, for messages.
    content : Provenance
    tolerance_px : float
        Largest displacement of a corner.

    Raises
    ------
    OutputUnwritableError
        Its format does not hold the georeferencing.
    """
    with open_raster(out) as dataset:
        if content.georef == "gcps":
            good = len(dataset.gcps[0]) == len(content.gcps)
        else:
            wanted = content.correction.corrected
            good = _displacement_px(dataset.transform, wanted, dataset.shape) <= tolerance_px
        driver = dataset.driver
    if not good:
        raise OutputUnwritableError(
            f"{target} cannot be written: {driver} does not keep this georeferencing",
            "Choose another format, e.g. `driver='GTiff'`.",
        )


def _displacement_px(found: Affine, wanted: Affine, shape: tuple[int, int]) -> float:
    """Largest displacement of a corner beyond what doubles resolve so far from the origin."""
    height, width = shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=float)
    before, after = affine_matrix(wanted), affine_matrix(found)
    moved = np.abs(corners @ (after - before).T)
    grain = 4 * np.spacing(np.abs(corners @ before.T).max())
    moved = np.maximum(moved - grain, 0.0)
    return float((moved @ np.abs(np.linalg.inv(before[:, :2])).T).max())


def metadata_differences(
    source: Path, out: Path, same_encoding: bool, strip_rpc: bool
) -> list[str]:
    """What the output says differently, one text each; georeferencing apart.

    Parameters
    ----------
    source, out : Path
    same_encoding : bool
        Compare block size, interleave and compression too.
    strip_rpc : bool
        RPCs are meant to be missing.
    """
    names = _ATTRIBUTES | (_ENCODING if same_encoding else {})
    with open_raster(source) as before, open_raster(out) as after:
        found = [
            text
            for name, text in names.items()
            if not _same(attribute(before, name), attribute(after, name))
        ]
        bands = before.indexes
        if any(before.overviews(b) != after.overviews(b) for b in bands):
            found.append("overviews")
        if before.mask_flag_enums != after.mask_flag_enums:
            found.append("kind of mask")
        if any(colormap(before, b) != colormap(after, b) for b in bands):
            found.append("colour table")
    lost = lost_metadata(source, out, {"RPC"} if strip_rpc else set())
    for band, domains in enumerate(lost):
        where = f" of band {band}" if band else ""
        for domain, items in domains.items():
            found.append(f"metadata {domain}{where} ({', '.join(sorted(items)[:5])})")
    return found


def check_pixels(source: Path, out: Path, target: Path, overviews: bool) -> None:
    """Compare decoded values and masks, window by window, and overviews where they are stored.

    Raises
    ------
    LossyOutputError
        Something differs, or the output cannot be read back.
    RasterUnreadableError
        The source cannot be decoded.
    """
    with open_raster(source) as before, open_raster(out) as after:
        if not after.count:
            raise _lossy(target, f"{after.driver} makes each band a raster of its own")
        if (before.dtypes, before.shape) != (after.dtypes, after.shape):
            raise _lossy(target, f"bands of {after.dtypes[0]} instead of {before.dtypes[0]}")
        _check_values(before, after, target)
        levels = before.overviews(1) if overviews else []
        if levels != after.overviews(1):
            levels = []
    for level in range(len(levels)):
        with (
            open_raster(source, OVERVIEW_LEVEL=level) as before,
            open_raster(out, OVERVIEW_LEVEL=level) as after,
        ):
            _check_values(before, after, target)


def check_decodable(source: Path) -> None:
    """Read a whole raster.

    Raises
    ------
    RasterUnreadableError
    """
    with open_raster(source) as dataset:
        for window in windows_of(dataset):
            _read(dataset, window, "pixels", RasterUnreadableError, source)


def numpy_type(name: str) -> str:
    """Name of the numpy type that rasterio reads a band of type `name` into."""
    return {"complex_int16": "complex64"}.get(name, name)


def windows_of(dataset: Any) -> Iterator[Any]:
    """Windows of whole blocks that cover a dataset, of a bounded size over all bands."""
    from rasterio.windows import Window

    block_height, block_width = dataset.block_shapes[0]
    pixel_bytes = sum(np.dtype(numpy_type(name)).itemsize for name in dataset.dtypes)
    pixels = max(1, _WINDOW_BYTES // pixel_bytes)
    width = min(
        dataset.width, max(block_width, pixels // block_height // block_width * block_width)
    )
    height = max(block_height, pixels // width // block_height * block_height)
    for row in range(0, dataset.height, height):
        for column in range(0, dataset.width, width):
            yield Window(
                column, row, min(width, dataset.width - column), min(height, dataset.height - row)
            )


def _check_values(before: Any, after: Any, target: Path) -> None:
    _check_arrays(before, after, target, "pixels")
    if _is_masked(before) or _is_masked(after):
        _check_arrays(before, after, target, "masks")


def _check_arrays(before: Any, after: Any, target: Path, what: str) -> None:
    for window in windows_of(before):
        expected = _read(before, window, what, RasterUnreadableError, Path(before.name))
        if not _same_bytes(expected, _read(after, window, what, LossyOutputError, target)):
            raise _lossy(target, f"decoded {what} differ")


def _is_masked(dataset: Any) -> bool:
    from rasterio.enums import MaskFlags

    return any(flags != [MaskFlags.all_valid] for flags in dataset.mask_flag_enums)


def _read(dataset: Any, window: Any, what: str, error_class: type, path: Path) -> Any:
    from rasterio.errors import RasterioIOError

    try:
        read = dataset.read if what == "pixels" else dataset.read_masks
        return read(window=window)
    except RasterioIOError as error:
        raise error_class(
            f"{path} cannot be decoded: {error}", "Obtain the file again, or choose another format."
        ) from error


def _lossy(target: Path, what: str) -> LossyOutputError:
    return LossyOutputError(
        f"{target} would not keep the pixels: {what}",
        "Choose a lossless compression or format, e.g. `driver='GTiff'` and "
        "`creation_options=['COMPRESS=DEFLATE']`.",
    )


def _same_bytes(a: NDArray[Any], b: NDArray[Any]) -> bool:
    if a.dtype != b.dtype or a.shape != b.shape:
        return False
    return bool(np.array_equal(a.view(np.uint8), b.view(np.uint8)))


def _same(a: Any, b: Any) -> bool:
    if not isinstance(a, tuple | list):
        return bool(a == b or (a != a and b != b))
    return len(a) == len(b) and all(_same(p, q) for p, q in zip(a, b, strict=True))
