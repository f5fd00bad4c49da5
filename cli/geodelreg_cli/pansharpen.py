"""``geodelreg pansharpen``: align MS to PAN, then sharpen it, in one go."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from geodelreg.errors import shown
from geodelreg.flags import as_typed
from geodelreg.options import AlignOptions
from geodelreg.sharpen_options import PansharpenOptions
from geodelreg_cli.console import log_steps, progress_bar, warn
from geodelreg_cli.options import (
    FILE,
    build,
    command,
    flag,
    is_default,
    knob_option,
    knob_options,
    ms_and_pan,
    option,
    run_options,
    start_run,
    under,
)

if TYPE_CHECKING:
    from geodelreg.alignment import Alignment

WITHOUT = ("threads", "allow", "ms_nodata", "pan_nodata", "agreeing_bands")
WRITTEN = ("overwrite", "driver", "creation_options")

EPILOG = """\
Examples:

  Align and sharpen:
    geodelreg pansharpen ms.tif pan.tif -o sharp.tif

  One file per band, and only where MS and PAN overlap:
    geodelreg pansharpen B2.tif B3.tif B4.tif B8.tif -o sharp.tif --extent intersection

  MS that is aligned already, as a lazy virtual raster:
    geodelreg pansharpen aligned.tif pan.tif -o sharp.vrt --no-align

  A cloud-optimised GeoTIFF of natural colours with weights of your own:
    geodelreg pansharpen ms.tif pan.tif -o sharp.tif --of COG --bands 3,2,1 --weights 0.3,0.4,0.3

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 alignment refused (nothing is written).
"""


OPTIONS = [
    *under(
        "Output",
        option(
            "-o",
            "--output",
            type=FILE,
            required=True,
            metavar="OUT",
            help="Sharpened raster on PAN's grid: GeoTIFF, COG or VRT.",
        ),
        *(knob_option(PansharpenOptions, name) for name in WRITTEN),
    ),
    *under("How to sharpen", *knob_options(PansharpenOptions, without=WRITTEN)),
    *under(
        "How to align",
        flag("--no-align", help="Take MS where its header puts it, as after geodelreg align."),
        *knob_options(AlignOptions, without=WITHOUT),
    ),
    *run_options(),
]


@command(EPILOG, OPTIONS)
@click.argument("rasters", metavar="MS... PAN", nargs=-1, required=True)
def pansharpen(rasters: tuple[str, ...], **given: Any) -> None:
    """Sharpen MS with PAN on the exact grid of PAN, after aligning it.

    MS is resampled once, from where it really lies onto PAN's pixels; then every band is multiplied
    by PAN over the weighted sum of the bands (GDAL's weighted Brovey). An alignment that the images
    do not support is refused, and nothing is written. Where one affine leaves too much, MS follows
    a field (not into a VRT).
    """
    start_run(given)
    sources, reference = ms_and_pan(rasters)
    options, align_options = build(PansharpenOptions, given), build(AlignOptions, given)
    import geodelreg
    from geodelreg.pair import part_of
    from geodelreg.product.pansharpen import sharpened_driver
    from geodelreg.sharpen import check_sharpenable
    from geodelreg.values.remedies import ROTATES
    from geodelreg_cli.outputs import check_targets

    if given["no_align"] and not align_options.pan_band:
        raise click.UsageError("--pan-band auto is found by aligning: name the band, N.")
    check_targets([*sources, reference], [given["output"]], options.overwrite)
    if not given["no_align"]:
        # the geotransforms of a VRT must hold the correction
        if is_default("on_local") and sharpened_driver(given["output"], options) != "VRT":
            align_options = replace(align_options, on_local="field")
        check_sharpenable(sources, reference, given["output"], options, align_options)
    alignment: Alignment | None = None
    with progress_bar(given["quiet"]) as bar:
        step, parts = log_steps(bar), 1 if given["no_align"] else 2
        if not given["no_align"]:
            aligning = part_of(step, 0, parts)
            alignment = geodelreg.align(sources, reference, align_options, progress=aligning)
        geodelreg.pansharpen(
            sources,
            reference,
            given["output"],
            options,
            alignment=alignment,
            allow=align_options.allow,
            pan_band=(alignment.options if alignment else align_options).pan_band,
            progress=part_of(step, parts - 1, parts),
        )
    if alignment is not None:
        warn(text for text in alignment.warnings if text != ROTATES)  # OUT has the grid of PAN
        if not given["quiet"]:
            *found, _ = alignment.summary().splitlines()  # what to do next is done
            click.echo(as_typed("\n".join(found)), err=True)
            click.echo(shown(f"Written: {given['output']}"), err=True)
