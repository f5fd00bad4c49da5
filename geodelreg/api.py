"""What users call: open the rasters, run the method; `geodelreg.writing` has the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

from geodelreg.errors import (
    AlignmentRefusedError,
    NoDataError,
    NoOverlapError,
    UsageError,
)
from geodelreg.image.mask_report import mask_uses, mask_warnings, much_hidden, under_masks
from geodelreg.image.reader import RasterReader, check_band, open_raster
from geodelreg.options import AlignOptions
from geodelreg.pipeline.check import (
    is_affine_enough,
    judge_misalignment,
    measure_misalignment,
)
from geodelreg.pipeline.register import correction_of, register
from geodelreg.pipeline.solve import Solution
from geodelreg.pipeline.state import Pair, Progress, part_of
from geodelreg.product.check import BandCheck, Check, band_check
from geodelreg.product.private import unsettled
from geodelreg.product.provenance import fingerprint, versions
from geodelreg.types import (
    Alignment,
    CheckOutcome,
    Misalignment,
)
from geodelreg.writing import AnyPath

MAX_LIMIT_PX = 1e6


@dataclass(frozen=True, slots=True)
class _Rasters:
    """The two rasters, open, and their paths as the user named them."""

    ms: RasterReader
    pan: RasterReader
    source_paths: tuple[str, ...]
    reference_path: str


@contextmanager
def _open(
    source: AnyPath | Sequence[AnyPath], reference: AnyPath, options: AlignOptions
) -> Iterator[_Rasters]:
    with (
        open_raster(source, options.masks, allow=options.allow) as ms,
        open_raster(reference, options.pan_masks, allow=options.allow) as pan,
    ):
        yield _Rasters(ms, pan, _paths(source), str(reference))


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
    MaskError
        When a mask of `options` cannot be used.
    GeodelregError
        Its other kinds, for bad input.
    """
    options = options or AlignOptions()
    start = perf_counter()
    with _open(source, reference, options) as rasters:
        alignment, _ = _examine(rasters, options, progress, start)
    if not alignment.verdict.accepted:
        failed = [r.message for r in alignment.verdict.reasons if not r.passed]
        raise AlignmentRefusedError(
            f"{rasters.ms.name} and {rasters.pan.name} were not aligned: "
            + "; ".join([*failed, *much_hidden(rasters.ms, rasters.pan)]),
            "Check that both show the same ground; try --band with the band that looks most like "
            "PAN, a larger --search-radius, or a simpler --model.",
            alignment,
        )
    return alignment


def check(
    source: AnyPath | Sequence[AnyPath],
    reference: AnyPath,
    options: AlignOptions | None = None,
    *,
    limit_px: float = 0.5,
    per_band: bool = False,
    progress: Progress | None = None,
) -> Check:
    """Tell whether a multispectral raster lies where a panchromatic one says; write nothing.

    Parameters
    ----------
    source : path or sequence of paths
        The MS raster, or one file per band.
    reference : path
        The PAN raster.
    options : AlignOptions, optional
        Its `tolerance_px` has no meaning here: whatever is found is measured.
    limit_px : float
        Largest misalignment, anywhere in the overlap, that counts as aligned, PAN pixels.
    per_band : bool
        Also match each band by itself.
    progress : callable, optional
        Called with a fraction 0 to 1 and the name of the step.

    Returns
    -------
    Check
        What the images do not support is the outcome ``cannot_tell``, not an error.

    Raises
    ------
    UsageError
        If `limit_px` is negative.
    GeodelregError
        Its other kinds, for bad input.
    """
    if not 0.0 <= limit_px <= MAX_LIMIT_PX:
        raise UsageError(f"limit_px = {limit_px} is out of range", f"Use 0 to {MAX_LIMIT_PX:g}.")
    options = replace(options or AlignOptions(), tolerance_px=0.0)
    start = perf_counter()
    with _open(source, reference, options) as rasters:
        count = len(rasters.ms.band_names) if per_band else 0
        report = part_of(progress, 0, count + 1)
        alignment, misalignment = _examine(rasters, options, report, start)
        bands = [
            _check_band(
                rasters, replace(options, band=n), limit_px, part_of(progress, n, count + 1)
            )
            for n in range(1, count + 1)
        ]
    return Check(
        judge_misalignment(misalignment, limit_px),
        limit_px,
        misalignment,
        is_affine_enough(misalignment, limit_px, alignment.tie_points),
        alignment,
        tuple(bands) if per_band else None,
    )


def _check_band(
    rasters: _Rasters,
    options: AlignOptions,
    limit_px: float,
    progress: Progress | None,
) -> BandCheck:
    """One band by itself; a band that shows nothing spoils no other."""
    assert options.band is not None
    name = rasters.ms.band_names[options.band - 1]
    try:
        pair, solution = register(rasters.ms, rasters.pan, options, progress)
    except (NoDataError, NoOverlapError) as error:
        return BandCheck(options.band, name, CheckOutcome.CANNOT_TELL, reason=error.cause)
    misalignment = measure_misalignment(pair, solution)
    outcome = judge_misalignment(misalignment, limit_px)
    alignment = _alignment(rasters, pair, solution)
    return band_check((options.band, name), alignment, misalignment, limit_px, outcome)


def _examine(
    rasters: _Rasters,
    options: AlignOptions,
    progress: Progress | None,
    start: float,
) -> tuple[Alignment, Misalignment]:
    """Register two open rasters; `start` is when opening them began."""
    ms, pan = rasters.ms, rasters.pan
    if options.band:
        check_band(ms, options.band)
    check_band(pan, options.pan_band)
    files = (*rasters.source_paths, rasters.reference_path)
    prints = {path: fingerprint(path) for path in files}
    opened = perf_counter() - start
    try:
        pair, solution = register(ms, pan, options, progress)
    except NoDataError as error:
        raise under_masks(error, ms, pan) from error
    alignment = _alignment(rasters, pair, solution)
    unsure = [unsettled(Path(path)) for path in files]
    notes = tuple(note for note in (ms.block_note, pan.block_note, *unsure) if note)
    timings = {"open": opened, **alignment.timings_s, "total": perf_counter() - start}
    alignment = replace(
        alignment,
        timings_s=timings,
        warnings=alignment.warnings + notes + mask_warnings(ms, pan),
        extra={"fingerprints": prints},
    )
    return alignment, measure_misalignment(pair, solution)


def _alignment(rasters: _Rasters, pair: Pair, solution: Solution) -> Alignment:
    masks = mask_uses(rasters.ms, rasters.pan)
    return Alignment(
        source=pair.source.grid,
        reference=pair.reference.grid,
        source_paths=rasters.source_paths,
        reference_path=rasters.reference_path,
        correction=correction_of(pair, solution),
        tie_points=solution.tie_points,
        accuracy=solution.accuracy,
        verdict=solution.verdict,
        step_counts=solution.step_counts,
        band_weights=solution.band_weights,
        warnings=solution.warnings,
        crs_operation=pair.mapping.operation.description,
        options=pair.options,
        versions=versions(with_proj=pair.through_proj or bool(masks)),
        timings_s=solution.timings_s,
        masks=masks,
    )


def _paths(source: AnyPath | Sequence[AnyPath]) -> tuple[str, ...]:
    if isinstance(source, str) or hasattr(source, "__fspath__"):
        return (str(source),)
    return tuple(str(path) for path in source)
