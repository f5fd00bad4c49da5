"""What users call to sharpen MS with PAN, aligned or as it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np

from geodelreg.door.names import as_path
from geodelreg.door.opening import allowing
from geodelreg.errors import UsageError
from geodelreg.fine.tone import robust_band_weights
from geodelreg.geotiff.atomic import together
from geodelreg.knobs import PansharpenKnobs
from geodelreg.options import BEYOND_A_HEADER, AlignOptions
from geodelreg.pair import Progress
from geodelreg.product.common_grid import Sharpening, SpectralFile, check_finer
from geodelreg.product.pansharpen import (
    matched_samples,
    sharpened_driver,
    spectral_bands,
    write_pansharpened,
)
from geodelreg.product.provenance import provenance_tags
from geodelreg.product.scratch import file_of, scratch_folder
from geodelreg.raster.inputs import AnyRaster, Opened, opened, rasters_of
from geodelreg.raster.opening import dataset_grid, open_dataset
from geodelreg.raster.reader import check_band, open_raster
from geodelreg.sharpen_options import PansharpenOptions
from geodelreg.values.maps import PixelMap
from geodelreg.values.result import Alignment, Correction
from geodelreg.writing import (
    AnyPath,
    check_accepted,
    check_is_no_stream,
    correction_of_file,
    input_paths,
    masks_of,
    placement_of,
)
from geodelreg.writing_bands import bands_by_file, placed_bands


def pansharpen(
    source: AnyRaster | Sequence[AnyRaster],
    reference: AnyRaster,
    target: AnyPath,
    options: PansharpenOptions | None = None,
    *,
    alignment: Alignment | None = None,
    allow: str = "local",
    pan_band: int = 1,
    progress: Progress | None = None,
    **knobs: Unpack[PansharpenKnobs],
) -> None:
    """Sharpen MS with PAN on PAN's exact grid, with GDAL's weighted Brovey.

    Parameters
    ----------
    source : raster or sequence of rasters
        The MS raster, or one per band, as for `align`.  What is in no file is first written to a
        temporary one, window by window.
    reference : raster
        The PAN raster.
    target : path
        GeoTIFF, COG or VRT.  A VRT names its sources: these must be files, and it holds no
        correction that no geotransform holds.
    options : PansharpenOptions, optional
    alignment : Alignment, optional
        Of these rasters, as returned by `align`; without it MS lies where its header says.
    allow : str
        What names of rasters may open, as in `AlignOptions`.
    pan_band : int
        Band of PAN, from 1.
    progress : callable, optional
        Called with a fraction 0 to 1 and the name of the step.
    **knobs
        Fields of `PansharpenOptions`, which replace those of `options`.

    Raises
    ------
    AlignmentRefusedError
        The alignment was refused: there is no correction.
    UsageError
        Also when the alignment is of other rasters.
    OutputExistsError, OutputIsInputError, OutputUnwritableError, NoOverlapError, ...
        Nothing is then changed on disk.
    TypeError
        When an argument is of the wrong type.
    """
    options = replace(options or PansharpenOptions(), **knobs)
    check_is_no_stream(Path(target))
    if alignment is not None:
        check_accepted(alignment)
    masks = [] if alignment is None else masks_of(alignment)
    with allowing(allow), ExitStack() as stack:
        rasters = [opened(one, stack, allow) for one in rasters_of(source)]
        pan = opened(reference, stack, allow)
        if alignment is not None:
            _check_same(alignment, rasters)
        if sharpened_driver(Path(target), options) == "VRT":
            _check_lazy(Path(target), [*rasters, pan], alignment)
        names = [one.name for one in (*rasters, pan) if one.is_file]
        run = together([Path(target)], lambda: input_paths([*names, *masks], allow))
        stack.enter_context(run)
        *paths, pan_path = _paths([*rasters, pan], stack)
        what = _sharpening(paths, pan_path, pan_band, options, alignment, allow)
        weights = _weights(what, options)
        tags = {} if alignment is None else provenance_tags(alignment)
        write_pansharpened(what, Path(target), weights, tags, options, progress)


def _check_same(alignment: Alignment, rasters: Sequence[Opened]) -> None:
    """Refuse an alignment of other rasters, or of these before their headers were corrected."""
    names, known = [one.name for one in rasters], alignment.source
    same = len(known.paths) == len(rasters)
    if same and len(rasters) == 1:
        grid = rasters[0].grid()
        same = (grid.transform, grid.shape) == (known.grid.transform, known.grid.shape)
    if not same:
        raise UsageError(
            f"the alignment is of {', '.join(known.paths)}, and {', '.join(names)} lies elsewhere",
            "Align these rasters, or leave the alignment out where they are corrected already.",
        )


def check_sharpenable(
    sources: Sequence[str],
    reference: str,
    target: Path,
    options: PansharpenOptions,
    align: AlignOptions,
) -> None:
    """Refuse files that could not be sharpened so, before they are aligned.

    Raises
    ------
    UsageError, BandNumberError, GeodelregError
    """
    if sharpened_driver(target, options) == "VRT":
        _check_vrt_holds(target, "field" if align.on_local == "field" else align.model)
    paths, pan_path = [as_path(source) for source in sources], as_path(reference)
    with allowing(align.allow):
        _sharpening(paths, pan_path, align.pan_band or 1, options, None, align.allow)


def _sharpening(
    paths: Sequence[Path],
    pan_path: Path,
    pan_band: int,
    options: PansharpenOptions,
    alignment: Alignment | None,
    allow: str,
) -> Sharpening:
    with open_raster(pan_path, allow=allow) as reader:
        check_band(reader, pan_band)
    by_file = {} if alignment is None else _bands_by_file(alignment)
    files = [
        one for path in paths for one in _spectral_files(path, alignment, by_file.get(path), allow)
    ]
    bands = spectral_bands(files, options.given_bands())
    what = Sharpening(files, pan_path, pan_band, bands)
    check_finer(what)
    if options.weights not in ("auto", "equal"):
        given = options.given_weights()
        if len(given) != len(bands):
            raise UsageError(
                f"`weights={options.weights!r}` are {len(given)}, and {len(bands)} bands are "
                "sharpened",
                "Give one weight to each band, or use auto.",
            )
    return what


def _check_vrt_holds(target: Path, model: str) -> None:
    """Refuse a VRT for a correction that no geotransform holds."""
    if model in BEYOND_A_HEADER:
        raise UsageError(
            f"{target} would be a VRT, and no geotransform in it holds `model={model!r}`",
            "Name a GeoTIFF (.tif), or use another model.",
        )


def _check_lazy(target: Path, rasters: Sequence[Opened], alignment: Alignment | None) -> None:
    """Refuse a VRT of what it cannot name or place."""
    unnamed = [one.name for one in rasters if not one.is_file]
    if unnamed:
        raise UsageError(
            f"{target} would be a VRT, and {', '.join(unnamed)} is no file that it could name",
            "Name a GeoTIFF (.tif).",
        )
    if alignment is not None:
        _check_vrt_holds(target, alignment.correction.model)


def _paths(rasters: Sequence[Opened], stack: ExitStack) -> list[Path]:
    """The file of each raster, PAN last; one is written where there is none."""
    if all(one.is_file for one in rasters):
        return [as_path(one.name) for one in rasters]
    folder, paths = stack.enter_context(scratch_folder()), []
    for number, raster in enumerate(rasters, start=1):
        name = f"ms{number}.tif" if number < len(rasters) else "pan.tif"
        paths.append(as_path(raster.name) if raster.is_file else folder / name)
        if not raster.is_file:
            file_of(raster, paths[-1])
    return paths


def _bands_by_file(alignment: Alignment) -> dict[Path, dict[int, PixelMap]]:
    """Bands of each file that have a place of their own."""
    if alignment.solution.bands and alignment.source.in_memory:
        raise UsageError(
            "bands with places of their own (`per_band=True`) are sharpened from files only",
            "Give paths, also where they are aligned.",
        )
    return bands_by_file(alignment)


def _spectral_files(
    path: Path, alignment: Alignment | None, apart: Mapping[int, PixelMap] | None, allow: str
) -> list[SpectralFile]:
    """A file where it lies, once for each band where some have places of their own (`apart`)."""
    with open_dataset(str(path), allow=allow) as dataset:
        if alignment is None:
            grid = dataset_grid(str(path), dataset)
            as_it_is = Correction("none", grid.crs_wkt, grid.transform, grid.transform)
            return [SpectralFile.of(path, dataset, as_it_is)]
        correction, _ = correction_of_file(alignment, path)
        placement = placement_of(alignment, correction)
        whole = SpectralFile.of(path, dataset, correction, placement)
    if not apart:
        return [whole]
    found, own = [], placed_bands(alignment, apart, correction)
    for band in whole.bands:
        one = replace(whole, bands=[band])
        affine = own[band].as_affine() if band in own else None
        if affine is not None:
            moved = replace(correction, corrected=correction.original @ affine)
            one = replace(one, correction=moved, placement=None)
        elif band in own:
            one = replace(one, placement=own[band])
        found.append(one)
    return found


def _weights(what: Sharpening, options: PansharpenOptions) -> list[float]:
    """Weights of the spectral bands; fitted ones are scaled so that the values of MS are kept."""
    count = len(what.bands)
    if options.weights not in ("auto", "equal"):
        return list(options.given_weights())
    if options.weights == "equal":
        return [1.0 / count] * count
    bands, pan = matched_samples(what)
    weights = robust_band_weights(bands, pan)[0] if len(pan) else np.zeros(count)
    brightness = float((weights @ bands).mean()) if weights.any() else 0.0
    if brightness <= 0:
        return [1.0 / count] * count
    return [float(weight) for weight in weights * (float(pan.mean()) / brightness)]
