"""What users call: open the rasters, run the method; `geodelreg.writing` has the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from geodelreg.align_pair import align_pair
from geodelreg.errors import (
    AlignmentRefusedError,
    NoDataError,
    NoOverlapError,
    UsageError,
)
from geodelreg.image.mask_report import mask_uses, mask_warnings, much_hidden, under_masks
from geodelreg.image.reader import RasterReader, check_band, open_raster
from geodelreg.judge.check import is_affine_enough, judge_misalignment, measure_misalignment
from geodelreg.options import AlignOptions
from geodelreg.pair import Pair, Progress, part_of
from geodelreg.product.check import BandCheck, Check, band_check
from geodelreg.product.private import unsettled
from geodelreg.product.provenance import fingerprint, versions
from geodelreg.values.result import Alignment, CheckOutcome, Input, Misalignment, Solution, Timings
from geodelreg.writing import AnyPath, paths_of

MAX_LIMIT_PX = 1e6


@dataclass(frozen=True, slots=True)
class _Rasters:
    """The two rasters, open, as the user named them, and how long it all takes."""

    ms: RasterReader
    pan: RasterReader
    source: Input
    reference: Input
    timings: Timings
    fill_notes: tuple[str, ...]


@contextmanager
def _open(
    source: AnyPath | Sequence[AnyPath], reference: AnyPath, options: AlignOptions
) -> Iterator[_Rasters]:
    timings = Timings()
    with ExitStack() as stack:
        with timings("open"):
            ms = stack.enter_context(open_raster(source, options.masks, allow=options.allow))
            pan = stack.enter_context(
                open_raster(reference, options.pan_masks, allow=options.allow)
            )
            if options.band:
                check_band(ms, options.band)
            check_band(pan, options.pan_band)
            fill = ms.leave_out(options.ms_nodata), pan.leave_out(options.pan_nodata)
            inputs = _input(ms, paths_of(source)), _input(pan, (str(reference),))
        yield _Rasters(ms, pan, *inputs, timings, tuple(note for note in fill if note))


def _input(reader: RasterReader, paths: tuple[str, ...]) -> Input:
    return Input(paths, reader.grid, tuple(map(fingerprint, paths)))


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
    with _open(source, reference, options) as rasters:
        alignment, _ = _examine(rasters, options, progress)
    if not alignment.verdict.accepted:
        failed = [r.message for r in alignment.verdict.reasons if not r.passed]
        raise AlignmentRefusedError(
            f"{rasters.ms.name} and {rasters.pan.name} were not aligned: "
            + "; ".join([*failed, *much_hidden(rasters.ms, rasters.pan)]),
            alignment.verdict.remedy,
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
        Its `tolerance_px`, `max_residual_px` and `on_local` have no meaning here: whatever is found
        is measured, and `limit_px` judges it.
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
    options = options or AlignOptions()
    options = replace(options, tolerance_px=0.0, max_residual_px=limit_px, on_local="warn")
    with _open(source, reference, options) as rasters:
        count = len(rasters.ms.band_names) if per_band else 0
        report = part_of(progress, 0, count + 1)
        alignment, misalignment = _examine(rasters, options, report)
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
    rasters: _Rasters, options: AlignOptions, limit_px: float, progress: Progress | None
) -> BandCheck:
    """One band by itself; a band that shows nothing spoils no other."""
    assert options.band is not None
    name = rasters.ms.band_names[options.band - 1]
    try:
        pair, solution = align_pair(rasters.ms, rasters.pan, options, progress)
    except (NoDataError, NoOverlapError) as error:
        return BandCheck(options.band, name, CheckOutcome.CANNOT_TELL, reason=error.cause)
    misalignment = measure_misalignment(pair, solution)
    outcome = judge_misalignment(misalignment, limit_px)
    alignment = _alignment(rasters, pair, solution)
    return band_check((options.band, name), alignment, misalignment, limit_px, outcome)


def _examine(
    rasters: _Rasters, options: AlignOptions, progress: Progress | None
) -> tuple[Alignment, Misalignment]:
    """Align two open rasters."""
    ms, pan = rasters.ms, rasters.pan
    try:
        pair, solution = align_pair(ms, pan, options, progress, rasters.timings)
    except NoDataError as error:
        raise under_masks(error, ms, pan) from error
    unsure = [unsettled(Path(path)) for path in (*rasters.source.paths, *rasters.reference.paths)]
    notes = tuple(note for note in (ms.block_note, pan.block_note, *unsure) if note)
    notes = (*rasters.fill_notes, *notes, *mask_warnings(ms, pan))
    alignment = _alignment(rasters, pair, solution, notes)
    return alignment, measure_misalignment(pair, solution)


def _alignment(
    rasters: _Rasters, pair: Pair, solution: Solution, notes: tuple[str, ...] = ()
) -> Alignment:
    masks = mask_uses(rasters.ms, rasters.pan)
    return Alignment(
        source=rasters.source,
        reference=rasters.reference,
        solution=solution,
        options=pair.options,
        crs_operation=pair.header.operation.description,
        warnings=solution.warnings + notes,
        masks=masks,
        versions=versions(with_proj=pair.through_proj or bool(masks)),
        timings_s={**pair.timings, "total": pair.timings.elapsed_s},
    )
