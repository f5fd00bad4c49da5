"""GDAL's weighted Brovey of bands that lie on PAN's grid, as a virtual raster or tile by tile.

A virtual raster resamples MS once for its pixels and once more for its mask.  Written out, each
tile is resampled once, by as many threads as pay, and given to GDAL from memory.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from geodelreg.door.opening import open_raster, opened_vrt
from geodelreg.geotiff.environment import gdal_session, thread_count
from geodelreg.product.common_grid import Recipe, covered
from geodelreg.product.pixels import Validity
from geodelreg.values.raster import BoolArray

MOST_THREADS = 4
"""Packing and writing a tile, which one thread does, takes a quarter of the time of sharpening it:
the fifth thread would wait (16-bit pixels, four bands, DEFLATE)."""

Tile = tuple[Any, NDArray[Any], BoolArray]
"""Window, (B, H, W) sharpened pixels, and (H, W) where all inputs cover them."""


@dataclass(frozen=True, slots=True)
class Source:
    """A band of a raster that GDAL opens itself.

    Attributes
    ----------
    path : Path or str
    band : int or str
        From 1; ``mask,1`` is the mask of band 1.
    kind : str
        GDAL's name of its type.
    """

    path: Path | str
    band: int | str
    kind: str = "Byte"

    @classmethod
    def of(cls, vrt: Path, band: int) -> Source:
        """A band of a virtual raster, which tells its type."""
        found = ElementTree.parse(vrt).findall("VRTRasterBand")[band - 1]
        return cls(vrt, band, found.get("dataType", "Byte"))

    def xml(self, folder: Path | None) -> str:
        """Name it, relative to `folder` if it lies there."""
        path = Path(self.path)
        relative, name = path.parent == folder, str(self.path)
        if relative:
            name = path.name
        elif not name.startswith("/vsi"):
            name = str(path.absolute())
        return (
            f'<SourceFilename relativeToVRT="{int(relative)}">{escape(name)}</SourceFilename>'
            f"<SourceBand>{self.band}</SourceBand>"
        )


def pansharpened_xml(
    spectral: Sequence[Source],
    pan: Source,
    weights: Sequence[float],
    *,
    bit_depth: int | None = None,
    names: Sequence[str | None] = (),
    tags: Mapping[str, str] | None = None,
    covers: Sequence[Source] = (),
    folder: Path | None = None,
) -> str:
    """The VRT of the sharpened raster.

    Parameters
    ----------
    spectral : sequence of Source
        Bands to sharpen, on PAN's grid.
    pan : Source
    weights : sequence of float
        Of each spectral band in the image that PAN is compared with.
    bit_depth : int, optional
        Bits that pixels have at most.
    names : sequence of (str or None)
        Descriptions of the sharpened bands.
    tags : mapping of str to str, optional
    covers : sequence of Source
        Masks that say, all together, what is covered.
    folder : Path, optional
        Where the VRT lies.
    """
    items = "".join(
        f'<MDI key="{escape(key)}">{escape(value)}</MDI>'
        for key, value in sorted((tags or {}).items())
    )
    named = names or [None] * len(spectral)
    depth = f"<BitDepth>{bit_depth}</BitDepth>" if bit_depth else ""
    parts = [
        '<VRTDataset subClass="VRTPansharpenedDataset">',
        f"<Metadata>{items}</Metadata>" if items else "",
        *(
            f'<VRTRasterBand band="{number}" dataType="{source.kind}" '
            'subClass="VRTPansharpenedRasterBand">'
            f"<Description>{escape(name or '')}</Description></VRTRasterBand>"
            for number, (name, source) in enumerate(zip(named, spectral, strict=True), start=1)
        ),
        _mask_xml(covers, folder) if covers else "",
        "<PansharpeningOptions><Algorithm>WeightedBrovey</Algorithm>",
        "<AlgorithmOptions><Weights>",
        ",".join(repr(float(weight)) for weight in weights),
        "</Weights></AlgorithmOptions>",
        "<Resampling>Nearest</Resampling>",
        depth,
        f"<PanchroBand>{pan.xml(folder)}</PanchroBand>",
        *(
            f'<SpectralBand dstBand="{number}">{source.xml(folder)}</SpectralBand>'
            for number, source in enumerate(spectral, start=1)
        ),
    ]
    return "".join([*parts, "</PansharpeningOptions></VRTDataset>\n"])


def _mask_xml(covers: Sequence[Source], folder: Path | None) -> str:
    """Valid where every input is; the product of masks that are 0 where there is nothing."""
    sources = "".join(f"<SimpleSource>{cover.xml(folder)}</SimpleSource>" for cover in covers)
    kind = 'subClass="VRTSourcedRasterBand">'
    if len(covers) > 1:
        kind = 'subClass="VRTDerivedRasterBand"><PixelFunctionType>mul</PixelFunctionType>'
    return f'<MaskBand><VRTRasterBand dataType="Byte" {kind}{sources}</VRTRasterBand></MaskBand>'


@contextmanager
def tiles(
    recipe: Recipe,
    spectral: Sequence[Source],
    weights: Sequence[float],
    bit_depth: int | None,
    windows: Sequence[Any],
) -> Iterator[Iterator[Tile]]:
    """Sharpen windows of the grid, side by side, and give them in order.

    Parameters
    ----------
    recipe : Recipe
        Everything on one grid.
    spectral : sequence of Source
        Bands of its files.
    weights : sequence of float
    bit_depth : int or None
    windows : sequence of rasterio.windows.Window
    """
    threads = min(thread_count(), MOST_THREADS, len(windows))
    paths = {Path(recipe.pan[0]), *recipe.files, *(path for path, _ in recipe.covers)}
    idle: SimpleQueue[dict[Path, Any]] = SimpleQueue()

    def tile(window: Any) -> Tile:
        inputs = idle.get()
        try:
            with gdal_session(recipe.pan[0], threads=1):
                return window, *_tile(inputs, recipe, spectral, weights, bit_depth, window)
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
    inputs: Mapping[Path, Any],
    recipe: Recipe,
    spectral: Sequence[Source],
    weights: Sequence[float],
    bit_depth: int | None,
    window: Any,
) -> tuple[NDArray[Any], BoolArray]:
    """A sharpened window, and where all inputs cover it."""
    pan_path, pan_band = recipe.pan
    asked = [
        (Path(path), int(band))
        for path, band in [(pan_path, pan_band), *((one.path, one.band) for one in spectral)]
    ]
    pixels = _read(inputs, asked, recipe.covers, window)
    with ExitStack() as stack:
        pan, *bands = [
            _held(pixels[path, band], inputs[path].nodatavals[band - 1], stack)
            for path, band in asked
        ]
        placed = [Source(name, 1, one.kind) for name, one in zip(bands, spectral, strict=True)]
        text = pansharpened_xml(placed, Source(pan, 1), weights, bit_depth=bit_depth)
        data = stack.enter_context(opened_vrt(text)).read()
    valid = [_covered(inputs[path], pixels, path, source, window) for path, source in recipe.covers]
    return data, np.logical_and.reduce(valid)


def _covered(
    dataset: Any,
    pixels: Mapping[tuple[Path, int], NDArray[Any]],
    path: Path,
    source: str,
    window: Any,
) -> BoolArray:
    """(H, W) where a source covers a window, from pixels that were read if these tell."""
    band = int(source.rpartition(",")[2])
    if source.isdigit():
        return np.asarray(pixels[path, band] > 0)
    if dataset.nodata is not None and (path, band) in pixels:
        return ~Validity(nodata=dataset.nodata).missing(pixels[path, band])
    return covered(dataset, source, window)


def _read(
    inputs: Mapping[Path, Any],
    asked: Sequence[tuple[Path, int]],
    covers: Sequence[tuple[Path, str]],
    window: Any,
) -> dict[tuple[Path, int], NDArray[Any]]:
    """Bands of a window, all of a file at once: GDAL resamples once for them."""
    alphas = [(path, int(source)) for path, source in covers if source.isdigit()]
    wanted = list(dict.fromkeys([*asked, *alphas]))
    found = {}
    for path, dataset in inputs.items():
        bands = [band for other, band in wanted if other == path]
        if bands:
            for band, data in zip(bands, dataset.read(bands, window=window), strict=True):
                found[path, band] = data
    return found


def _held(pixels: NDArray[Any], nodata: float | None, stack: ExitStack) -> str:
    """Name of a file in memory that holds a band until `stack` closes."""
    from rasterio.io import MemoryFile

    memory = stack.enter_context(MemoryFile(ext=".tif"))
    profile = {"height": pixels.shape[0], "width": pixels.shape[1], "dtype": pixels.dtype}
    placed = Affine.scale(2.0)  # without any rasterio warns
    with memory.open(driver="GTiff", count=1, transform=placed, nodata=nodata, **profile) as file:
        file.write(pixels, 1)
    return str(memory.name)
