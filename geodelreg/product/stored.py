"""A correction as the report of an alignment keeps it, to be applied to other files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine

from geodelreg.errors import CorrectionFileError, CorrectionMisfitError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geo.grid import outline
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.maps.header import header_map
from geodelreg.geo.maps.parsing import map_of_json
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import Correction
from geodelreg.version import __version__

_VERSION = "1."
"""Of report schemas that are understood."""
_MOST_BYTES = 50_000_000
_AFFINE_ENOUGH_PX = 1e-3
"""Between a header and the same correction in another CRS."""
_EDGE_PLACES = 16
_LATTICE = 5
_LEAST_SHARE = 0.5
"""Of a file, or of the raster that was aligned, that both must cover."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredCorrection:
    """What a report says of a correction.

    Attributes
    ----------
    path : Path
        Of the report.
    source, reference : Grid
        Of the MS raster with its original header, and of PAN.
    model : str
    map : PixelMap
        MS pixels to MS header pixels.
    tags : dict of str to str
        Provenance, ``GEODELREG_*``.
    """

    path: Path
    source: Grid
    reference: Grid
    model: str
    map: PixelMap
    tags: Mapping[str, str]

    def ground(self, xy: FloatArray, crs_wkt: str) -> FloatArray:
        """(..., 2) map coordinates, in any CRS, of a file with the same error, corrected."""
        in_source = map_points(xy, crs_wkt, self.source.crs_wkt)
        moved = self.map.forward(apply_affine(~self.source.transform, in_source))
        there = apply_affine(self.source.transform, moved)
        return map_points(there, self.source.crs_wkt, crs_wkt)

    def of_raster(self, grid: Grid) -> tuple[Correction, PixelMap | None]:
        """Of a raster that shares the header error: its header, and its map where that holds none.

        Parameters
        ----------
        grid : Grid
            With its own header, in any CRS.
        """
        there = header_map(grid, self.source)
        placement = there.then(self.map).then(Inverse(there))
        affine = self.map.as_affine()
        if affine is not None and there.as_affine() is not None:
            shared = self.source.transform @ affine @ ~self.source.transform
            corrected, held = shared @ grid.transform, True
        else:
            corrected, held = _header(grid, placement)
            held = held and affine is not None
        correction = Correction(self.model, grid.crs_wkt, grid.transform, corrected)
        return correction, None if held else placement

    def check_fits(self, name: str, grid: Grid) -> None:
        """Refuse a raster of another place.

        Raises
        ------
        CorrectionMisfitError
        """
        from shapely import Polygon, box

        edge = header_map(grid, self.source).forward(outline(grid, _EDGE_PLACES))
        height, width = self.source.shape
        frame, seen = box(0, 0, width, height), Polygon(edge[np.isfinite(edge).all(axis=1)])
        seen = seen.buffer(0)
        common = seen.intersection(frame).area / max(min(seen.area, frame.area), 1e-9)
        self.check_share(name, float(common))

    def check_share(self, name: str, share: float) -> None:
        """Refuse a file of which too little lies in the raster that was aligned.

        Raises
        ------
        CorrectionMisfitError
        """
        if not share >= _LEAST_SHARE:
            raise CorrectionMisfitError(
                f"{name} does not lie where the correction {self.path} was found: they share "
                f"{max(share, 0.0):.0%} of the smaller footprint",
                "Apply the correction of this scene, or add --force.",
            )

    def inside(self, xy: FloatArray, crs_wkt: str) -> float:
        """Share of (N, 2) map coordinates that lie in the raster that was aligned."""
        in_source = map_points(xy, crs_wkt, self.source.crs_wkt)
        at = apply_affine(~self.source.transform, in_source)
        return float(((at >= 0) & (at <= self.source.shape[::-1])).all(axis=1).mean())


def _header(grid: Grid, placement: PixelMap) -> tuple[Affine, bool]:
    """Best geotransform for a map of pixels, and whether it is as good."""
    height, width = grid.shape
    axes = np.linspace(0, width, _LATTICE), np.linspace(0, height, _LATTICE)
    at = np.stack([v.ravel() for v in np.meshgrid(*axes)], axis=1)
    there = placement.forward(at)
    columns = np.column_stack([at, np.ones(len(at))])
    fit = np.linalg.lstsq(columns, there, rcond=None)[0]
    corrected: Affine = grid.transform @ AffineMap.of(np.asarray(fit.T, dtype=np.float64)).affine
    return corrected, bool(np.abs(columns @ fit - there).max() < _AFFINE_ENOUGH_PX)


def read_correction(path: Path) -> StoredCorrection:
    """Read the report of an alignment.

    Raises
    ------
    CorrectionFileError
        It is none, of another version, broken, or of an alignment that was refused.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError("it is larger than any report")
        said = json.loads(path.read_text(encoding="utf-8"))
        version = str(said["schema_version"])
        if not version.startswith(_VERSION):
            raise CorrectionFileError(
                f"{path} is a report of schema {version}, which this version does not read",
                f"Align again with this version ({__version__}), or apply it with the one that "
                "wrote it.",
            )
        if not said["verdict"]["accepted"]:
            raise CorrectionFileError(
                f"{path} is the report of an alignment that was refused: it corrects nothing",
                "Align again, see why it was refused in verdict.reasons.",
            )
        return _stored(path, said)
    except FileNotFoundError as error:
        raise CorrectionFileError(f"{path} does not exist", "Check the path.") from error
    except (OSError, ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CorrectionFileError(
            f"{path} is not the report of an alignment ({reason})",
            "Give what geodelreg align --report has written.",
        ) from error


def _stored(path: Path, said: Mapping[str, Any]) -> StoredCorrection:
    source, reference = (_grid(said["inputs"][role]) for role in ("source", "reference"))
    correction = said["correction"]
    if correction.get("pixel_map") is not None:
        placement: PixelMap = map_of_json(correction["pixel_map"])
    else:
        corrected = Affine.from_gdal(*map(float, correction["corrected_geotransform"]))
        placement = AffineMap(~source.transform @ corrected)
    centre = np.array([source.shape[::-1]]) / 2.0
    if not np.isfinite(placement.forward(centre)).all():
        raise ValueError("its numbers are not finite")
    tags = {
        "GEODELREG_APPLIED": path.name,
        "GEODELREG_MODEL": str(correction["model"]),
        "GEODELREG_VERSION": __version__,
    }
    return StoredCorrection(path, source, reference, str(correction["model"]), placement, tags)


def _grid(said: Mapping[str, Any]) -> Grid:
    transform = Affine.from_gdal(*map(float, said["geotransform"]))
    if transform.is_degenerate:
        raise ValueError("its geotransform squeezes the raster to a line")
    return Grid(transform, (int(said["height"]), int(said["width"])), str(said["crs_wkt"]))
