"""Reports in files: for machines or to look at, by the extension of the name."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from geodelreg.errors import UsageError
from geodelreg.geotiff.atomic import write_text_atomically
from geodelreg.geotiff.targets import STDOUT
from geodelreg.product.report import report_json
from geodelreg.report.html import check_jinja
from geodelreg.values.result import Alignment

_PAGES = (".html", ".htm")


def is_page(path: Path) -> bool:
    """True of the name of a page to look at; everything else is JSON."""
    return path.suffix.lower() in _PAGES


def check_report(path: Path) -> None:
    """Refuse a report that cannot be made, before there is anything to report.

    Raises
    ------
    MissingExtraError
    """
    if is_page(path):
        check_jinja(path.name)


def report_text(alignment: Alignment, path: Path) -> str:
    """Text of a report: a page for ``.html``, else JSON; in a file with every tie point.

    Raises
    ------
    MissingExtraError
    UsageError
        A page of rasters that are in no file.
    GeodelregError
        Its other kinds, when a page's rasters cannot be read again.
    """
    check_report(path)
    if not is_page(path):
        listed = path != STDOUT and len(alignment.tie_points) > 0
        return report_json(alignment, tie_points=listed) + "\n"
    for raster, name in ((alignment.source, "MS"), (alignment.reference, "PAN")):
        if raster.in_memory:
            raise UsageError(
                f"A page reads the rasters again, and {name} is no file",
                "Write the report as JSON; of the same in files `geodelreg report REPORT.json MS "
                f"PAN -o {path.name}` makes the page.",
            )
    from geodelreg.report.page import page

    return page(alignment)


def write_report(alignment: Alignment, path: str | PathLike[str], overwrite: bool = False) -> None:
    """Write what an alignment found out, refused or not.

    Parameters
    ----------
    alignment : Alignment
        As returned by `align`, or held by `AlignmentRefusedError`.
    path : path
        ``.html`` for a page to look at, which reads the rasters again (needs the report extra);
        else JSON with every tie point.  ``-`` is standard output: JSON without them.
    overwrite : bool

    Raises
    ------
    MissingExtraError, UsageError, OutputExistsError, OutputUnwritableError, FileLockedError
    """
    write_text_atomically(Path(path), report_text(alignment, Path(path)), overwrite)
