"""The page of a batch: a table to sort and filter, a map of footprints, links to the pairs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

from geodelreg.report.html import render

PAGES = "pairs"
"""Folder of the pairs' pages, beside the index."""
MOST_ROWS = 5000
"""More would make a page that no browser likes to sort; the worst come first."""

_MAP_WIDTH = 1000.0
_MAP_HEIGHTS = (240.0, 620.0)
_MARGIN = 0.06
_LEAST_DEG = 0.02
_LINES = 5.0
_FIGURES = (
    ("offset_px", "Off by", "How far MS lay off PAN at its centre, PAN pixels"),
    ("misalignment_px", "Misaligned by", "Largest misalignment, PAN pixels"),
    ("uncertainty_px", "Uncertainty", "Of the correction, 95 % at the worst corner, PAN pixels"),
    ("residual_rms_px", "Residual", "RMS of the ground's bend that is left, PAN pixels"),
    ("check_rmse_px", "Patch scatter", "RMS, the noise of single matches, PAN pixels"),
    ("tie_points", "Tie points", "Tie points kept"),
)
_WORST_FIRST = ("failed", "misaligned", "refused", "cannot_tell", "aligned", "already_aligned")


@dataclass(frozen=True, slots=True)
class Row:
    """One pair, as the index shows it.

    Attributes
    ----------
    number : int
        Of the pair in the manifest, from 1.
    ms, pan : str
        File names.
    outcome : str
        One of `geodelreg.batch.job.OUTCOMES`.
    reason : str
        Why it was refused or failed.
    figures : mapping
        Numbers by the names of `geodelreg.batch.job.FIGURES`; None = not known.
    footprint : mapping or None
        GeoJSON geometry in degrees.
    page : str
        Address of the pair's page; empty when there is none.
    """

    number: int
    ms: str
    pan: str
    outcome: str
    reason: str
    figures: Mapping[str, Any]
    footprint: Mapping[str, Any] | None
    page: str


def page_name(number: int) -> str:
    """File name of a pair's page."""
    return f"{number:06}.html"


def index(rows: Iterable[Row]) -> str:
    """The page as text.

    Parameters
    ----------
    rows : iterable of Row
    """
    every = sorted(rows, key=lambda row: (_WORST_FIRST.index(row.outcome), row.number))
    shown = sorted(every[:MOST_ROWS], key=lambda row: row.number)
    counts = Counter(row.outcome for row in every)
    known = [f for f in _FIGURES if any(row.figures.get(f[0]) is not None for row in shown)]
    return render(
        "index.html",
        ["base.css", "index.css"],
        ["index.js"],
        total=len(every),
        shown=len(shown),
        outcomes=[(name, _words(name), counts[name]) for name in _WORST_FIRST if counts[name]],
        figures=known,
        rows=[
            (row, _words(row.outcome), [_cell(row.figures.get(name)) for name, _, _ in known])
            for row in shown
        ],
        map=_map(shown),
    )


def _words(outcome: str) -> str:
    return outcome.replace("_", " ")


def _cell(value: Any) -> tuple[str, str]:
    """Text of a number, and what to sort by."""
    if value is None:
        return "", ""
    text = f"{value}" if isinstance(value, int) else f"{value:.3g}"
    return text, f"{value:.9g}"


def _map(rows: list[Row]) -> dict[str, Any] | None:
    """Footprints in a frame of degrees, east and north as long as each other in its middle."""
    placed = [(row, list(_rings(row.footprint))) for row in rows if row.footprint]
    corners = [point for _, rings in placed for point in chain.from_iterable(rings)]
    if not corners:
        return None
    west, east = (pick(x for x, _ in corners) for pick in (min, max))
    south, north = (pick(y for _, y in corners) for pick in (min, max))
    grow = max(_MARGIN * max(east - west, north - south), _LEAST_DEG)
    west, east, south, north = west - grow, east + grow, south - grow, north + grow
    squeeze = max(math.cos(math.radians((south + north) / 2)), 0.1)
    low, high = _MAP_HEIGHTS
    height = min(max(_MAP_WIDTH * (north - south) / ((east - west) * squeeze), low), high)
    scale = min(_MAP_WIDTH / ((east - west) * squeeze), height / (north - south))

    def at(lon: float, lat: float) -> tuple[float, float]:
        x = _MAP_WIDTH / 2 + (lon - (west + east) / 2) * squeeze * scale
        return round(x, 1), round(height / 2 - (lat - (south + north) / 2) * scale, 1)

    def path(rings: list[list[tuple[float, float]]]) -> str:
        return "".join(
            "M" + "L".join("{:g} {:g}".format(*at(*point)) for point in ring) + "z"
            for ring in rings
        )

    return {
        "width": _MAP_WIDTH,
        "height": round(height, 1),
        "shapes": [(row.number, row.outcome, path(rings)) for row, rings in placed],
        "meridians": [(at(lon, 0)[0], _degrees(lon, "E", "W")) for lon in _ticks(west, east)],
        "parallels": [(at(0, lat)[1], _degrees(lat, "N", "S")) for lat in _ticks(south, north)],
        "missing": len(rows) - len(placed),
    }


def _rings(geometry: Mapping[str, Any] | None) -> Iterator[list[tuple[float, float]]]:
    """Outer rings of a polygon, or of several."""
    assert geometry is not None
    many = geometry["type"] == "MultiPolygon"
    for polygon in geometry["coordinates"] if many else [geometry["coordinates"]]:
        yield [(float(point[0]), float(point[1])) for point in polygon[0]]


def _ticks(low: float, high: float) -> list[float]:
    """Round degrees between two."""
    rough = (high - low) / _LINES
    power = 10.0 ** math.floor(math.log10(rough))
    step = min(s * power for s in (1.0, 2.0, 5.0, 10.0) if s * power >= rough)
    first = math.ceil(low / step)
    return [n * step for n in range(first, math.floor(high / step) + 1)]


def _degrees(value: float, positive: str, negative: str) -> str:
    return f"{abs(round(value, 6)):g}° {positive if value >= 0 else negative}"
