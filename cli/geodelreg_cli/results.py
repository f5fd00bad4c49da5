"""What `align` and `refit` write: asked for and checked first, then all of it or nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geodelreg.errors import AlignmentRefusedError, UsageError, shown
from geodelreg.flags import as_typed
from geodelreg.masking import parse_mask
from geodelreg.options import AlignOptions, WriteOptions, check_header_holds
from geodelreg_cli.console import log_steps, log_timings, progress_bar, warn
from geodelreg_cli.figure import kind_option
from geodelreg_cli.options import (
    FILE,
    GCP_FORMAT,
    SectionOption,
    build,
    flag,
    knob_option,
    option,
    under,
)

if TYPE_CHECKING:
    from geodelreg.pair import Progress
    from geodelreg.values.result import Alignment


@dataclass(frozen=True, slots=True)
class Request:
    """What the user asked for, checked for contradictions; options are called as in the help."""

    sources: tuple[str, ...]
    reference: str | None
    points_file: Path | None
    options: AlignOptions
    write_options: WriteOptions
    output: Path | None
    in_place: bool
    gcps: tuple[Path, ...]
    gcp_format: str | None
    points: str
    report: tuple[Path, ...]
    displacement: Path | None
    figure: Path | None
    figure_kind: str
    keep_candidate: Path | None
    json: bool
    quiet: bool

    @property
    def read_beside(self) -> list[str]:
        """What is read beside MS and masks."""
        names = self.reference, self.points_file, self.write_options.like
        return [str(name) for name in names if name is not None]


def output_options() -> list[SectionOption]:
    """Options that say what is written."""
    return under(
        "Output",
        option(
            "-o",
            "--output",
            type=FILE,
            metavar="OUT",
            help="Corrected MS raster; with several MS files, the folder for them: all or none of "
            "them appear.",
        ),
        flag(
            "--in-place",
            help="Correct the header of MS itself, whatever its size (of all MS files or none); "
            "keeps a record to undo it.",
        ),
        flag("--dry-run", help="Find and report the correction, write no raster."),
        knob_option(WriteOptions, "overwrite"),
        option(
            "--gcps",
            type=FILE,
            multiple=True,
            metavar="FILE",
            help="Write the tie points as ground control points; the format follows the extension: "
            ".points QGIS, .txt gdal_translate --optfile, .csv gdal raster edit, .geojson, .gpkg, "
            ".fgb, .vrt, .pts ENVI; - writes to stdout. May be repeated.",
        ),
        option(
            "--gcp-format",
            type=GCP_FORMAT,
            help="Format of --gcps, when the extension does not say it.",
        ),
        option(
            "--points",
            type=click.Choice(("kept", "all")),
            default="kept",
            show_default=True,
            help="Tie points in --gcps; all has the rejected ones, too (QGIS, "
            "GeoJSON, GeoPackage, FlatGeobuf).",
        ),
        option(
            "--report",
            type=FILE,
            multiple=True,
            metavar="FILE",
            help="Write everything that was found out; also after a refusal. .html is a page to "
            "look at, with before and after (needs the report extra); else JSON. - writes JSON to "
            "stdout. May be repeated.",
        ),
        option(
            "--displacement",
            type=FILE,
            metavar="FILE.tif",
            help="Write how far every place moves, as a GeoTIFF: metres east and north, PAN pixels "
            "right and down, standard error.",
        ),
        option(
            "--figure",
            type=FILE,
            metavar="FILE.png",
            help="Draw the result as PNG, SVG or PDF; also after a refusal (needs matplotlib, the "
            "report extra). - is stdout.",
        ),
        kind_option("--figure-kind"),
        option(
            "--keep-candidate",
            type=FILE,
            metavar="FOLDER",
            help="When refused, keep what was refused there: correction, tie points and figure, in "
            "files named refused_candidate.",
        ),
        flag("--json", help="Print the report on stdout."),
    )


def request_of(
    sources: tuple[str, ...],
    reference: str | None,
    given: dict[str, Any],
    options: AlignOptions,
    points_file: Path | None = None,
) -> Request:
    """What the user asked for.

    Raises
    ------
    click.UsageError, UsageError
        It contradicts itself.
    """
    ways = [given["output"] is not None, given["in_place"], given["dry_run"]]
    if sum(ways) != 1:
        what = "Say where the result goes" if not any(ways) else "The result goes to one place"
        raise click.UsageError(f"{what}: one of -o OUT, --in-place, --dry-run.")
    write_options = build(WriteOptions, given)
    if given["in_place"] and write_options not in (WriteOptions(), WriteOptions(overwrite=True)):
        raise click.UsageError(
            "--in-place corrects the header and nothing else: drop --of, --co, --georef, "
            "--strip-rpc and --warp, or write to -o OUT."
        )
    if not given["dry_run"] and not carries_all(write_options):
        check_header_holds("field" if options.on_local == "field" else options.model)
    if given["gcp_format"] is not None and not given["gcps"]:
        raise click.UsageError("--gcp-format needs --gcps FILE.")
    asked = {one.name: given[one.name] for one in fields(Request) if one.name in given}
    return Request(sources, reference, points_file, options, write_options, **asked)


def carries_all(options: WriteOptions) -> bool:
    """True of outputs that hold what no geotransform does."""
    return options.warp or options.georef == "gcps"


def check_outputs(request: Request) -> list[Path]:
    """Refuse what cannot be written, after settling what a killed run has left beside it.

    Returns
    -------
    list of Path
        Everything that is read, down to the sources of VRTs and side files.
    """
    from geodelreg.geotiff.atomic import tidy
    from geodelreg.geotiff.targets import STDOUT, Inputs
    from geodelreg.report.output import check_report
    from geodelreg_cli.outputs import check_gcp_formats, check_targets, raster_targets

    if request.gcp_format is None:
        check_gcp_formats(request.gcps)
    moves = request.displacement
    if moves == STDOUT:
        raise click.UsageError("--displacement -: a raster cannot be written to standard output.")
    side_files = [path for path in (*request.gcps, *request.report, moves, request.figure) if path]
    masks = (*request.options.masks, *request.options.pan_masks)
    named = [*request.sources, *request.read_beside]
    inputs = [*named, *(parse_mask(mask).path for mask in masks)]
    try:
        apart = request.options.per_band and not request.write_options.warp
        rasters = []
        if request.output is not None:
            rasters = raster_targets(request.sources, request.output, apart)
        written = [*rasters, *(path for path in side_files if path != STDOUT)]
        tidy([*written, *(map(Path, request.sources) if request.in_place else ())])
        check_targets(
            inputs,
            [*rasters, *side_files, *([STDOUT] if request.json else [])],
            request.write_options.overwrite,
            request.output if len(request.sources) > 1 or apart else None,
            rasters,
        )
        if request.keep_candidate is not None:
            from geodelreg.report.candidate import candidate_files

            kept, overwrite = (
                candidate_files(request.keep_candidate),
                request.write_options.overwrite,
            )
            check_targets([*inputs, *map(str, written)], kept, overwrite, request.keep_candidate)
        for path in request.report:
            check_report(path)
        if request.figure is not None:
            from geodelreg.product.figures import check_drawable

            check_drawable(request.figure)
    except UsageError as error:
        raise click.UsageError(as_typed(str(error))) from error
    if not written:
        return []
    from geodelreg.writing import input_paths

    read = input_paths(inputs, request.options.allow)
    known = Inputs(read)
    for path in written:
        known.check(path)
    return read


def run(request: Request, find: Callable[[Progress], Alignment]) -> None:
    """Find the correction, then write what was asked for; of a refusal the reports."""
    from geodelreg.geotiff.atomic import together
    from geodelreg.product.report import summary_text

    inputs = check_outputs(request)
    try:
        with progress_bar(request.quiet) as bar:
            alignment = find(log_steps(bar))
    except AlignmentRefusedError as refusal:
        if refusal.alignment is not None:
            with together(inputs=lambda: inputs):
                _draw(refusal.alignment, request)
                _write_texts(_reports(refusal.alignment, request), request)
            log_timings(refusal.alignment)
            if not request.quiet:
                click.echo(_step_counts(refusal.alignment), err=True)
            _keep_candidate(refusal.alignment, request)
        raise
    reports = _reports(alignment, request)  # of the inputs as they are: --in-place changes one
    with together(inputs=lambda: inputs):
        _draw(alignment, request)
        _write(alignment, request)
        _write_texts(reports, request)
    log_timings(alignment)
    if not request.quiet:
        click.echo(shown(_named(request)), err=True)
        click.echo(as_typed(summary_text(alignment, request.write_options)), err=True)
        click.echo(_step_counts(alignment), err=True)
        click.echo(shown(_written(alignment, request)), err=True)


def _keep_candidate(alignment: Alignment, request: Request) -> None:
    if request.keep_candidate is None:
        return
    from geodelreg.report.candidate import has_candidate, write_candidate

    if not has_candidate(alignment):
        warn(["nothing was found that could be kept"])
        return
    files = write_candidate(alignment, request.keep_candidate, request.write_options.overwrite)
    if not request.quiet:
        click.echo(shown(f"Kept, though refused: {', '.join(map(str, files))}"), err=True)


def _named(request: Request) -> str:
    """The inputs, in one line."""
    more = f" and {len(request.sources) - 1} more" if len(request.sources) > 1 else ""
    others = [("PAN", request.reference), ("points", request.points_file)]
    known = "".join(f", {role} {name}" for role, name in others if name is not None)
    return f"MS {request.sources[0]}{more}{known}"


def _written(alignment: Alignment, request: Request) -> str:
    """The outputs, in one line."""
    from geodelreg.values.result import Outcome

    paths = [
        request.output, *request.gcps, *request.report, request.displacement, request.figure
    ]  # fmt: skip
    names = ", ".join(str(path) for path in paths if path is not None and str(path) != "-")
    if request.in_place and alignment.verdict.outcome is Outcome.ALIGNED:
        names = f"the header of MS{', ' if names else ''}{names}"
    dry = request.output is None and not request.in_place
    return f"Written: {names or ('nothing (dry run)' if dry else 'nothing')}"


def _step_counts(alignment: Alignment) -> str:
    """Points that survive each step, as in the paper's "112 → 97 → 91"."""
    counts = alignment.solution.step_counts.items()
    return "Points: " + " → ".join(f"{count} ({step})" for step, count in counts)


def _write(alignment: Alignment, request: Request) -> None:
    """Write the raster, then the control points."""
    import geodelreg
    from geodelreg.values.remedies import ROTATES

    overwrite = request.write_options.overwrite
    warnings: list[str] = []
    if request.in_place:
        warnings = geodelreg.write_in_place(alignment)
    elif request.output is not None:
        warnings = geodelreg.write(alignment, request.output, request.write_options)
    # of no meaning where OUT is resampled, or has control points
    silent = {ROTATES} if carries_all(request.write_options) else set()
    warn(text for text in (*alignment.warnings, *warnings) if text not in silent)
    if request.displacement is not None:
        geodelreg.write_displacement(alignment, request.displacement, overwrite)
    for path in request.gcps:
        geodelreg.export_gcps(alignment, path, request.gcp_format, overwrite, points=request.points)


def _draw(alignment: Alignment, request: Request) -> None:
    """The figure, of the inputs as they are."""
    if request.figure is not None:
        from geodelreg.report.figures import draw_figure

        overwrite = request.write_options.overwrite
        draw_figure(alignment, request.figure_kind, request.figure, overwrite)


def _reports(alignment: Alignment, request: Request) -> list[tuple[Path, str]]:
    """Where reports go, and their texts."""
    from geodelreg.geotiff.targets import STDOUT
    from geodelreg.report.output import report_text

    paths = [*request.report, *([STDOUT] if request.json else [])]
    return [(path, report_text(alignment, path)) for path in paths]


def _write_texts(texts: Sequence[tuple[Path, str]], request: Request) -> None:
    from geodelreg.geotiff.atomic import write_text_atomically

    for path, text in texts:
        write_text_atomically(path, text, request.write_options.overwrite)
