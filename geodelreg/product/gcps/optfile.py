"""Option file of ``gdal_translate --optfile``: ``-a_srs``, then one ``-gcp`` per line.

Without ``-a_srs`` GDAL gives the GCPs no CRS.  The elevation is always written, so that a file name
made of digits cannot be taken for it.  Lines that begin with ``#`` are comments.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from geodelreg.errors import GcpFormatError
from geodelreg.product.gcps.context import (
    Decoded,
    GcpContext,
    crs_name,
    crs_wkt_of,
    exact,
    numbers,
    one_line,
)
from geodelreg.values.points import Gcp


def encode(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of an option file."""
    crs = one_line(crs_name(context.source.crs_wkt)).replace("\\", "\\\\").replace('"', '\\"')
    lines = [
        "# gdal_translate --optfile THIS IN OUT; pixel line easting northing elevation",
        f'-a_srs "{crs}"',
    ]
    for gcp in gcps:
        values = (gcp.column, gcp.row, gcp.x, gcp.y, gcp.z)
        lines.append("-gcp " + " ".join(map(exact, values)))
    return "\n".join(lines) + "\n"


def decode(text: str, context: GcpContext | None) -> Decoded:
    """GCPs of an option file; options other than ``-gcp`` and ``-a_srs`` are passed over.

    Raises
    ------
    GcpFormatError
        If a ``-gcp`` is not followed by at least 4 numbers.
    """
    words: list[tuple[int, str]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#"):
            words += [(number, word) for word in _words(line, number)]
    options = [word for _, word in words]
    crs = options[options.index("-a_srs") + 1 :] if "-a_srs" in options else []
    starts = [index for index, word in enumerate(options) if word == "-gcp"]
    gcps = tuple(_gcp(words, start, str(count)) for count, start in enumerate(starts, start=1))
    return gcps, crs_wkt_of(crs[0]) if crs else None


def _words(line: str, number: int) -> list[str]:
    try:
        return shlex.split(line)
    except ValueError as error:
        raise GcpFormatError(f"line {number}: {error}") from error


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
