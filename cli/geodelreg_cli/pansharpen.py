"""``geodelreg pansharpen``: align MS to PAN, then sharpen it, in one go."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geodelreg.flags import as_typed
from geodelreg.options import AlignOptions
from geodelreg.sharpen_options import PansharpenOptions
from geodelreg_cli.console import log_steps, progress_bar
from geodelreg_cli.options import (
    SectionCommand,
    SectionOption,
    add_options,
    build,
    is_default,
    knob_option,
    knob_options,
    ms_and_pan,
    run_options,
    start_run,
)

if TYPE_CHECKING:
    from geodelreg.values.result import Alignment

OUTPUT, SHARPENING, CORRECTION = "Output", "How to sharpen", "How to align"
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


def pansharpen_params() -> list[SectionOption]:
    """Options of ``pansharpen``, in the order of the help."""
    return [
        SectionOption(
            ["-o", "--output"],
            type=click.Path(path_type=Path),
            required=True,
            metavar="OUT",
            section=OUTPUT,
            help="Sharpened raster on PAN's grid: GeoTIFF, COG or VRT.",
        ),
        *(knob_option(PansharpenOptions, name, OUTPUT) for name in WRITTEN),
        *knob_options(PansharpenOptions, SHARPENING, without=WRITTEN),
        SectionOption(
            ["--no-align"],
            is_flag=True,
            section=CORRECTION,
            help="Take MS where its header puts it, as after geodelreg align.",
        ),
        *knob_options(AlignOptions, CORRECTION, without=WITHOUT),
        *run_options(),
    ]


@add_options(pansharpen_params())
@click.command(cls=SectionCommand, epilog=EPILOG)
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
    from geodelreg_cli.outputs import check_targets

    if given["no_align"] and not align_options.pan_band:
        raise click.UsageError("--pan-band auto is found by aligning: name the band, N.")
    check_targets([*sources, reference], [given["output"]], options.overwrite)
    if not given["no_align"]:
        # the geotransforms of a VRT must hold the correction
        if is_default("on_local") and sharpened_driver(given["output"], options) != "VRT":
            align_options = replace(align_options, on_local="field")
        check_sharpenable(sources, reference, given["output"], options, align_options)
    source = sources[0] if len(sources) == 1 else sources
    alignment: Alignment | None = None
    with progress_bar(given["quiet"]) as bar:
        step, parts = log_steps(bar), 1 if given["no_align"] else 2
        if not given["no_align"]:
            aligning = part_of(step, 0, parts)
            alignment = geodelreg.align(source, reference, align_options, progress=aligning)
        geodelreg.pansharpen(
            source,
            reference,
            given["output"],
            options,
            alignment=alignment,
            allow=align_options.allow,
            pan_band=(alignment.options if alignment else align_options).pan_band,
            progress=part_of(step, parts - 1, parts),
        )
    for warning in alignment.warnings if alignment else ():
        logging.getLogger(__name__).warning("warning: %s", warning)
    if alignment is not None and not given["quiet"]:
        from geodelreg.product.report import summary_text

        click.echo(as_typed(summary_text(alignment)), err=True)
