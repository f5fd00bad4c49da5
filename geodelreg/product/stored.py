"""A correction as the report of an alignment keeps it, to be applied to other files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from affine import Affine

from geodelreg.errors import CorrectionMisfitError, ReportError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geo.grid import outline
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.maps.header import header_map
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.product.provenance import FINGERPRINTS, fingerprint, provenance_tags, written_tags
from geodelreg.product.reading import read_report
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import Correction, Outcome
from geodelreg.version import __version__

_AFFINE_ENOUGH_PX = 1e-3
"""Between a header and the same correction in another CRS."""
_EDGE_PLACES = 16
_LATTICE = 5
_LEAST_SHARE = 0.5
"""Of a file, or of the raster that was aligned, that both must cover."""


_Placed = tuple[Correction, PixelMap | None]
"""Header, and map where that holds none."""


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
    bands : dict of int to PixelMap
        Of MS bands, from 1, that lie elsewhere than `map` says.
    """

    path: Path
    source: Grid
    reference: Grid
    model: str
    map: PixelMap
    tags: Mapping[str, str]
    bands: Mapping[int, PixelMap] = field(default_factory=dict)

    def ground(self, xy: FloatArray, crs_wkt: str) -> FloatArray:
        """(..., 2) map coordinates, in any CRS, of a file with the same error, corrected."""
        in_source = map_points(xy, crs_wkt, self.source.crs_wkt)
        moved = self.map.forward(apply_affine(~self.source.transform, in_source))
        there = apply_affine(self.source.transform, moved)
        return map_points(there, self.source.crs_wkt, crs_wkt)

    def of_bands(self, name: str, grid: Grid, count: int) -> dict[int, _Placed]:
        """`placed` of each band of a raster that lies elsewhere than the others.

        Parameters
        ----------
        name : str
            Of the raster, for messages.
        grid : Grid
        count : int
            Of its bands.

        Raises
        ------
        CorrectionMisfitError
            It has fewer bands than the correction tells of.
        """
        if count < max(self.bands, default=0):
            raise CorrectionMisfitError(
                f"{name} has {count} bands, and the correction {self.path} tells where each of "
                f"{max(self.bands)} bands lies",
                "Apply it to rasters with the bands of MS; for others align without `per_band`.",
            )
        return {number: self.placed(placed, grid) for number, placed in self.bands.items()}

    def placed(self, moved: PixelMap, grid: Grid) -> _Placed:
        """Of a raster that shares the header error: its header, and its map where that holds none.

        Parameters
        ----------
        moved : PixelMap
            `map`, or that of a band.
        grid : Grid
            With its own header, in any CRS.
        """
        there = header_map(grid, self.source)
        placement = there.then(moved).then(Inverse(there))
        affine = moved.as_affine()
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

    def check_uncorrected(self, file: Path) -> None:
        """Refuse a raster that was corrected by an alignment of the same pair, and PAN itself.

        Raises
        ------
        CorrectionMisfitError
        """
        if fingerprint(file) == self.tags.get("GEODELREG_PAN_FINGERPRINT"):
            raise CorrectionMisfitError(
                f"{file} is the PAN that the correction of MS was found by: it lies right",
                "Apply it to files that lie as MS did, or add `force=True`.",
            )
        found = {name: text for name, text in written_tags(file).items() if name in FINGERPRINTS}
        if found and all(self.tags.get(name) == text for name, text in found.items()):
            raise CorrectionMisfitError(
                f"{file} was corrected before, by an alignment of the same rasters: once more "
                "would move it off again",
                "Apply it to the file as it was (an edit in place can be taken back), or add "
                "`force=True`.",
            )

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
                "Apply the correction of this scene, or add `force=True`.",
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
    ReportError
        It is none, of another version, broken, or of an alignment that was refused.
    """
    alignment = read_report(path)
    if not alignment.verdict.accepted:
        raise ReportError(
            f"{path} is the report of an alignment that was refused: it corrects nothing",
            "Align again, see why it was refused in verdict.reasons.",
        )
    source, correction = alignment.source.grid, alignment.correction
    placement = alignment.solution.map
    if alignment.fits_a_header:
        placement = AffineMap(~source.transform @ correction.corrected)
    tags = {
        "GEODELREG_APPLIED": path.name,
        "GEODELREG_MODEL": correction.model,
        "GEODELREG_VERSION": __version__,
    } | {name: text for name, text in provenance_tags(alignment).items() if name in FINGERPRINTS}
    reference = alignment.reference.grid
    aligned = alignment.verdict.outcome is Outcome.ALIGNED
    bands = {band.number: band.map for band in alignment.solution.bands} if aligned else {}
    return StoredCorrection(path, source, reference, correction.model, placement, tags, bands)
