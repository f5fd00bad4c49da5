"""Writing MS of which each band lies somewhere else, without resampling it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from geodelreg.door.names import as_path
from geodelreg.errors import UsageError
from geodelreg.options import WriteOptions, check_header_holds
from geodelreg.product.provenance import provenance_tags
from geodelreg.raster.reader import open_raster
from geodelreg.values.maps import PixelMap
from geodelreg.values.result import Alignment, Correction, Outcome


def bands_target(target: Path, sources: int) -> bool:
    """True of a VRT, False of a folder.

    Raises
    ------
    UsageError
        It is neither: a header has one place for all bands.
    """
    if target.suffix.lower() == ".vrt" and sources == 1:
        return True
    if target.suffix and not target.is_dir():
        raise UsageError(
            f"{target}: `per_band=True` finds a place for each band, and a header has one for all",
            "Name a folder, for one file per band, or a .vrt of one MS file; or resample "
            "(`warp=True`).",
        )
    return False


def write_bands(alignment: Alignment, target: Path, options: WriteOptions) -> list[str]:
    """Write one file per band with a header of its own, or a VRT; all or nothing.

    Parameters
    ----------
    alignment : Alignment
        With bands.
    target : Path
        Folder, made when missing, or a VRT.
    options : WriteOptions

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    UsageError, OutputExistsError, OutputIsInputError, OutputUnwritableError
    """
    from geodelreg.geotiff.atomic import together
    from geodelreg.geotiff.sidecars import stale_beside
    from geodelreg.geotiff.targets import check_replaceable, make_folder
    from geodelreg.product.band_files import band_targets, write_band, write_vrt
    from geodelreg.writing import correction_of_file, inputs_of

    if options.georef == "gcps":
        raise UsageError("`georef='gcps'` has one place for all bands", "Drop it, or `per_band`.")
    check_header_holds(alignment.solution.model)
    paths = [as_path(path) for path in alignment.source.paths]
    corrections = {path: correction_of_file(alignment, path)[0] for path in paths}
    if bands_target(target, len(paths)):
        with together([target], lambda: inputs_of(alignment)):
            check_replaceable(target, options.overwrite)
            placed = _geotransforms(alignment, paths[0], corrections[paths[0]])
            bands = {number: one.corrected for number, one in placed.items()}
            write_vrt(paths[0], target, corrections[paths[0]].corrected, bands, options)
        return []
    make_folder(target)
    outputs = [
        (path, number, out) for path in paths for number, out in band_targets(path, target).items()
    ]
    tags, notes = provenance_tags(alignment), []
    with together([out for _, _, out in outputs], lambda: inputs_of(alignment)):
        for path, _, out in outputs:
            check_replaceable(out, options.overwrite, stale_beside(out, path))
        own = {path: _geotransforms(alignment, path, corrections[path]) for path in paths}
        for path, number, out in outputs:
            correction = own[path].get(number, corrections[path])
            notes += write_band(path, number, out, correction, tags, options)
    return notes


def _geotransforms(
    alignment: Alignment, path: Path, correction: Correction
) -> dict[int, Correction]:
    """Correction of each band of a file that has one of its own."""
    found = {}
    for number, placed in placed_bands(alignment, path, correction).items():
        affine = placed.as_affine()
        assert affine is not None
        found[number] = replace(correction, corrected=correction.original @ affine)
    return found


def placed_bands(alignment: Alignment, path: Path, correction: Correction) -> dict[int, PixelMap]:
    """Bands of an MS file, by their numbers there, that have a place of their own.

    Parameters
    ----------
    alignment : Alignment
    path : Path
        Of the file.
    correction : Correction
        Of the file, by `correction_of_file`.

    Returns
    -------
    dict of int to PixelMap
        Pixels of the file to those of its header.
    """
    from geodelreg.geo.maps.affine import AffineMap

    bands = alignment.solution.bands
    if not bands or alignment.verdict.outcome is not Outcome.ALIGNED:
        return {}
    with open_raster(alignment.source.paths, allow=alignment.options.allow) as reader:
        stored = reader.stored
    to_shared = AffineMap(~alignment.source.grid.transform @ correction.original)
    found: dict[int, PixelMap] = {}
    for band in bands:
        file, number = stored[band.number - 1]
        if Path(file) == path:
            back = AffineMap(~to_shared.affine)
            found[number] = to_shared.then(band.map).then(back)
    return found
