"""GDAL's weighted Brovey of bands that lie on PAN's grid, as a virtual raster or tile by tile.

A virtual raster resamples MS once for its pixels and once more for its mask.  Written out, each
tile is resampled once, by as many threads as pay, and given to GDAL from memory.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from geodelreg.door.opening import open_raster, opened_vrt
from geodelreg.geotiff.environment import gdal_session, thread_count
from geodelreg.product.common_grid import Recipe, Source, covered
from geodelreg.product.pixels import Validity
from geodelreg.values.raster import BoolArray

MOST_THREADS = 4
"""Packing and writing a tile, which one thread does, takes a quarter of the time of sharpening it:
the fifth thread would wait (16-bit pixels, four bands, DEFLATE)."""

Tile = tuple[Any, NDArray[Any], BoolArray]
"""Window, (B, H, W) sharpened pixels, and (H, W) where all inputs cover them."""
Pixels = Mapping[tuple[Path, int], NDArray[Any]]
"""By file and band."""


def pansharpened_xml(
    recipe: Recipe, names: Sequence[str | None] = (), tags: Mapping[str, str] | None = None
) -> str:
    """The VRT of the sharpened raster.

    Parameters
    ----------
    recipe : Recipe
    names : sequence of (str or None)
        Descriptions of the sharpened bands.
    tags : mapping of str to str, optional
    """
    spectral, folder, bit_depth = recipe.spectral, recipe.folder, recipe.bit_depth
    items = "".join(
        f'<MDI key="{escape(key)}">{escape(value)}</MDI>'
        for key, value in sorted((tags or {}).items())
    )
    named = names or [None] * len(spectral)
    parts = [
        '<VRTDataset subClass="VRTPansharpenedDataset">',
        f"<Metadata>{items}</Metadata>" if items else "",
        *(
            f'<VRTRasterBand band="{number}" dataType="{source.kind}" '
            'subClass="VRTPansharpenedRasterBand">'
            f"<Description>{escape(name or '')}</Description></VRTRasterBand>"
            for number, (name, source) in enumerate(zip(named, spectral, strict=True), start=1)
        ),
        _mask_xml(recipe.covers, folder) if recipe.covers else "",
        "<PansharpeningOptions><Algorithm>WeightedBrovey</Algorithm>",
        "<AlgorithmOptions><Weights>",
        ",".join(repr(float(weight)) for weight in recipe.weights),
        "</Weights></AlgorithmOptions>",
        "<Resampling>Nearest</Resampling>",
        f"<BitDepth>{bit_depth}</BitDepth>" if bit_depth else "",
        f"<PanchroBand>{recipe.pan.xml(folder)}</PanchroBand>",
        *(
            f'<SpectralBand dstBand="{number}">{source.xml(folder)}</SpectralBand>'
            for number, source in enumerate(spectral, start=1)
        ),
        "</PansharpeningOptions></VRTDataset>\n",
    ]
    return "".join(parts)


def _mask_xml(covers: Sequence[Source], folder: Path | None) -> str:
    """Valid where every input is; the product of masks that are 0 where there is nothing."""
    sources = "".join(f"<SimpleSource>{cover.xml(folder)}</SimpleSource>" for cover in covers)
    kind = 'subClass="VRTSourcedRasterBand">'
    if len(covers) > 1:
        kind = 'subClass="VRTDerivedRasterBand"><PixelFunctionType>mul</PixelFunctionType>'
    return f'<MaskBand><VRTRasterBand dataType="Byte" {kind}{sources}</VRTRasterBand></MaskBand>'


@contextmanager
def tiles(recipe: Recipe, windows: Sequence[Any]) -> Iterator[Iterator[Tile]]:
    """Sharpen windows of the grid, side by side, and give them in order.

    Parameters
    ----------
    recipe : Recipe
    windows : sequence of rasterio.windows.Window
    """
    threads = min(thread_count(), MOST_THREADS, len(windows))
    paths = {source.path for source in (recipe.pan, *recipe.spectral, *recipe.covers)}
    idle: SimpleQueue[dict[Path, Any]] = SimpleQueue()

    def tile(window: Any) -> Tile:
        inputs = idle.get()
        try:
            with gdal_session(recipe.pan.path, threads=1):
                return window, *_tile(inputs, recipe, window)
        finally:
            idle.put(inputs)

    def in_order(pool: ThreadPoolExecutor) -> Iterator[Tile]:
        ahead: deque[Future[Tile]] = deque()
        for window in windows:
            ahead.append(pool.submit(tile, window))
            if len(ahead) > threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()

    with ExitStack() as stack:
        for _ in range(threads):
            idle.put({path: stack.enter_context(open_raster(path)) for path in paths})
        yield in_order(stack.enter_context(ThreadPoolExecutor(threads)))


def _tile(
    inputs: Mapping[Path, Any], recipe: Recipe, window: Any
) -> tuple[NDArray[Any], BoolArray]:
    """A sharpened window, and where all inputs cover it."""
    sources = (recipe.pan, *recipe.spectral)
    pixels = _read(inputs, [*sources, *recipe.covers], window)
    with ExitStack() as stack:
        pan, *bands = [
            replace(one, path=_held(pixels[one.place], _nodata(inputs, one), stack), band=1)
            for one in sources
        ]
        held = replace(recipe, folder=None, spectral=bands, pan=pan, covers=[])
        data = stack.enter_context(opened_vrt(pansharpened_xml(held))).read()
    valid = [_covered(inputs[cover.path], pixels, cover, window) for cover in recipe.covers]
    return data, np.logical_and.reduce(valid)


def _nodata(inputs: Mapping[Path, Any], source: Source) -> float | None:
    path, band = source.place
    value: float | None = inputs[path].nodatavals[band - 1]
    return value


def _covered(dataset: Any, pixels: Pixels, cover: Source, window: Any) -> BoolArray:
    """(H, W) where a source covers a window, from pixels that were read if these tell."""
    if not cover.is_mask:
        return np.asarray(pixels[cover.place] > 0)
    if dataset.nodata is not None and cover.place in pixels:
        return ~Validity(nodata=dataset.nodata).missing(pixels[cover.place])
    return covered(dataset, str(cover.band), window)


def _read(inputs: Mapping[Path, Any], sources: Sequence[Source], window: Any) -> Pixels:
    """Bands of a window, all of a file at once: GDAL resamples once for them."""
    wanted = list(dict.fromkeys(one.place for one in sources if not one.is_mask))
    found = {}
    for path, dataset in inputs.items():
        bands = [band for other, band in wanted if other == path]
        if bands:
            for band, data in zip(bands, dataset.read(bands, window=window), strict=True):
                found[path, band] = data
    return found


def _held(pixels: NDArray[Any], nodata: float | None, stack: ExitStack) -> Path:
    """Name of a file in memory that holds a band until `stack` closes."""
    from rasterio.io import MemoryFile

    memory = stack.enter_context(MemoryFile(ext=".tif"))
    profile = {"height": pixels.shape[0], "width": pixels.shape[1], "dtype": pixels.dtype}
    placed = Affine.scale(2.0)  # without any rasterio warns
    with memory.open(driver="GTiff", count=1, transform=placed, nodata=nodata, **profile) as file:
        file.write(pixels, 1)
    return Path(memory.name)
