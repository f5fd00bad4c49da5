"""What runs leave in files, read back and continued."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from affine import Affine

log = logging.getLogger(__name__)
Row = dict[str, Any]


def resume(path: Path) -> list[Row]:
    """Rows of an earlier run, from a file of JSON lines that can then be appended to.

    A line that was cut short by a kill is taken out of the file.
    """
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            log.warning("%s: a line was cut short and is run again", path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    return rows


def keep(rows: list[Row], row: Row, path: Path) -> None:
    """Add a row to those that `resume` gave and to their file, and print it."""
    rows.append(row)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")
    print(row, flush=True)


def save(path: Path, rows: Iterable[Any]) -> None:
    """Write rows, dataclasses, as one JSON list."""
    path.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")


def read_transform(out: Path) -> Affine:
    """Corrected geotransform of MS that a tool left."""
    if out.suffix == ".json":
        return Affine(*json.loads(out.read_text())["transform"])
    import rasterio

    with rasterio.open(out) as raster:
        return Affine(*tuple(raster.transform)[:6])
