"""MS sharpened with PAN: MS resampled onto PAN's exact grid, then GDAL's weighted Brovey.

GDAL's pansharpening alone loses what a geotransform says below one MS pixel (3.10 and 3.12 are up
to 0.98 PAN pixels wrong at a ratio of 4, differently from block to block) or ignores geotransforms
altogether (before 3.7).  With both images on one grid there is nothing left to lose: every pixel of
the result is ``MS * PAN / sum(weight * MS)``, whatever the blocks.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from geodelreg.door.opening import open_raster
from geodelreg.errors import UsageError
from geodelreg.geotiff import sidecars
from geodelreg.geotiff.atomic import staged
from geodelreg.geotiff.environment import gdal_session
from geodelreg.geotiff.rewrite import gdal_write, output_driver, user_creation
from geodelreg.product.brovey import pansharpened_xml, tiles
from geodelreg.product.common_grid import (
    Sharpening,
    SpectralFile,
    cover_of,
    covered,
    on_grid,
    recipe_of,
    target_grid,
)
from geodelreg.product.pixels import Validity, geotiff_on
from geodelreg.product.scratch import scratch_folder
from geodelreg.product.warp import warped_onto
from geodelreg.sharpen_options import PansharpenOptions
from geodelreg.values.raster import Float32Array, Grid

_BLOCK_PX = 512
_TILE_PX = 1024
"""Sharpened together: a few blocks, all bands of which stay in GDAL's cache until all are read."""
_SAMPLE_SIDE = 300
"""Of the decimated images that the weights are fitted on: 90 000 pixels determine a few numbers."""
_SHARE_BEFORE_COG = 0.7
"""Of the time: the rest lays tiles and overviews out."""

Progress = Callable[[float, str], None]


def spectral_bands(files: Sequence[SpectralFile], chosen: Sequence[int]) -> list[tuple[int, int]]:
    """Number of the file and of the band for bands counted through all files, from 1.

    Without `chosen` all are taken.

    Raises
    ------
    UsageError
        A band that does not exist.
    """
    found = [(number, band) for number, file in enumerate(files) for band in file.bands]
    if any(not 1 <= number <= len(found) for number in chosen):
        text = ",".join(map(str, chosen))
        raise UsageError(
            f"`bands={text!r}` are not all among the {len(found)} bands of MS",
            f"Use numbers from 1 to {len(found)}.",
        )
    return [found[number - 1] for number in chosen] if chosen else found


def sharpened_driver(target: Path, options: PansharpenOptions) -> str:
    """GDAL driver of a sharpened raster.

    Raises
    ------
    UsageError, GeodelregError
        There is none.
    """
    driver = output_driver(target, options.driver)
    if driver not in ("GTiff", "COG", "VRT"):
        raise UsageError(
            f"`driver={driver!r}` is no format of sharpened rasters", "Use GTiff, COG or VRT."
        )
    return driver


def matched_samples(what: Sharpening) -> tuple[Float32Array, Float32Array]:
    """Spectral bands and PAN averaged to the same pixels, some 300 × 300, for fitting weights.

    Returns
    -------
    (B, N) and (N,) float32
        Where all are valid.
    """
    with gdal_session(what.reference), open_raster(what.reference) as pan:
        factor = max(1.0, max(pan.shape) / _SAMPLE_SIDE)
        height, width = (max(1, round(side / factor)) for side in pan.shape)
        to_full = Affine.scale(pan.width / width, pan.height / height)
        grid = Grid(pan.transform @ to_full, (height, width), pan.crs.to_wkt())
        with scratch_folder() as folder, on_grid(what, grid, "average", folder) as files:
            bands = np.stack([files[file].read(band) for file, band in what.bands])
            masks = [covered(files[file], cover_of(files[file], band)) for file, band in what.bands]
        with warped_onto(pan, grid, Validity.of(pan), "average") as averaged:
            values = averaged.read(what.pan_band)
            masks.append(covered(averaged, cover_of(averaged, what.pan_band)))
    good = np.logical_and.reduce(masks)
    return bands[:, good].astype(np.float32), values[good].astype(np.float32)


def write_pansharpened(
    what: Sharpening,
    target: Path,
    weights: Sequence[float],
    tags: Mapping[str, str],
    options: PansharpenOptions,
    progress: Progress | None = None,
) -> None:
    """Sharpen the spectral bands with PAN, on PAN's grid.

    Pixels that MS or PAN does not cover get the no-data value, or are masked where there is none.

    Parameters
    ----------
    what : Sharpening
    target : Path
        Appears whole or not at all.  A VRT is lazy: it names its sources.
    weights : sequence of float
        Of each spectral band in the image that PAN is compared with.
    tags : mapping of str to str
        Provenance, ``GEODELREG_*``.
    options : PansharpenOptions
    progress : callable, optional
        Called with a fraction 0 to 1 and the name of the step.

    Raises
    ------
    OutputExistsError, OutputIsInputError, OutputUnwritableError, FileLockedError
    NoOverlapError
        With ``options.extent == "intersection"`` when MS and PAN share no ground.
    RasterNotFoundError, RasterUnreadableError, UsageError
    """
    import rasterio

    with gdal_session(what.reference):
        driver = sharpened_driver(target, options)
        with open_raster(what.reference) as pan:
            grid = target_grid(what, pan, options.extent)
        stale = sidecars.stale_beside(Path(os.path.realpath(target)), what.sources[0].path)
        with staged(target, overwrite=options.overwrite, stale=stale) as out:
            if driver == "VRT":
                _write_vrt(what, out, target, grid, weights, tags, options)
                return
            scratch = out.parent.parent / "scratch"
            scratch.mkdir()
            draft = scratch / f"{out.name}.tif" if driver == "COG" else out
            lazy = scratch / f"{out.name}.vrt"
            with gdal_write(what.reference, target, driver):
                share = _SHARE_BEFORE_COG if driver == "COG" else 1.0

                def tell(fraction: float, step: str) -> None:
                    if progress is not None:
                        progress(fraction, step)

                _write_tiff(
                    what, lazy, draft, grid, weights, tags, options, lambda f, s: tell(share * f, s)
                )
                if driver == "COG":
                    tell(share, "laying out the COG")
                    creation = {"BIGTIFF": "IF_SAFER", "COMPRESS": "DEFLATE"}
                    creation |= user_creation(options)
                    rasterio.shutil.copy(draft, out, driver="COG", **creation)
                    tell(1.0, "laying out the COG")


def _write_vrt(
    what: Sharpening,
    out: Path,
    target: Path,
    grid: Grid,
    weights: Sequence[float],
    tags: Mapping[str, str],
    options: PansharpenOptions,
) -> None:
    """The lazy raster, and beside it the virtual rasters that lay its sources onto the grid."""
    if options.nodata is not None or options.creation_options:
        raise UsageError(
            "`nodata` and `creation_options` need pixels to be written, and a VRT has none",
            "Name a GeoTIFF (.tif), or drop them: a VRT tells by its mask what is not covered.",
        )
    recipe = recipe_of(what, out, grid, weights, options)
    out.write_text(pansharpened_xml(recipe, _descriptions(what), tags), encoding="utf-8")
    with open_raster(out) as dataset:  # GDAL takes it
        dataset.read(1, window=((0, 1), (0, 1)))
    folder = Path(os.path.realpath(target)).parent
    for path in [out, *out.parent.glob(f"{out.name}.*.vrt")]:
        _make_relative(path, folder)


def _make_relative(vrt: Path, folder: Path) -> None:
    """Name local sources relative to the folder that the VRT will lie in."""
    text = vrt.read_text(encoding="utf-8")
    for tag in ("SourceFilename", "SourceDataset"):
        pieces = text.split(f'<{tag} relativeToVRT="0">')
        for index, piece in enumerate(pieces[1:], start=1):
            name, _, rest = piece.partition("<")
            if name.startswith("/vsi"):
                pieces[index] = f'<{tag} relativeToVRT="0">{piece}'
                continue
            near = escape(os.path.relpath(name.replace("&amp;", "&"), folder))
            pieces[index] = f'<{tag} relativeToVRT="1">{near}<{rest}'
        text = "".join(pieces)
    vrt.write_text(text, encoding="utf-8")


def _descriptions(what: Sharpening) -> list[str | None]:
    single = len(what.sources) > 1
    chosen = [(what.sources[file], band) for file, band in what.bands]
    return [file.names[band - 1] or (file.path.stem if single else None) for file, band in chosen]


def _write_tiff(
    what: Sharpening,
    lazy: Path,
    draft: Path,
    grid: Grid,
    weights: Sequence[float],
    tags: Mapping[str, str],
    options: PansharpenOptions,
    progress: Progress,
) -> None:
    import rasterio
    from rasterio.windows import Window

    recipe = recipe_of(what, lazy, grid, weights, options)
    path, band = recipe.spectral[0].place
    with open_raster(path) as dataset:
        dtype = np.dtype(dataset.dtypes[band - 1])
    nodata = _nodata(what, dtype, options)
    profile = _profile(len(recipe.spectral), dtype, grid, nodata) | {
        key.lower(): value for key, value in user_creation(options).items()
    }
    height, width = grid.shape
    corners = list(product(range(0, height, _TILE_PX), range(0, width, _TILE_PX)))
    windows = [
        Window(left, top, min(_TILE_PX, width - left), min(_TILE_PX, height - top))
        for top, left in corners
    ]
    with (
        gdal_session(what.reference, threads=1),  # the tiles have threads of their own
        rasterio.open(draft, "w", **profile) as dataset,
        tiles(recipe, windows) as sharpened,
    ):
        dataset.descriptions = _descriptions(what)
        dataset.update_tags(**tags)
        for number, (window, data, valid) in enumerate(sharpened, start=1):
            if nodata is not None:
                _mark(data, valid, nodata)
            else:
                dataset.write_mask(valid, window=window)
            dataset.write(data, window=window)
            progress(number / len(windows), "sharpening")


def _nodata(what: Sharpening, kind: np.dtype[Any], options: PansharpenOptions) -> float | None:
    """No-data value as asked for; else that of the first MS file, if the sharpened type has it."""
    asked, declared = options.nodata, what.sources[0].nodata
    if asked is None:
        return None if declared is None or not _holds(kind, declared) else float(declared)
    if not _holds(kind, asked):
        raise UsageError(f"`nodata={asked}` is no value of {kind}", "Use one that the bands have.")
    return float(asked)


def _holds(kind: np.dtype[Any], value: float) -> bool:
    if kind.kind == "f":
        return True
    limits = np.iinfo(kind)
    return math.isfinite(value) and value == int(value) and limits.min <= value <= limits.max


def _mark(data: NDArray[Any], valid: NDArray[np.bool_], nodata: float) -> None:
    """Put the no-data value where nothing is covered; a value that happens to equal it moves."""
    if not math.isnan(nodata):
        taken = valid & (data == nodata)
        if taken.any():
            step = 1 if data.dtype.kind in "iu" else np.abs(np.spacing(data.dtype.type(nodata)))
            up = nodata + step
            fits = data.dtype.kind == "f" or up <= np.iinfo(data.dtype).max
            data[taken] = up if fits else nodata - step
    data[:, ~valid] = nodata


def _profile(count: int, dtype: np.dtype[Any], grid: Grid, nodata: float | None) -> dict[str, Any]:
    return geotiff_on(grid) | {
        "count": count,
        "dtype": dtype,
        "nodata": nodata,
        "tiled": True,
        "blockxsize": _BLOCK_PX,
        "blockysize": _BLOCK_PX,
        "compress": "DEFLATE",
        "predictor": 3 if dtype.kind == "f" else 2,
        "zlevel": 1,  # sharpened noise hardly packs better, at five times the time
        "photometric": "MINISBLACK",
        "interleave": "pixel",
    }
