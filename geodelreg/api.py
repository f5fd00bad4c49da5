"""What users call: open the rasters, run the method, write the products."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from geodelreg.align_pair import align_pair
from geodelreg.errors import (
    AlignmentRefusedError,
    NoDataError,
    NoOverlapError,
    OutputUnwritableError,
    UsageError,
)
from geodelreg.image.mask_report import mask_uses, mask_warnings, much_hidden, under_masks
from geodelreg.image.reader import RasterReader, check_band, open_raster
from geodelreg.judge.check import is_affine_enough, judge_misalignment, measure_misalignment
from geodelreg.options import AlignOptions, WriteOptions, check_header_holds
from geodelreg.pair import Pair, Progress
from geodelreg.product.check import BandCheck, Check, band_check
from geodelreg.product.provenance import fingerprint, provenance_tags, versions
from geodelreg.values.points import Gcp
from geodelreg.values.result import (
    Alignment,
    CheckOutcome,
    Correction,
    Input,
    Misalignment,
    Outcome,
    Solution,
    Timings,
)

AnyPath = str | PathLike[str]
MAX_LIMIT_PX = 1e6


@dataclass(frozen=True, slots=True)
class _Rasters:
    """The two rasters, open, as the user named them, and how long it all takes."""

    ms: RasterReader
    pan: RasterReader
    source: Input
    reference: Input
    timings: Timings


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
            inputs = _input(ms, _paths(source)), _input(pan, (str(reference),))
        yield _Rasters(ms, pan, *inputs, timings)


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
    with _open(source, reference, options) as rasters:
        count = len(rasters.ms.band_names) if per_band else 0
        report = _part_of(progress, 0, count + 1)
        alignment, misalignment = _examine(rasters, options, report)
        bands = [
            _check_band(
                rasters,
                replace(options, band=number),
                limit_px,
                _part_of(progress, number, count + 1),
            )
            for number in range(1, count + 1)
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


def _part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Progress of one of several equal parts."""
    if progress is None:
        return None
    show = progress
    return lambda fraction, step: show((number + fraction) / count, step)


def _examine(
    rasters: _Rasters, options: AlignOptions, progress: Progress | None
) -> tuple[Alignment, Misalignment]:
    """Align two open rasters."""
    ms, pan = rasters.ms, rasters.pan
    try:
        pair, solution = align_pair(ms, pan, options, progress, rasters.timings)
    except NoDataError as error:
        raise under_masks(error, ms, pan) from error
    notes = tuple(note for note in (ms.block_note, pan.block_note) if note)
    alignment = _alignment(rasters, pair, solution, notes + mask_warnings(ms, pan))
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
    if options.georef != "gcps":
        check_header_holds(alignment.options.model)
    tags = provenance_tags(alignment)
    notes: list[str] = []
    for path, out in _targets(alignment, Path(target)):
        correction, gcps = _of_file(alignment, path)
        if options.warp:
            notes += write_warped(path, out, correction, alignment.reference.grid, tags, options)
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
    from geodelreg.product.atomic import tidy
    from geodelreg.product.inplace import edit_in_place

    check_header_holds(alignment.options.model)
    if alignment.verdict.outcome is Outcome.ALREADY_ALIGNED:
        tidy(map(Path, alignment.source.paths))
        return []
    tags = provenance_tags(alignment)
    notes: list[str] = []
    for name in alignment.source.paths:
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
    sources = [Path(path) for path in alignment.source.paths]
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
    if len(alignment.source.paths) == 1:
        return shared, gcps
    with open_raster(path, allow=alignment.options.allow) as reader:
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
