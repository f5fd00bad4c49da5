"""What users call: open the rasters, run the method, write the products."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from geodelreg.errors import AlignmentRefusedError, UsageError
from geodelreg.image.reader import RasterReader, check_band, open_raster
from geodelreg.options import AlignOptions, WriteOptions
from geodelreg.pipeline.register import correction_of, register
from geodelreg.pipeline.solve import Solution
from geodelreg.pipeline.state import Pair, Progress
from geodelreg.types import Alignment

if TYPE_CHECKING:
    from geodelreg.types import Gcp

AnyPath = str | PathLike[str]


def align(
    source: AnyPath | Sequence[AnyPath],
    reference: AnyPath,
    options: AlignOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Alignment:
    """Find the correction of a multispectral raster's header against a panchromatic one.

    Nothing is written; pass the result to `write`, `write_in_place` or `export_gcps`.

    Parameters
    ----------
    source : path or sequence of paths
        The MS raster, or one file per band with one shared correction.
    reference : path
        The PAN raster; any raster that is taken as true.
    options : AlignOptions, optional
    progress : callable, optional
        Called with a fraction 0 to 1 and the name of the step.

    Returns
    -------
    Alignment

    Raises
    ------
    AlignmentRefusedError
        When the evidence does not support any correction; its ``alignment`` holds all that was
        found out.
    GeodelregError
        Its other kinds, for bad input.
    """
    options = options or AlignOptions()
    start = perf_counter()
    with open_raster(source) as ms, open_raster(reference) as pan:
        if options.band:
            check_band(ms, options.band)
        check_band(pan, options.pan_band)
        opened = perf_counter() - start
        pair, solution = register(ms, pan, options, progress)
        alignment = _alignment(source, reference, pair, solution)
        notes = tuple(note for note in (ms.block_note, pan.block_note) if note)
    timings = {"open": opened, **alignment.timings_s, "total": perf_counter() - start}
    alignment = replace(alignment, timings_s=timings, warnings=alignment.warnings + notes)
    if not alignment.verdict.accepted:
        failed = [r.message for r in alignment.verdict.reasons if not r.passed]
        raise AlignmentRefusedError(
            f"{ms.name} and {pan.name} were not aligned: " + "; ".join(failed),
            "Check that both show the same ground; try --band with the band that looks most like "
            "PAN, a larger --search-radius, or a simpler --model.",
            alignment,
        )
    return alignment


def _alignment(
    source: AnyPath | Sequence[AnyPath], reference: AnyPath, pair: Pair, solution: Solution
) -> Alignment:
    return Alignment(
        source=pair.source.grid,
        reference=pair.reference.grid,
        source_paths=_paths(source),
        reference_path=str(reference),
        correction=correction_of(pair, solution),
        tie_points=solution.tie_points,
        accuracy=solution.accuracy,
        verdict=solution.verdict,
        step_counts=solution.step_counts,
        band_weights=solution.band_weights,
        warnings=solution.warnings,
        crs_operation=pair.mapping.operation.description,
        options=pair.options,
        versions=versions(),
        timings_s=solution.timings_s,
    )


def _paths(source: AnyPath | Sequence[AnyPath]) -> tuple[str, ...]:
    if isinstance(source, str) or hasattr(source, "__fspath__"):
        return (str(source),)
    return tuple(str(path) for path in source)


def versions() -> dict[str, str]:
    """Versions of everything that can change a result."""
    import cv2
    import pyproj
    import rasterio

    from geodelreg import __version__

    return {
        "geodelreg": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "rasterio": rasterio.__version__,
        "gdal": rasterio.__gdal_version__,
        "pyproj": pyproj.__version__,
        "proj": pyproj.proj_version_str,
    }
