"""CSV of ``gdal raster edit --gcp @FILE`` (GDAL ≥ 3.12), fields found by name.

What more is known of the points stands in fields after GDAL's, which it does not look at.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from geodelreg.errors import GcpFormatError
from geodelreg.product.gcps.context import Decoded, GcpContext, exact, numbers
from geodelreg.product.gcps.facts import FIT, fields_of, form_of, read_facts
from geodelreg.values.points import Gcp

_FIELDS = ("id", "info", "column", "line", "x", "y", "z")
_REQUIRED = ("column", "line", "x", "y")


def encode(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of a CSV file with a header line."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    known = list(map(fields_of, gcps))
    more = list(dict.fromkeys(name for fields in known for name in fields))
    writer.writerow((*_FIELDS, *more))
    for gcp, fields in zip(gcps, known, strict=True):
        values = (gcp.column, gcp.row, gcp.x, gcp.y, gcp.z)
        facts = (fields.get(name) for name in more)
        texts = (v if isinstance(v, str) else "" if v is None else repr(v) for v in facts)
        writer.writerow((gcp.id, gcp.info, *map(exact, values), *texts))
    return buffer.getvalue()


def decode(text: str, context: GcpContext | None) -> Decoded:
    """GCPs of a CSV file; the format has no room for a CRS.

    Raises
    ------
    GcpFormatError
        If a required field is missing or a value is no number.
    """
    try:
        return _decoded(csv.DictReader(io.StringIO(text, newline="")))
    except csv.Error as error:
        raise GcpFormatError(f"it is no CSV text ({error})") from error


def _decoded(reader: csv.DictReader[str]) -> Decoded:
    names = {name.strip().lower(): name for name in reader.fieldnames or ()}
    missing = [name for name in _REQUIRED if name not in names]
    if missing:
        raise GcpFormatError(
            f"the header line lacks {', '.join(missing)}", f"Its fields are {', '.join(_FIELDS)}."
        )
    gcps = []
    for index, record in enumerate(reader, start=1):
        row = {name: record[original] or "" for name, original in names.items()}
        column, line, x, y = numbers([row[name] for name in _REQUIRED], reader.line_num)
        z = numbers([row["z"]], reader.line_num)[0] if row.get("z") else 0.0
        name, info = row.get("id") or str(index), row.get("info", "")
        where = f"line {reader.line_num}"
        facts, enabled = read_facts(row, where)
        form = form_of(row.get(FIT), where)
        gcps.append(Gcp(name, column, line, x, y, z, info, enabled, facts, form))
    return tuple(gcps), None
