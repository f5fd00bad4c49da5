"""What users call: open the rasters, run the method, write the products."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from time import perf_counter

import numpy as np

from geodelreg.errors import AlignmentRefusedError, OutputUnwritableError
from geodelreg.image.reader import check_band, open_raster
from geodelreg.options import AlignOptions, WriteOptions
from geodelreg.pipeline.register import correction_of, register
from geodelreg.pipeline.solve import Solution
from geodelreg.pipeline.state import Pair, Progress
from geodelreg.product.provenance import fingerprint, provenance_tags
from geodelreg.types import Alignment, Correction, Gcp, Outcome

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
        prints = {path: fingerprint(path) for path in (*_paths(source), str(reference))}
        opened = perf_counter() - start
        pair, solution = register(ms, pan, options, progress)
        alignment = _alignment(source, reference, pair, solution)
        notes = tuple(note for note in (ms.block_note, pan.block_note) if note)
    timings = {"open": opened, **alignment.timings_s, "total": perf_counter() - start}
    alignment = replace(
        alignment,
        timings_s=timings,
        warnings=alignment.warnings + notes,
        extra={"fingerprints": prints},
    )
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


def write(alignment: Alignment, target: AnyPath, options: WriteOptions | None = None) -> list[str]:
    """Write the MS raster with its corrected georeferencing and the same pixels.

    Parameters
    ----------
    alignment : Alignment
        As returned by `align`; one that is already aligned gives a copy with provenance.
    target : path
        The output; with several MS files the folder for them, made when missing.
    options : WriteOptions, optional
        Its `warp` resamples north-up instead of correcting the header.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    OutputExistsError, OutputIsInputError, OutputUnwritableError, LossyOutputError, ...
        Nothing is then changed on disk.
    """
    from geodelreg.product.geotiff import write_corrected
    from geodelreg.product.warp import write_warped

    options = options or WriteOptions()
    tags = provenance_tags(alignment)
    notes: list[str] = []
    for path, out in _targets(alignment, Path(target)):
        correction, gcps = _of_file(alignment, path)
        if options.warp:
            notes += write_warped(path, out, correction, alignment.reference, tags, options)
        else:
            notes += write_corrected(path, out, correction, gcps, tags, options)
    return notes


def write_in_place(alignment: Alignment) -> list[str]:
    """Correct the headers of the MS files themselves; `revert` takes it back.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    UnsafeInPlaceError, FileLockedError, OutputUnwritableError
        The file is then as it was.
    """
    from geodelreg.product.inplace import edit_in_place

    if alignment.verdict.outcome is Outcome.ALREADY_ALIGNED:
        return []
    tags = provenance_tags(alignment)
    notes: list[str] = []
    for name in alignment.source_paths:
        notes += edit_in_place(Path(name), *_of_file(alignment, Path(name)), tags)
    return notes


def revert(path: AnyPath) -> None:
    """Take back what `write_in_place` did: the file is bit by bit what it was."""
    from geodelreg.product.inplace import revert as revert_file

    revert_file(Path(path))


def export_gcps(
    alignment: Alignment,
    path: AnyPath,
    format: str | None = None,  # noqa: A002 - the field's word
    overwrite: bool = False,
) -> None:
    """Write the kept tie points as ground control points of the MS raster.

    Parameters
    ----------
    alignment : Alignment
    path : path
    format : str, optional
        One of ``geodelreg.product.gcps.GCP_FORMATS``; by the extension when not given.
    overwrite : bool

    Raises
    ------
    GcpFormatError
        If the format is not known.
    OutputExistsError, OutputUnwritableError
    """
    from geodelreg.product.gcps import gcp_context, gcps_from_alignment, write_gcps

    context = gcp_context(alignment)
    write_gcps(
        Path(path), gcps_from_alignment(alignment), format, context=context, overwrite=overwrite
    )


def _targets(alignment: Alignment, target: Path) -> list[tuple[Path, Path]]:
    """MS files with their outputs."""
    sources = [Path(path) for path in alignment.source_paths]
    if len(sources) == 1:
        return [(sources[0], target)]
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputUnwritableError(
            f"{target} cannot be made a folder ({error.strerror})",
            "With several MS files the output is a folder; name another one.",
        ) from error
    return [(path, target / path.name) for path in sources]


def _of_file(alignment: Alignment, path: Path) -> tuple[Correction, tuple[Gcp, ...]]:
    """Correction and GCPs of one MS file; files on other grids share the ground, not the pixels."""
    from geodelreg.product.gcps import gcps_from_alignment

    gcps, shared = gcps_from_alignment(alignment), alignment.correction
    if len(alignment.source_paths) == 1:
        return shared, gcps
    with open_raster(path) as reader:
        own = reader.grid.transform
    if own == shared.original:
        return shared, gcps
    corrected = shared.apply(own)
    to_own = ~own @ shared.original
    moved = tuple(
        replace(gcp, column=column, row=row)
        for gcp, (column, row) in ((gcp, to_own @ (gcp.column, gcp.row)) for gcp in gcps)
    )
    return replace(shared, original=own, corrected=corrected), moved


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
