"""Writing MS of which each band lies somewhere else, without resampling it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from geodelreg.door.names import as_path
from geodelreg.errors import UsageError
from geodelreg.options import WriteOptions, check_header_holds, one_header
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
        raise one_header(f"{target}: ")
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
    by_file = bands_by_file(alignment)
    if bands_target(target, len(paths)):
        with together([target], lambda: inputs_of(alignment)):
            check_replaceable(target, options.overwrite)
            placed = _geotransforms(alignment, by_file.get(paths[0], {}), corrections[paths[0]])
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
        own = {
            path: _geotransforms(alignment, by_file.get(path, {}), corrections[path])
            for path in paths
        }
        for path, number, out in outputs:
            correction = own[path].get(number, corrections[path])
            notes += write_band(path, number, out, correction, tags, options)
    return notes


def bands_by_file(alignment: Alignment) -> dict[Path, dict[int, PixelMap]]:
    """Bands that have a place of their own, by their MS file and their number there.

    Returns
    -------
    dict of Path to dict of int to PixelMap
        Pixels of MS to those of its header, as in the alignment.
    """
    bands = alignment.solution.bands
    if not bands or alignment.verdict.outcome is not Outcome.ALIGNED:
        return {}
    with open_raster(alignment.source.paths, allow=alignment.options.allow) as reader:
        stored = reader.stored
    found: dict[Path, dict[int, PixelMap]] = {}
    for band in bands:
        file, number = stored[band.number - 1]
        found.setdefault(Path(file), {})[number] = band.map
    return found


def placed_bands(
    alignment: Alignment, bands: Mapping[int, PixelMap], correction: Correction
) -> dict[int, PixelMap]:
    """The same of one file: its own pixels to those of its header.

    Parameters
    ----------
    alignment : Alignment
    bands : mapping of int to PixelMap
        Of the file, by `bands_by_file`.
    correction : Correction
        Of the file, by `correction_of_file`.
    """
    from geodelreg.geo.maps.affine import AffineMap

    to_shared = AffineMap(~alignment.source.grid.transform @ correction.original)
    back = AffineMap(~to_shared.affine)
    return {number: to_shared.then(placed).then(back) for number, placed in bands.items()}


def _geotransforms(
    alignment: Alignment, bands: Mapping[int, PixelMap], correction: Correction
) -> dict[int, Correction]:
    """Correction of each band of a file that has one of its own."""
    found = {}
    for number, placed in placed_bands(alignment, bands, correction).items():
        affine = placed.as_affine()
        assert affine is not None
        found[number] = replace(correction, corrected=correction.original @ affine)
    return found
