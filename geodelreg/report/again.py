"""A result in a JSON report, joined with its rasters again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from geodelreg.errors import ReportError
from geodelreg.product.provenance import fingerprint
from geodelreg.product.reading import read_report
from geodelreg.raster.reader import open_raster
from geodelreg.values.result import Alignment, Input


def read_again(
    result: Path, sources: Sequence[str], reference: str, allow: str | None = None
) -> Alignment:
    """Read a report, and see that it tells of these rasters.

    Parameters
    ----------
    result : Path
        JSON of ``--report`` or ``--json``.
    sources : sequence of str
        MS file, or one file per band in the order of the report; wherever they lie now.
    reference : str
        PAN.
    allow : str, optional
        What may be opened, `AlignOptions.allow`; as the report says when not given.

    Returns
    -------
    Alignment

    Raises
    ------
    ReportError
        The file is no report, or tells of other rasters.
    GeodelregError
        Its other kinds, when a raster cannot be opened.
    """
    alignment = read_report(result)
    options = replace(alignment.options, allow=allow or alignment.options.allow)
    return replace(
        alignment,
        source=_same(result, "MS", alignment.source, tuple(sources), options.allow),
        reference=_same(result, "PAN", alignment.reference, (reference,), options.allow),
        options=options,
    )


def _same(result: Path, role: str, then: Input, now: tuple[str, ...], allow: str) -> Input:
    """The input where it lies now."""
    if len(now) != len(then.paths):
        raise ReportError(
            f"{result} tells of {len(then.paths)} files of {role}, {len(now)} are named",
            "Name the same files as then, in the same order.",
        )
    with open_raster(now, allow=allow) as reader:
        grid = reader.grid
    for path, digest in zip(now, then.fingerprints, strict=True):
        if digest and fingerprint(path) != digest:
            raise ReportError(
                f"{result} tells of another raster than {path}, or {path} has changed since",
                f"Name the {role} that it was made of, or align again.",
            )
    if grid != then.grid:
        raise ReportError(
            f"{result} tells of another raster than {now[0]}: its grid is another",
            f"Name the {role} that it was made of, or align again.",
        )
    return replace(then, paths=now)
