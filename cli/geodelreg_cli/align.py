"""``geodelreg align``: parse, align, write what was asked for."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from geodelreg.errors import AlignmentRefusedError, UsageError
from geodelreg.masking import parse_mask
from geodelreg.options import AlignOptions, WriteOptions, check_header_holds
from geodelreg_cli.console import log_steps, progress_bar
from geodelreg_cli.options import (
    GCP_FORMAT,
    SectionCommand,
    SectionOption,
    add_options,
    build,
    knob_option,
    knob_options,
    ms_and_pan,
    run_options,
    start_run,
)

if TYPE_CHECKING:
    from geodelreg.values.result import Alignment

OUTPUT, CORRECTION, FORMAT = "Output", "How to align", "How OUT is written"
FILE = click.Path(path_type=Path)

EPILOG = """\
Examples:

  Correct the header of MS; pixels stay bit-identical:
    geodelreg align ms.tif pan.tif -o aligned.tif

  Edit the header of the file itself (undo it with "geodelreg revert"):
    geodelreg align ms.tif pan.tif --in-place

  One file per band, one correction for all of them; OUT is a folder:
    geodelreg align B2.tif B3.tif B4.tif B8.tif -o aligned/

  Leave out the clouds that the Landsat quality band knows of:
    geodelreg align ms.tif pan.tif -o aligned.tif --mask LC08_..._QA_PIXEL.TIF

  Also write the control points for QGIS and GDAL, a report and a figure:
    geodelreg align ms.tif pan.tif -o aligned.tif --gcps ms.points \\
        --gcps ms.geojson --report aligned.json --figure aligned.png

  Look before you write, and pick one number out of the result:
    geodelreg align ms.tif pan.tif --dry-run --json | jq .accuracy

  Resample onto the grid of PAN instead of correcting the header:
    geodelreg align ms.tif pan.tif -o aligned.tif --warp --grid pan

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 refused (nothing written, the reason on stderr).
"""


@dataclass(frozen=True, slots=True)
class Request:
    """What the user asked for, checked for contradictions."""

    sources: tuple[str, ...]
    reference: str
    output: Path | None
    in_place: bool
    dry_run: bool
    gcps: tuple[Path, ...]
    gcp_format: str | None
    report: Path | None
    figure: Path | None
    json: bool
    quiet: bool
    options: AlignOptions
    write_options: WriteOptions


def align_params() -> list[SectionOption]:
    """Options of ``align``, in the order of the help."""

    def flag(*names: str, section: str, **kwargs: Any) -> SectionOption:
        return SectionOption(names, section=section, **kwargs)

    return [
        flag(
            "-o",
            "--output",
            type=FILE,
            metavar="OUT",
            section=OUTPUT,
            help="Corrected MS raster; with several MS files, the folder for them: all or none of "
            "them appear.",
        ),
        flag(
            "--in-place",
            is_flag=True,
            section=OUTPUT,
            help="Correct the header of MS itself, whatever its size (of all MS files or none); "
            "keeps a record to undo it.",
        ),
        flag(
            "--dry-run",
            is_flag=True,
            section=OUTPUT,
            help="Find and report the correction, write no raster.",
        ),
        knob_option(WriteOptions, "overwrite", OUTPUT),
        flag(
            "--gcps",
            type=FILE,
            multiple=True,
            metavar="FILE",
            section=OUTPUT,
            help="Write the tie points as ground control points; the format follows the extension: "
            ".points QGIS, .txt gdal_translate --optfile, .csv gdal raster edit, .geojson, .vrt, "
            ".pts ENVI; - writes to stdout. May be repeated.",
        ),
        flag(
            "--gcp-format",
            type=GCP_FORMAT,
            section=OUTPUT,
            help="Format of --gcps, when the extension does not say it.",
        ),
        flag(
            "--report",
            type=FILE,
            metavar="FILE.json",
            section=OUTPUT,
            help="Write everything that was found out as JSON; also after a refusal. - writes to "
            "stdout.",
        ),
        flag(
            "--figure",
            type=FILE,
            metavar="FILE.png",
            section=OUTPUT,
            help="Draw the tie points on both images (needs matplotlib, the report extra); - is "
            "stdout.",
        ),
        flag("--json", is_flag=True, section=OUTPUT, help="Print the report on stdout."),
        *knob_options(AlignOptions, CORRECTION, without=["threads", "allow"]),
        *knob_options(WriteOptions, FORMAT, without=["overwrite"]),
        *run_options(),
    ]


@add_options(align_params())
@click.command(cls=SectionCommand, epilog=EPILOG)
@click.argument("rasters", metavar="MS... PAN", nargs=-1, required=True)
def align(rasters: tuple[str, ...], **given: Any) -> None:
    """Correct the georeferencing of MS so that it fits PAN.

    MS is a multispectral raster, or several files with one band each; PAN, the last argument, is
    the raster to fit to. Both need a coordinate reference system and a geotransform; the two
    systems may differ. OUT is MS with a corrected header: same pixels, same tags. An alignment
    that the images do not support is refused, and nothing is written.
    """
    start_run(given)
    request = _request(rasters, given)
    _run(request, _check_outputs(request))


def _request(rasters: tuple[str, ...], given: dict[str, Any]) -> Request:
    sources, reference = ms_and_pan(rasters)
    ways = [given["output"] is not None, given["in_place"], given["dry_run"]]
    if sum(ways) != 1:
        raise click.UsageError("Say where the result goes: one of -o OUT, --in-place, --dry-run.")
    write_options = build(WriteOptions, given)
    if given["in_place"] and write_options not in (WriteOptions(), WriteOptions(overwrite=True)):
        raise click.UsageError(
            "--in-place corrects the header and nothing else: drop --of, --co, --georef, "
            "--strip-rpc and --warp, or write to -o OUT."
        )
    options = build(AlignOptions, given)
    if not given["dry_run"] and not _carries_all(write_options):
        check_header_holds("field" if options.on_local == "field" else options.model)
    if write_options.warp and _is_default("on_local"):
        options = replace(options, on_local="field")
    if given["gcp_format"] is not None and not given["gcps"]:
        raise click.UsageError("--gcp-format needs --gcps FILE.")
    return Request(
        sources=sources,
        reference=reference,
        output=given["output"],
        in_place=given["in_place"],
        dry_run=given["dry_run"],
        gcps=given["gcps"],
        gcp_format=given["gcp_format"],
        report=given["report"],
        figure=given["figure"],
        json=given["json"],
        quiet=given["quiet"],
        options=options,
        write_options=write_options,
    )


def _carries_all(options: WriteOptions) -> bool:
    """True of outputs that hold what no geotransform does."""
    return options.warp or options.georef == "gcps"


def _is_default(name: str) -> bool:
    """True of an option that the user has not given."""
    source = click.get_current_context().get_parameter_source(name)
    return source in (None, ParameterSource.DEFAULT)


def _check_outputs(request: Request) -> list[Path]:
    """Refuse what cannot be written, after settling what a killed run has left beside it.

    Returns
    -------
    list of Path
        Everything that is read, down to the sources of VRTs and side files.
    """
    from geodelreg.product.atomic import tidy
    from geodelreg.product.targets import STDOUT, Inputs
    from geodelreg_cli.outputs import check_targets, raster_targets

    _check_gcp_formats(request)
    side_files = [path for path in (*request.gcps, request.report, request.figure) if path]
    masks = (*request.options.masks, *request.options.pan_masks)
    inputs = [*request.sources, request.reference, *(parse_mask(mask).path for mask in masks)]
    try:
        rasters = [] if request.output is None else raster_targets(request.sources, request.output)
        written = [*rasters, *(path for path in side_files if path != STDOUT)]
        tidy([*written, *(map(Path, request.sources) if request.in_place else ())])
        check_targets(
            inputs,
            [*rasters, *side_files, *([STDOUT] if request.json else [])],
            request.write_options.overwrite,
            request.output if len(request.sources) > 1 else None,
            rasters,
        )
        if request.figure is not None:
            from geodelreg.product.figures import check_drawable

            check_drawable(request.figure)
    except UsageError as error:
        raise click.UsageError(str(error)) from error
    if not written:
        return []
    from geodelreg.writing import input_paths

    read = input_paths(inputs, request.options.allow)
    known = Inputs(read)
    for path in written:
        known.check(path)
    return read


def _check_gcp_formats(request: Request) -> None:
    if not request.gcps or request.gcp_format is not None:
        return
    from geodelreg.product.gcps import GCP_FORMATS

    known = {suffix for spec in GCP_FORMATS.values() for suffix in spec.extensions}
    for path in request.gcps:
        if path.suffix.lower() not in known:
            raise click.UsageError(
                f"--gcps {path}: the extension says no format; add --gcp-format, or use one of "
                + ", ".join(sorted(known))
            )


def _run(request: Request, inputs: Sequence[Path]) -> None:
    """Align, then write what was asked for, all or nothing; a refusal leaves the report only."""
    import geodelreg
    from geodelreg.product.atomic import together
    from geodelreg.product.report import report_json, summary_text

    source = request.sources[0] if len(request.sources) == 1 else request.sources
    try:
        with progress_bar(request.quiet) as bar:
            alignment = geodelreg.align(
                source, request.reference, request.options, progress=log_steps(bar)
            )
    except AlignmentRefusedError as refusal:
        if refusal.alignment is not None:
            with together(inputs=lambda: inputs):
                _write_report(report_json(refusal.alignment), request)
            if not request.quiet:
                click.echo(_step_counts(refusal.alignment), err=True)
        raise
    report = report_json(alignment)  # of the inputs as they are: --in-place changes one
    with together(inputs=lambda: inputs):
        _write(alignment, request)
        _write_report(report, request)
    if not request.quiet:
        click.echo(summary_text(alignment), err=True)
        click.echo(_step_counts(alignment), err=True)


def _step_counts(alignment: Alignment) -> str:
    """Points that survive each step, as in the paper's "112 → 97 → 91"."""
    counts = alignment.solution.step_counts.items()
    return "Points: " + " → ".join(f"{count} ({step})" for step, count in counts)


def _write(alignment: Alignment, request: Request) -> None:
    """Write the raster, then the control points and the figure."""
    import geodelreg
    from geodelreg_cli.figure import bands_to_show

    overwrite = request.write_options.overwrite
    shown = None if request.figure is None else bands_to_show(alignment)
    warnings: list[str] = []
    if request.in_place:
        warnings = geodelreg.write_in_place(alignment)
    elif request.output is not None:
        warnings = geodelreg.write(alignment, request.output, request.write_options)
    for warning in (*alignment.warnings, *warnings):
        logging.getLogger(__name__).warning("warning: %s", warning)
    for path in request.gcps:
        geodelreg.export_gcps(alignment, path, request.gcp_format, overwrite=overwrite)
    if request.figure is not None and shown is not None:
        from geodelreg.product.figures import draw_matches

        draw_matches(*shown, alignment, request.figure, overwrite=overwrite)


def _write_report(text: str, request: Request) -> None:
    from geodelreg.product.atomic import write_text_atomically
    from geodelreg.product.targets import STDOUT

    for path in (request.report, STDOUT if request.json else None):
        if path is not None:
            write_text_atomically(path, text + "\n", request.write_options.overwrite)
