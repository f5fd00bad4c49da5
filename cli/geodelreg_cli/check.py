"""``geodelreg check``: a verdict for scripts, nothing written."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from geodelreg.errors import AlignmentRefusedError
from geodelreg.flags import as_typed
from geodelreg.options import AlignOptions
from geodelreg_cli.console import log_steps, progress_bar, warn
from geodelreg_cli.options import (
    build,
    command,
    flag,
    knob_options,
    ms_and_pan,
    option,
    run_options,
    start_run,
    under,
)

if TYPE_CHECKING:
    from geodelreg.product.check import Check

MISALIGNED = 4
JUDGED = {"tolerance_px": 0.0, "max_residual_px": 0.5, "on_local": "warn", "north_up": False}
"""By --tolerance, in the place of what `align` has."""

EPILOG = """\
Examples:

  Is MS within half a PAN pixel of PAN?
    geodelreg check ms.tif pan.tif

  Stricter, and every band by itself:
    geodelreg check ms.tif pan.tif --tolerance 0.2 --per-band

  In a script:
    geodelreg check ms.tif pan.tif -q || geodelreg align ms.tif pan.tif -o aligned.tif

  One number:
    geodelreg check ms.tif pan.tif --json | jq .check.misalignment.distance_px

Exit codes: 0 aligned, 1 failed, 2 wrong usage, 3 cannot tell (the reason on stderr), 4 misaligned.
"""


OPTIONS = [
    *under(
        "Verdict",
        option(
            "limit_px",
            "--tolerance",
            type=click.FloatRange(0.0, 1e6),
            default="0.5",
            show_default=True,
            metavar="PX",
            help="Largest misalignment, anywhere in the overlap, that counts as aligned, in PAN "
            "pixels. Beyond it by more than 3 standard errors is misaligned; when 3 standard "
            "errors exceed PX, a raster that is not misaligned cannot be told to be aligned.",
        ),
        flag(
            "--per-band",
            help="Also find each MS band, as align --per-band does; one misaligned band is "
            "misaligned (exit 4).",
        ),
        flag(
            "--json", help="Print the report on stdout in place of the text; its block is .check."
        ),
    ),
    *under(
        "How to measure",
        *knob_options(AlignOptions, [*JUDGED, "per_band", "band_model", "threads", "allow"]),
    ),
    *run_options(),
]


@command(EPILOG, OPTIONS)
@click.argument("rasters", metavar="MS... PAN", nargs=-1, required=True)
def check(rasters: tuple[str, ...], **given: Any) -> int:
    """Tell whether MS lies where PAN says, and write nothing.

    MS is a multispectral raster, or several files with one band each; PAN, the last argument, is
    the raster to compare with. The misalignment is the largest displacement in the overlap of the
    two, with its standard error.
    """
    start_run(given)
    sources, reference = ms_and_pan(rasters)
    options = build(AlignOptions, given | JUDGED)
    import geodelreg

    with progress_bar(given["quiet"]) as bar:
        found = geodelreg.check(
            sources, reference, options, limit_px=given["limit_px"], progress=log_steps(bar)
        )
    _show(found, given)
    return _exit_code(found)


def _show(found: Check, given: dict[str, Any]) -> None:
    """Warnings on stderr, then the report or the text on stdout."""
    from geodelreg.product.check import check_json, check_text
    from geodelreg.values.remedies import ROTATES

    warn(text for text in found.alignment.warnings if text != ROTATES)  # nothing is written
    if given["json"]:
        click.echo(check_json(found))
    elif not given["quiet"]:
        click.echo(as_typed(check_text(found)))


def _exit_code(found: Check) -> int:
    """0 or 4.

    Raises
    ------
    AlignmentRefusedError
        When nothing can be told.
    """
    from geodelreg.values.result import CheckOutcome

    if found.outcome is CheckOutcome.CANNOT_TELL:
        raise AlignmentRefusedError(
            f"cannot tell whether {found.source_name} is aligned: {found.reason}",
            found.remedy.replace("`limit_px`", "--tolerance"),
            found.alignment,
        )
    return MISALIGNED if found.outcome is CheckOutcome.MISALIGNED else 0
