"""Tie points as a layer: from the files that geodelreg writes.  Nothing here imports QGIS."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TiePoint:
    """One tie point that the correction rests on, in the CRS of MS.

    Attributes
    ----------
    x, y : float
        Where PAN shows it.
    was_x, was_y : float
        Where MS shows it by its original header.
    residual_x, residual_y : float
        From where MS shows it by the corrected header to (x, y), in map units; 0 when no header
        holds the correction.
    residual_px : float
        Length of that in MS pixels.
    """

    x: float
    y: float
    was_x: float
    was_y: float
    residual_x: float
    residual_y: float
    residual_px: float


def read_tie_points(points: Path, report: Path) -> Iterator[TiePoint]:
    """Tie points of an alignment.

    Parameters
    ----------
    points : Path
        What ``--gcps FILE.points`` has written: positions, and residuals in MS pixels, the model's
        minus the measured one, columns and upward rows.
    report : Path
        What ``--report`` has written: the corrected geotransform.
    """
    correction = json.loads(report.read_text(encoding="utf-8"))["correction"]
    _, a, b, _, d, e = correction["corrected_geotransform"] or [0.0] * 6
    with points.open(encoding="utf-8", newline="") as file:
        file.readline()  # its CRS, that of MS
        for row in csv.DictReader(file):
            column, line = float(row["dX"]), -float(row["dY"])
            yield TiePoint(
                x=float(row["mapX"]),
                y=float(row["mapY"]),
                was_x=float(row["sourceX"]),
                was_y=float(row["sourceY"]),
                residual_x=a * column + b * line,
                residual_y=d * column + e * line,
                residual_px=float(row["residual"]),
            )
