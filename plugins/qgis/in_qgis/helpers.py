"""Small things that all trials use."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingException,
    QgsProcessingFeedback,
)

PAIRS = (1, 2, 3)
"""Numbers of the pairs that `check.py` has made."""


class Listening(QgsProcessingFeedback):
    """Feedback that keeps what it is told."""

    def __init__(self) -> None:
        super().__init__(False)
        self.warnings: list[str] = []
        self.steps: list[float] = []
        self.progressChanged.connect(self.steps.append)

    def pushWarning(self, warning: str) -> None:
        """Keep a warning."""
        self.warnings.append(warning)


def files(folder: Path) -> dict[str, bytes]:
    """Every file below a folder but GDAL's statistics, with its content."""
    return {
        str(path): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.endswith(".aux.xml")
    }


def say(what: str) -> None:
    """Report one thing that works."""
    print(f"ok: {what}", flush=True)


def refusal(run: Callable[[], Any]) -> str:
    """Message of a run that must fail."""
    try:
        run()
    except QgsProcessingException as error:
        return str(error)
    raise AssertionError("it was not refused")


def inputs(folder: Path, number: int) -> dict[str, str]:
    """Parameters for one pair."""
    return {"MS": str(folder / f"ms {number}.tif"), "PAN": str(folder / f"pan {number}.tif")}


def square(folder: Path) -> Path:
    """A vector file with a square inside the sample."""
    ring = [[x, y] for x, y in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))]
    ring = [[-75.68 + 0.01 * x, 37.69 + 0.01 * y] for x, y in ring]
    geometry = {"type": "Polygon", "coordinates": [ring]}
    feature = {"type": "Feature", "properties": {"kind": "cloud"}, "geometry": geometry}
    path = folder / "Wölkchen.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path
