"""Option file of ``gdal_translate --optfile``: one ``-gcp`` per line.

Lines that begin with ``#`` are comments to GDAL; the CRS stands in one, for readers of this file.
The elevation is always written, so that a file name made of digits cannot be taken for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from geodelreg.errors import GcpFormatError
from geodelreg.product.gcps.context import Decoded, GcpContext, exact, numbers, one_line
from geodelreg.types import Gcp

_CRS_PREFIX = "# CRS: "


def encode(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of an option file."""
    lines = [
        "# gdal_translate --optfile THIS IN OUT; pixel line easting northing elevation",
        _CRS_PREFIX + one_line(context.source.crs_wkt),
    ]
    for gcp in gcps:
        values = (gcp.column, gcp.row, gcp.x, gcp.y, gcp.z)
        lines.append("-gcp " + " ".join(map(exact, values)))
    return "\n".join(lines) + "\n"


def decode(text: str, context: GcpContext | None) -> Decoded:
    """GCPs of an option file; other options in it are passed over.

    Raises
    ------
    GcpFormatError
        If a ``-gcp`` is not followed by at least 4 numbers.
    """
    crs_wkt = None
    words: list[tuple[int, str]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith(_CRS_PREFIX):
            crs_wkt = line[len(_CRS_PREFIX) :].strip()
        elif not line.startswith("#"):
            words += [(number, word) for word in line.split()]
    starts = [index for index, (_, word) in enumerate(words) if word == "-gcp"]
    return tuple(_gcp(words, start, str(count)) for count, start in enumerate(starts, 1)), crs_wkt


def _gcp(words: list[tuple[int, str]], start: int, name: str) -> Gcp:
    line = words[start][0]
    fields = [word for _, word in words[start + 1 : start + 6]]
    if len(fields) < 4:
        raise GcpFormatError(f"line {line}: -gcp takes 4 or 5 numbers")
    column, row, x, y = numbers(fields[:4], line)
    z = numbers(fields[4:], line)[0] if len(fields) > 4 and _is_number(fields[4]) else 0.0
    return Gcp(name, column, row, x, y, z)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
