"""What users call to sharpen MS with PAN, aligned or as it is."""

from __future__ import annotations

from collections.abc import Sequence
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
from geodelreg.options import PansharpenOptions, check_header_holds
from geodelreg.pair import Progress
from geodelreg.product.common_grid import Sharpening, SpectralFile, check_finer
from geodelreg.product.pansharpen import matched_samples, spectral_bands, write_pansharpened
from geodelreg.product.provenance import provenance_tags
from geodelreg.raster.opening import dataset_grid, open_dataset
from geodelreg.raster.reader import check_band, open_raster
from geodelreg.values.result import Alignment, Correction
from geodelreg.writing import AnyPath, correction_of_file, input_paths, masks_of, paths_of


def pansharpen(
    source: AnyPath | Sequence[AnyPath],
    reference: AnyPath,
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
    source : path or sequence of paths
        The MS raster, or one file per band.
    reference : path
        The PAN raster.
    target : path
        GeoTIFF, COG or VRT.
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
    OutputExistsError, OutputIsInputError, OutputUnwritableError, NoOverlapError, UsageError, ...
        Nothing is then changed on disk.
    """
    options = replace(options or PansharpenOptions(), **knobs)
    if alignment is not None:
        check_header_holds(alignment.solution.model)
    paths = [as_path(path) for path in paths_of(source)]
    masks = () if alignment is None else masks_of(alignment)
    names = [*map(str, paths), str(reference), *masks]
    with allowing(allow), together([Path(target)], lambda: input_paths(names, allow)):
        with open_raster(reference, allow=allow) as pan:
            check_band(pan, pan_band)
        files = [_spectral_file(path, alignment, allow) for path in paths]
        bands = spectral_bands(files, options.given_bands())
        what = Sharpening(files, Path(reference), pan_band, bands)
        check_finer(what)
        weights = _weights(what, options)
        tags = {} if alignment is None else provenance_tags(alignment)
        write_pansharpened(what, Path(target), weights, tags, options, progress)


def _spectral_file(path: Path, alignment: Alignment | None, allow: str) -> SpectralFile:
    with open_dataset(str(path), allow=allow) as dataset:
        if alignment is not None:
            return SpectralFile.of(path, dataset, correction_of_file(alignment, path)[0])
        grid = dataset_grid(str(path), dataset)
        as_it_is = Correction("none", grid.crs_wkt, grid.transform, grid.transform)
        return SpectralFile.of(path, dataset, as_it_is)


def _weights(what: Sharpening, options: PansharpenOptions) -> list[float]:
    """Weights of the spectral bands; fitted ones are scaled so that the values of MS are kept."""
    count = len(what.bands)
    if options.weights not in ("auto", "equal"):
        given = options.given_weights()
        if len(given) != count:
            raise UsageError(
                f"`weights={options.weights!r}` are {len(given)}, and {count} bands are sharpened",
                "Give one weight to each band, or use auto.",
            )
        return list(given)
    if options.weights == "equal":
        return [1.0 / count] * count
    bands, pan = matched_samples(what)
    weights = robust_band_weights(bands, pan)[0] if len(pan) else np.zeros(count)
    brightness = float((weights @ bands).mean()) if weights.any() else 0.0
    if brightness <= 0:
        return [1.0 / count] * count
    return [float(weight) for weight in weights * (float(pan.mean()) / brightness)]
