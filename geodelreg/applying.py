"""What users call to apply a correction, found before, to other files of the scene."""

from __future__ import annotations

from pathlib import Path

from geodelreg.door.names import as_path
from geodelreg.door.opening import allowing
from geodelreg.errors import UsageError
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.options import WriteOptions, check_header_holds, one_header
from geodelreg.product.stored import StoredCorrection, read_correction
from geodelreg.raster.reader import open_raster
from geodelreg.writing import AnyPath, input_paths


def apply(
    correction: AnyPath,
    source: AnyPath,
    target: AnyPath | None = None,
    options: WriteOptions | None = None,
    *,
    force: bool = False,
    allow: str = "local",
) -> list[str]:
    """Apply the correction of an alignment to another file that shares the header's error.

    Bands at another resolution, masks and products of a scene are placed by the same header as the
    MS raster that was aligned, and are off by the same amount.

    Parameters
    ----------
    correction : path
        The report of the alignment.
    source : path
        A raster in any CRS and of any pixel size; or a vector file: GeoJSON, GeoPackage, CSV.
    target : path, optional
        The output; without it the header of the raster itself is corrected.  Of a correction with
        ``per_band`` a folder, for one file per band, a VRT, or a raster with `warp`.
    options : WriteOptions, optional
        Its `warp` resamples, which a field needs.
    force : bool
        Also where the file lies elsewhere than the raster that was aligned, or was corrected.
    allow : str
        What may be opened, as in `AlignOptions`.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    ReportError
        `correction` is broken, of another kind, or of a refusal.
    CorrectionMisfitError
        `source` lies elsewhere, or was corrected before.
    UsageError
        No header holds the correction.
    OutputExistsError, OutputUnwritableError, ...
        Nothing is then changed on disk.
    """
    from geodelreg.geotiff.atomic import together
    from geodelreg.product.vectors import VECTORS, write_vector

    options = options or WriteOptions()
    stored = read_correction(as_path(str(correction)))
    file = as_path(str(source))
    if file.suffix.lower() in VECTORS:
        if stored.bands:
            raise UsageError(
                f"{stored.path} tells where each band lies, and {file} has no bands",
                "Make a report without `per_band` for it.",
            )
        if target is None:
            raise UsageError(f"{file} is a vector file, which has no header", "Name an output.")
        with together(inputs=lambda: [file, stored.path]):
            write_vector(stored, file, Path(target), options.overwrite, force)
        return []
    with allowing(allow):
        return _apply_to_raster(stored, file, target, options, force, allow)


def _apply_to_raster(
    stored: StoredCorrection,
    file: Path,
    target: AnyPath | None,
    options: WriteOptions,
    force: bool,
    allow: str,
) -> list[str]:
    from geodelreg.geotiff.atomic import together
    from geodelreg.geotiff.corrected import write_corrected
    from geodelreg.geotiff.inplace import edit_in_place
    from geodelreg.geotiff.sidecars import stale_beside
    from geodelreg.geotiff.targets import check_replaceable
    from geodelreg.product.warp import grid_asked, write_warped
    from geodelreg.writing_bands import write_apart

    with open_raster(file, allow=allow) as reader:
        grid, count = reader.grid, len(reader.band_names)
    if not force:
        stored.check_fits(str(file), grid)
        stored.check_uncorrected(file)
    correction, placement = stored.placed(stored.map, grid)
    apart = stored.of_bands(str(file), grid, count)
    bent = placement is not None or any(held is not None for _, held in apart.values())
    if bent and not options.warp:
        check_header_holds(stored.model)
        raise UsageError(
            f"{file} is in another CRS, in which the correction is no affine",
            "Resample (`warp=True`).",
        )
    if apart and not options.warp:
        if target is None:
            raise one_header()
        bands = {number: own for number, (own, _) in apart.items()}
        with together(inputs=lambda: [*input_paths([str(file)], allow), stored.path]):
            return write_apart([(file, correction, bands)], Path(target), stored.tags, options)
    if target is None:
        with together([file]):
            return edit_in_place(file, correction, (), stored.tags)
    out = Path(target)
    names = [str(file), *([] if options.like is None else [options.like])]
    with together([out], lambda: [*input_paths(names, allow), stored.path]):
        check_replaceable(out, options.overwrite, stale_beside(out, file))
        if not options.warp:
            return write_corrected(file, out, correction, (), stored.tags, options)
        moved = {
            number: held or AffineMap(~grid.transform @ own.corrected)
            for number, (own, held) in apart.items()
        }
        options, onto, model = grid_asked(options, stored.reference, None, allow)
        return write_warped(
            file, out, correction, onto, stored.tags, options, model, placement, moved
        )
