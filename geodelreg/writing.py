"""What users call to write: the corrected rasters, and control points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Unpack

from geodelreg.door.names import as_path
from geodelreg.door.opening import as_allowed
from geodelreg.errors import AlignmentRefusedError, OutputUnwritableError, UsageError
from geodelreg.geotiff.targets import STDOUT
from geodelreg.knobs import WriteKnobs
from geodelreg.masking import parse_mask
from geodelreg.options import WriteOptions, check_header_holds, one_header
from geodelreg.product.provenance import provenance_tags
from geodelreg.raster.input_files import input_files
from geodelreg.raster.reader import open_raster
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Gcp
from geodelreg.values.result import Alignment, Correction, Outcome

AnyPath = str | PathLike[str]


@as_allowed
def write(
    alignment: Alignment,
    target: AnyPath,
    options: WriteOptions | None = None,
    **knobs: Unpack[WriteKnobs],
) -> list[str]:
    """Write the MS raster with its corrected georeferencing and the same pixels.

    Of several MS files all are written or none.

    Parameters
    ----------
    alignment : Alignment
        As returned by `align`; one that is already aligned gives a copy with provenance.
    target : path
        The output; with several MS files the folder for them, made when missing.
    options : WriteOptions, optional
        Its `warp` resamples north-up instead of correcting the header.
    **knobs
        Fields of `WriteOptions`, which replace those of `options`.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    AlignmentRefusedError
        Of an alignment that was refused: there is no correction to write.
    OutputExistsError, OutputIsInputError, OutputUnwritableError, LossyOutputError, ...
        Nothing is then changed on disk.
    """
    from geodelreg.geotiff.atomic import together
    from geodelreg.geotiff.corrected import write_corrected
    from geodelreg.geotiff.sidecars import stale_beside
    from geodelreg.geotiff.targets import check_replaceable
    from geodelreg.product.gcps.lattice import gcps_of_map
    from geodelreg.product.warp import grid_asked, write_warped
    from geodelreg.writing_bands import bands_by_file, placed_bands, write_bands

    check_accepted(alignment)
    options = replace(options or WriteOptions(), **knobs)
    check_is_file(alignment)
    if options.warp and options.warp_grid == "pan" and not alignment.has_pan:
        raise UsageError(
            "`warp_grid='pan'` needs PAN, and the correction was fitted to points alone",
            "Refit with PAN, or use `warp_grid='ms'`.",
        )
    if alignment.options.per_band and not options.warp:
        return write_bands(alignment, Path(target), options)
    if not (options.warp or options.georef == "gcps"):
        _check_header_holds(alignment)
    tags, allow = provenance_tags(alignment), alignment.options.allow
    beside = [] if options.like is None else input_paths([options.like], allow)
    pan = Path(alignment.reference.paths[0])
    options, onto, model = grid_asked(options, alignment.reference.grid, pan, allow)
    by_file = bands_by_file(alignment) if options.warp else {}
    notes: list[str] = []
    with (
        _targets(alignment, Path(target)) as pairs,
        together([out for _, out in pairs], lambda: [*inputs_of(alignment), *beside]),
    ):
        for path, out in pairs:
            check_replaceable(out, options.overwrite, stale_beside(out, path))
        for path, out in pairs:
            correction, gcps = correction_of_file(alignment, path)
            placement = placement_of(alignment, correction)
            if options.warp:
                bands = placed_bands(alignment, by_file.get(path, {}), correction)
                notes += write_warped(
                    path, out, correction, onto, tags, options, model, placement, bands
                )
                continue
            if placement is not None:
                with open_raster(path, allow=allow) as reader:
                    gcps = gcps_of_map(str(path), placement, reader.grid)
            notes += write_corrected(path, out, correction, gcps, tags, options)
    return notes


@as_allowed
def write_in_place(alignment: Alignment) -> list[str]:
    """Correct the headers of the MS files themselves, of all or none; `revert` takes it back.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    UnsafeInPlaceError, FileLockedError, OutputUnwritableError
        The files are then as they were.
    """
    from geodelreg.geotiff.atomic import tidy, together
    from geodelreg.geotiff.inplace import edit_in_place

    check_accepted(alignment)
    if alignment.options.per_band:
        raise one_header()
    _check_header_holds(alignment)
    check_is_file(alignment)
    if alignment.verdict.outcome is Outcome.ALREADY_ALIGNED:
        tidy(map(Path, alignment.source.paths))
        return []
    tags = provenance_tags(alignment)
    notes: list[str] = []
    with together(map(Path, alignment.source.paths)):
        for name in alignment.source.paths:
            notes += edit_in_place(Path(name), *correction_of_file(alignment, Path(name)), tags)
    return notes


def _check_header_holds(alignment: Alignment) -> None:
    if not alignment.fits_a_header:
        check_header_holds(alignment.solution.model)


def placement_of(alignment: Alignment, correction: Correction) -> PixelMap | None:
    """Pixels of an MS file to those of its header, where no geotransform holds the correction.

    Parameters
    ----------
    alignment : Alignment
    correction : Correction
        Of the file, by `correction_of_file`.
    """
    from geodelreg.geo.maps.affine import AffineMap

    if alignment.fits_a_header:
        return None
    to_shared = AffineMap(~alignment.source.grid.transform @ correction.original)
    shared = alignment.solution.map
    if to_shared.affine.is_identity:
        return shared
    return to_shared.then(shared).then(AffineMap(~to_shared.affine))


@as_allowed
def export_gcps(
    alignment: Alignment,
    path: AnyPath,
    format: str | None = None,  # noqa: A002 - the field's word
    overwrite: bool = False,
    *,
    points: str = "kept",
) -> None:
    """Write the kept tie points as ground control points of the MS raster.

    Parameters
    ----------
    alignment : Alignment
    path : path
        ``-`` is standard output.
    format : str, optional
        One of ``geodelreg.product.gcps.GCP_FORMATS``; by the extension when not given.
    overwrite : bool
    points : str
        ``kept``, or ``all`` with the rejected ones, as points that are not enabled: QGIS, GeoJSON,
        GeoPackage, FlatGeobuf.

    Raises
    ------
    GcpFormatError
        If the format is not known, or has no room for rejected points.
    OutputExistsError, OutputIsInputError, OutputUnwritableError
    """
    from geodelreg.geotiff.atomic import together
    from geodelreg.product.gcps import (
        GCP_FORMATS,
        format_of,
        gcp_context,
        gcps_from_alignment,
        write_gcps,
    )

    check_accepted(alignment)
    if points not in ("kept", "all"):
        raise UsageError(f"`points={points!r}` is unknown", "Use one of: kept, all.")
    every = points == "all"
    by_band = GCP_FORMATS[format_of(Path(path), format)].has_fields
    gcps = gcps_from_alignment(alignment, every, bands=by_band)
    context = gcp_context(alignment, every)
    with together(inputs=lambda: inputs_of(alignment)):
        write_gcps(Path(path), gcps, format, context=context, overwrite=overwrite)


@as_allowed
def write_displacement(alignment: Alignment, path: AnyPath, overwrite: bool = False) -> None:
    """Write how far the correction moves every place, as a GeoTIFF for other programs.

    Its bands are metres east and north, PAN pixels right and down, and the standard error; with
    ``per_band`` they are those of the common map.

    Parameters
    ----------
    alignment : Alignment
    path : path
    overwrite : bool

    Raises
    ------
    AlignmentRefusedError, CrsTransformError
    OutputExistsError, OutputIsInputError, OutputUnwritableError
    """
    from geodelreg.geotiff.atomic import together
    from geodelreg.product.displacement import write_grid

    check_accepted(alignment)
    with together(inputs=lambda: inputs_of(alignment)):
        write_grid(alignment, Path(path), overwrite)


def check_accepted(alignment: Alignment) -> None:
    """Write nothing of a refused alignment: its map is no correction.

    Raises
    ------
    AlignmentRefusedError, TypeError
    """
    if not isinstance(alignment, Alignment):
        raise TypeError(f"{type(alignment).__name__} is no Alignment")
    if not alignment.verdict.accepted:
        name = Path(alignment.source.paths[0]).name
        raise AlignmentRefusedError(
            f"the alignment of {name} was refused: there is no correction to write",
            alignment.verdict.remedy,
            alignment,
        )


def input_paths(names: Iterable[str], allow: str) -> list[Path]:
    """Whatever must not be written to when the files of some names are read.

    Parameters
    ----------
    names : iterable of str
        Rasters and masks.
    allow : str
        What may be opened, `AlignOptions.allow`.

    Returns
    -------
    list of Path
        The files, those that they consist of, and the side files that they have or could have.
    """
    from geodelreg.geotiff.sidecars import possible_sidecars

    files = input_files(names, allow)
    return [*files, *(side for file in files for side in possible_sidecars(file))]


def inputs_of(alignment: Alignment) -> list[Path]:
    """Whatever an alignment was read from."""
    rasters = [one for one in (alignment.source, alignment.reference) if not one.in_memory]
    names = [path for one in rasters for path in one.paths]
    names += alignment.points.paths if alignment.points else ()
    return input_paths([*names, *masks_of(alignment)], alignment.options.allow)


def check_is_file(alignment: Alignment) -> None:
    """Refuse to write MS that was read from memory.

    Raises
    ------
    UsageError
    """
    if alignment.source.in_memory:
        raise UsageError(
            f"MS is no file but {', '.join(alignment.source.paths)}",
            "Correct it in memory, alignment.apply(dataarray), or align the file itself.",
        )


def check_is_no_stream(target: Path) -> None:
    """Refuse a raster on standard output.

    Raises
    ------
    UsageError
    """
    if target == STDOUT:
        raise UsageError("A raster cannot be written to standard output", "Name a file.")


def masks_of(alignment: Alignment) -> list[str]:
    """Files of the masks that an alignment was told of."""
    options = alignment.options
    return [parse_mask(mask).path for mask in (*options.masks, *options.pan_masks)]


@contextmanager
def _targets(alignment: Alignment, target: Path) -> Iterator[list[tuple[Path, Path]]]:
    """MS files with their outputs; the folder for several is made, and taken back on an error."""
    check_is_no_stream(target)
    sources = [as_path(path) for path in alignment.source.paths]
    if len(sources) == 1:
        yield [(sources[0], target)]
        return
    made = [folder for folder in (target, *target.parents) if not folder.exists()]
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputUnwritableError(
            f"{target} cannot be made a folder ({error.strerror})",
            "With several MS files the output is a folder; name another one.",
        ) from error
    try:
        yield [(path, target / path.name) for path in sources]
    except BaseException:
        with suppress(OSError):
            for folder in made:
                folder.rmdir()
        raise


def correction_of_file(alignment: Alignment, path: Path) -> tuple[Correction, tuple[Gcp, ...]]:
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
