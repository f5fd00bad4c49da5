"""Writing MS of which each band lies somewhere else, without resampling it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    from geodelreg.writing import correction_of_file, inputs_of

    if options.georef == "gcps":
        raise UsageError("`georef='gcps'` has one place for all bands", "Drop it, or `per_band`.")
    check_header_holds(alignment.solution.model)
    by_file, files = bands_by_file(alignment), []
    for path in map(as_path, alignment.source.paths):
        correction = correction_of_file(alignment, path)[0]
        bands = _geotransforms(alignment, by_file.get(path, {}), correction)
        files.append((path, correction, bands))
    with together(inputs=lambda: inputs_of(alignment)):
        return write_apart(files, target, provenance_tags(alignment), options)


def write_apart(
    files: Sequence[tuple[Path, Correction, Mapping[int, Correction]]],
    target: Path,
    tags: Mapping[str, str],
    options: WriteOptions,
) -> list[str]:
    """Write bands with headers of their own.

    Parameters
    ----------
    files : sequence of (Path, Correction, mapping of int to Correction)
        Rasters, each with its correction and those of bands, from 1, that lie elsewhere.
    target : Path
        Folder, made when missing, or a VRT of one file.
    tags : mapping of str to str
        Provenance.
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

    if bands_target(target, len(files)):
        ((path, correction, bands),) = files
        with together([target]):
            check_replaceable(target, options.overwrite)
            placed = {number: one.corrected for number, one in bands.items()}
            write_vrt(path, target, correction.corrected, placed, options)
        return []
    make_folder(target)
    outputs = [
        (path, number, out, bands.get(number, correction))
        for path, correction, bands in files
        for number, out in band_targets(path, target).items()
    ]
    notes: list[str] = []
    with together([out for _, _, out, _ in outputs]):
        for path, _, out, _ in outputs:
            check_replaceable(out, options.overwrite, stale_beside(out, path))
        for path, number, out, correction in outputs:
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
