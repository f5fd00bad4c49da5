"""What users call: open the rasters, run the method; `geodelreg.writing` has the rest."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Unpack

from geodelreg.alignment import Alignment
from geodelreg.errors import AlignmentRefusedError, NoDataError, UsageError
from geodelreg.geotiff.private import unsettled
from geodelreg.judge.check import (
    is_affine_enough,
    judge_misalignment,
    measure_band,
    measure_misalignment,
    without_one_place,
)
from geodelreg.judge.words import first_of_many, unmatched_part
from geodelreg.knobs import AlignKnobs
from geodelreg.options import AlignOptions
from geodelreg.pair import Pair, Progress, check_order
from geodelreg.product.check import BandCheck, Check, band_check
from geodelreg.product.provenance import fingerprint, versions
from geodelreg.raster.inputs import AnyMask, AnyRaster, split_masks
from geodelreg.raster.likeness import likest_band
from geodelreg.raster.mask_report import mask_uses, mask_warnings, much_hidden, under_masks
from geodelreg.raster.reader import RasterReader, check_band, open_raster
from geodelreg.second_look import align_rasters
from geodelreg.values.result import CheckOutcome, Input, Solution
from geodelreg.values.timings import Timings

logger = logging.getLogger(__name__)

MAX_LIMIT_PX = 1e6


@dataclass(frozen=True, slots=True)
class _Rasters:
    """The two rasters, open, as the user named them, and how long it all takes."""

    ms: RasterReader
    pan: RasterReader
    source: Input
    reference: Input
    timings: Timings
    options: AlignOptions
    early_notes: tuple[str, ...]

    def notes(self) -> tuple[str, ...]:
        """What a user should know of the files."""
        ms, pan = self.ms, self.pan
        files = [one for one in (self.source, self.reference) if not one.in_memory]
        unsure = [unsettled(Path(path)) for one in files for path in one.paths]
        notes = [*self.early_notes, ms.block_note, pan.block_note, *unsure, *mask_warnings(ms, pan)]
        if ms is not pan and self.source.fingerprints == self.reference.fingerprints != ("",):
            notes.append("MS and PAN are the same file: that they agree proves nothing")
        return tuple(dict.fromkeys(note for note in notes if note))


@contextmanager
def _open(
    source: AnyRaster | Sequence[AnyRaster],
    reference: AnyRaster | None,
    options: AlignOptions,
    masks: Sequence[AnyMask],
    pan_masks: Sequence[AnyMask],
    *,
    alone: bool = False,
) -> Iterator[_Rasters]:
    """The rasters; where MS is `alone` it stands for the reference."""
    timings, allow = Timings(), options.allow
    with ExitStack() as stack:
        with timings("open"):
            ms = pan = stack.enter_context(
                open_raster(source, [*options.masks, *masks], allow=allow)
            )
            if not alone:
                pan = stack.enter_context(
                    open_raster(reference, [*options.pan_masks, *pan_masks], allow=allow)
                )
            if options.band:
                check_band(ms, options.band)
            for number in options.agreeing_bands:
                check_band(ms, number)
            fill = ms.leave_out(options.ms_nodata), pan.leave_out(options.pan_nodata)
            chosen = ""
            if not options.pan_band:
                number, chosen = likest_band(pan)
                options = replace(options, pan_band=number)
            check_band(pan, options.pan_band)
        for role, reader in (("MS", ms), ("PAN", pan)):
            height, width = reader.grid.shape
            logger.info(
                "%s: %s, %d × %d pixels, bands %s, geotransform %s",
                role, reader.name, width, height, ", ".join(reader.band_names),
                reader.grid.transform.to_gdal(),
            )  # fmt: skip
        notes = tuple(note for note in (*fill, chosen) if note)
        yield _Rasters(ms, pan, _input(ms), _input(pan), timings, options, notes)


def _input(reader: RasterReader) -> Input:
    names, in_memory = reader.given, reader.in_memory
    digests = ("",) * len(names) if in_memory else tuple(map(fingerprint, names))
    return Input(names, reader.grid, digests, in_memory)


def _asked(
    options: AlignOptions | None,
    knobs: AlignKnobs,
    mask: AnyMask | Sequence[AnyMask] | None,
    pan_mask: AnyMask | Sequence[AnyMask] | None,
) -> tuple[AlignOptions, list[AnyMask], list[AnyMask]]:
    """Options with the keywords in them, and the masks that have no name."""
    options = replace(options or AlignOptions(), **knobs)
    (names, arrays), (pan_names, pan_arrays) = split_masks(mask), split_masks(pan_mask)
    options = replace(
        options, masks=(*options.masks, *names), pan_masks=(*options.pan_masks, *pan_names)
    )
    return options, arrays, pan_arrays


def align(
    source: AnyRaster | Sequence[AnyRaster],
    reference: AnyRaster,
    options: AlignOptions | None = None,
    *,
    mask: AnyMask | Sequence[AnyMask] | None = None,
    pan_mask: AnyMask | Sequence[AnyMask] | None = None,
    progress: Progress | None = None,
    **knobs: Unpack[AlignKnobs],
) -> Alignment:
    """Find the correction of a multispectral raster's header against a panchromatic one.

    Nothing is written; pass the result to `write`, `write_in_place` or `export_gcps`.

    Parameters
    ----------
    source : raster or sequence of rasters
        The MS raster, or one per band with one shared correction.  Each is a path, an open dataset
        of rasterio, an array with its grid ``(array, Grid)``, or a DataArray or Dataset of xarray
        with rioxarray; arrays are read window by window.
    reference : raster
        The PAN raster; any raster that is taken as true.
    options : AlignOptions, optional
    mask, pan_mask : mask or sequence of masks, optional
        More masks of MS and of PAN: names as in `AlignOptions.masks`, or arrays of their pixels,
        which hide where they are not 0.
    progress : callable, optional
        Called with a fraction 0 to 1 and the name of the step.
    **knobs
        Fields of `AlignOptions`, which replace those of `options`.

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
    TypeError
        When an argument is of the wrong type.
    """
    options, masks, pan_masks = _asked(options, knobs, mask, pan_mask)
    with _open(source, reference, options, masks, pan_masks) as rasters:
        pair, solution = _solve(rasters, options, progress)
        alignment = _alignment(rasters, pair, solution, rasters.notes())
    if not alignment.verdict.accepted:
        failed = [r.message for r in alignment.verdict.reasons if not r.passed]
        failed += filter(None, [unmatched_part(alignment.tie_points, rasters.ms.grid.shape)])
        raise AlignmentRefusedError(
            f"{rasters.ms.name} and {rasters.pan.name} were not aligned: "
            + "; ".join([*failed, *much_hidden(rasters.ms, rasters.pan)]),
            alignment.verdict.remedy,
            alignment,
        )
    return alignment


def refit(
    points: str | PathLike[str],
    source: AnyRaster | Sequence[AnyRaster],
    reference: AnyRaster | None = None,
    options: AlignOptions | None = None,
    *,
    format: str | None = None,  # noqa: A002 - the field's word
    snap: bool = False,
    mask: AnyMask | Sequence[AnyMask] | None = None,
    pan_mask: AnyMask | Sequence[AnyMask] | None = None,
    progress: Progress | None = None,
    **knobs: Unpack[AlignKnobs],
) -> Alignment:
    """Fit the correction to control points of a file, which a person may have edited.

    Who edits the points answers for them: nothing is searched, and the gate is not asked.

    Parameters
    ----------
    points : path
        As `export_gcps` writes them, in any of its formats.
    source : raster or sequence of rasters
        The MS raster that the points were made for, as for `align`, with its original header.
    reference : raster, optional
        The PAN raster.  Without it, what is called PAN pixels are pixels of MS.
    options : AlignOptions, optional
        Those that tell of a search or of its gate have no meaning here.  ``auto`` takes no field.
        `band` takes the points of one band, where a file has those of each.
    format : str, optional
        One of ``geodelreg.product.gcps.GCP_FORMATS``; by the extension when not given.
    snap : bool
        Measure points that were placed by hand where PAN shows what MS does; points that were
        drawn, without a pixel of MS, are looked for where the others say.
    mask, pan_mask : mask or sequence of masks, optional
        As for `align`.
    progress : callable, optional
    **knobs
        Fields of `AlignOptions`, which replace those of `options`.

    Returns
    -------
    Alignment
        To be written as that of `align`.

    Raises
    ------
    PointsError
        The points do not determine the model, or are those of another raster.
    GcpFormatError
        The file cannot be read.
    AlignmentRefusedError
        The correction folds the ground, or is larger than allowed.
    GeodelregError
        Its other kinds, for bad input.
    """
    from geodelreg.product.gcps.given import given_points
    from geodelreg.refit_pair import refit_pair

    options, masks, pan_masks = _asked(options, knobs, mask, pan_mask)
    if snap and reference is None:
        raise UsageError("`snap=True` measures points on PAN, and none was given", "Name PAN.")
    if options.per_band:
        raise UsageError("`per_band=True` has no meaning for points", "Drop it.")
    file = Path(points)
    alone = reference is None
    with _open(source, reference, options, masks, pan_masks, alone=alone) as rasters:
        pan = None if alone else rasters.pan
        pan_grid = None if pan is None else pan.grid
        given = given_points(file, format, rasters.ms.grid, pan_grid, options.band)
        pair, solution = refit_pair(
            rasters.ms, pan, given, rasters.options, snap, progress, rasters.timings
        )
        read = Input((str(file),), rasters.ms.grid, (fingerprint(file),), in_memory=True)
        alignment = _alignment(rasters, pair, solution, rasters.notes())
        truth = read if pan is None else rasters.reference
        alignment = replace(alignment, points=read, reference=truth)
    if not alignment.verdict.accepted:
        failed = [r.message for r in alignment.verdict.reasons if not r.passed]
        raise AlignmentRefusedError(
            f"the correction through the points of {file} is refused: {'; '.join(failed)}",
            "Look for points in the wrong place, or use a simpler `model`.",
            alignment,
        )
    return alignment


def check(
    source: AnyRaster | Sequence[AnyRaster],
    reference: AnyRaster,
    options: AlignOptions | None = None,
    *,
    limit_px: float = 0.5,
    mask: AnyMask | Sequence[AnyMask] | None = None,
    pan_mask: AnyMask | Sequence[AnyMask] | None = None,
    progress: Progress | None = None,
    **knobs: Unpack[AlignKnobs],
) -> Check:
    """Tell whether a multispectral raster lies where a panchromatic one says; write nothing.

    Parameters
    ----------
    source : raster or sequence of rasters
        The MS raster, or one per band, as for `align`.
    reference : raster
        The PAN raster.
    options : AlignOptions, optional
        Its `tolerance_px`, `max_residual_px` and `on_local` have no meaning here: whatever is found
        is measured, and `limit_px` judges it.  With `per_band` each band is found, as by `align`.
    limit_px : float
        Largest misalignment, anywhere in the overlap, that counts as aligned, PAN pixels.
    mask, pan_mask : mask or sequence of masks, optional
        As for `align`.
    progress : callable, optional
        Called with a fraction 0 to 1 and the name of the step.
    **knobs
        Fields of `AlignOptions`, which replace those of `options`.

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
    TypeError
        When an argument is of the wrong type.
    """
    if not 0.0 <= limit_px <= MAX_LIMIT_PX:
        raise UsageError(f"`limit_px={limit_px}` is out of range", f"Use 0 to {MAX_LIMIT_PX:g}.")
    options, masks, pan_masks = _asked(options, knobs, mask, pan_mask)
    options = replace(options, tolerance_px=0.0, max_residual_px=limit_px, on_local="warn")
    with _open(source, reference, options, masks, pan_masks) as rasters:
        pair, solution = _solve(rasters, options, progress)
        bands = _check_bands(rasters, pair, solution, limit_px) if options.per_band else None
        solution = without_one_place(pair, solution)
        alignment = _alignment(rasters, pair, solution, rasters.notes())
    misalignment = measure_misalignment(pair, solution)
    return Check(
        judge_misalignment(misalignment, limit_px),
        limit_px,
        misalignment,
        is_affine_enough(misalignment, limit_px, alignment.tie_points),
        alignment,
        bands,
    )


def _check_bands(
    rasters: _Rasters, pair: Pair, solution: Solution, limit_px: float
) -> tuple[BandCheck, ...]:
    """Each band, as `align` finds it with ``per_band``."""
    alignment, heard = _alignment(rasters, pair, solution), {b.number: b for b in solution.bands}
    failed = "; ".join(r.message for r in solution.verdict.reasons if not r.passed)
    finer = "" if pair.source_is_coarser else ": pixels of PAN are larger"
    rows = []
    for number, name in enumerate(rasters.ms.band_names, start=1):
        band = heard.get(number)
        if band is None:
            reason = failed or f"too little tells where it lies{finer}"
            rows.append(BandCheck(number, name, CheckOutcome.CANNOT_TELL, reason=reason))
            continue
        off = measure_band(pair, solution, band)
        outcome = judge_misalignment(off, limit_px)
        rows.append(band_check(band, alignment, off, limit_px, outcome))
    return tuple(rows)


def _solve(
    rasters: _Rasters, asked: AlignOptions, progress: Progress | None
) -> tuple[Pair, Solution]:
    """What the images of two open rasters say."""
    options = rasters.options
    check_order(rasters.ms, rasters.pan, asked)
    try:
        pair, solution = align_rasters(rasters.ms, rasters.pan, options, progress, rasters.timings)
    except NoDataError as error:
        raise under_masks(error, rasters.ms, rasters.pan) from error
    if not asked.pan_band:  # it was chosen: no question whether it is the right one
        kept = tuple(note for note in solution.warnings if note != first_of_many(pair))
        solution = replace(solution, warnings=kept)
    return pair, solution


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
