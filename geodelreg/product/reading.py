"""A report as JSON, read back into the alignment that it tells of."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine

from geodelreg.errors import GeodelregError, ReportError
from geodelreg.geo.affine import affine_from_matrix
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.lattice import OnLattice
from geodelreg.geo.maps.projective import ProjectiveMap
from geodelreg.geo.maps.tin import TinMap
from geodelreg.masking import MaskUse
from geodelreg.options import AlignOptions
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import NO_TIE_POINTS, Status, TiePoints
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import (
    Accuracy,
    Alignment,
    BandMap,
    Input,
    Outcome,
    Reason,
    Solution,
    Verdict,
)

_READ = ("1.", "2.")
"""Versions of the schema: 1 has fields more, which mean nothing to us, and lacks some."""
_NAME_ONE = "Name the JSON file of `write_report`."
_AGAIN = "Make it again: geodelreg align MS PAN --dry-run --report FILE.json."
MOST_BYTES = 256_000_000
"""Of a report: one of 100 000 tie points has 60 MB."""


def read_report(path: Path) -> Alignment:
    """Read what ``--report FILE.json`` or ``--json`` has written.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Alignment
        As it was, but for the wording of the CRS operation; without tie points where the report
        does not list them.

    Raises
    ------
    ReportError
        The file cannot be read, or is no report of a version that is known.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ReportError(f"{path} is too large for a report", _NAME_ONE)
        report = json.loads(path.read_bytes())
    except OSError as error:
        raise ReportError(f"{path} cannot be read ({error.strerror})", _NAME_ONE) from error
    except (ValueError, RecursionError) as error:
        raise ReportError(f"{path} is no JSON ({error})", _NAME_ONE) from error
    version = report.get("schema_version") if isinstance(report, dict) else None
    if not str(version).startswith(_READ):
        raise ReportError(
            f"{path} is no report of version 1 or 2" + (f" but of {version}" if version else ""),
            _AGAIN,
        )
    try:
        return _alignment(report)
    except GeodelregError as error:
        raise ReportError(f"{path}: {error.cause}", error.remedy) from error
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise ReportError(
            f"{path} is a report in which something is missing or wrong ({error!r})", _AGAIN
        ) from error


def _alignment(report: Mapping[str, Any]) -> Alignment:
    source = _input(report["inputs"]["source"])
    verdict, warnings = report["verdict"], tuple(map(str, report["warnings"]))
    points = report["inputs"].get("points")
    solution = Solution(
        model=str(report["found"]["model"]),
        map=_map(report["found"], source.grid.shape),
        tie_points=_tie_points(report["tie_points"].get("points")),
        accuracy=_accuracy(report["accuracy"]),
        verdict=Verdict(Outcome(verdict["outcome"]), tuple(map(_reason, verdict["reasons"]))),
        step_counts={str(step["step"]): int(step["points"]) for step in report["step_counts"]},
        band_weights={str(k): float(v) for k, v in report["band_weights"].items()},
        warnings=warnings,
        bands=tuple(_band(band, source.grid) for band in report.get("bands", ())),
    )
    return Alignment(
        source=source,
        reference=_input(report["inputs"]["reference"]),
        solution=solution,
        options=_options(report["options"]),
        crs_operation=str(report["crs_operation"]),
        warnings=warnings,
        masks=tuple(map(_mask, report["masks"])),
        versions={str(k): str(v) for k, v in report["versions"].items()},
        timings_s={str(k): float(v) for k, v in report["timings_s"].items()},
        points=None if points is None else _input(points),
    )


def _input(given: Mapping[str, Any]) -> Input:
    files = given["files"]
    transform = Affine.from_gdal(*map(float, given["geotransform"]))
    shape = (int(given["height"]), int(given["width"]))
    return Input(
        tuple(str(file["path"]) for file in files),
        Grid(transform, shape, str(given["crs_wkt"])),
        tuple(str(file["fingerprint"] or "") for file in files),
    )


def _map(found: Mapping[str, Any], shape: tuple[int, int]) -> PixelMap:
    values = _floats(found["sigma_source_px"])
    return _pixel_map(found["pixel_map"], OnLattice(values, shape) if values.any() else None)


def _pixel_map(said: Mapping[str, Any], sigma: OnLattice | None = None) -> PixelMap:
    kind = said["kind"]
    if kind == "field":
        return FieldMap.from_json(said)
    if kind == "tin":
        return TinMap.from_json(said)
    if kind == "composed":
        first, second = map(_pixel_map, said["maps"])
        return first.then(second)
    matrix = np.array(said["matrix"], dtype=np.float64)
    if kind == "affine":
        return AffineMap(affine_from_matrix(matrix), sigma)
    if kind == "projective":
        return ProjectiveMap(matrix, sigma)
    raise ValueError(f"a map of the kind {kind!r}")


def _band(given: Mapping[str, Any], source: Grid) -> BandMap:
    if given["pixel_map"] is None:
        corrected = Affine.from_gdal(*map(float, given["corrected_geotransform"]))
        placed: PixelMap = AffineMap(~source.transform @ corrected)
    else:
        placed = _pixel_map(given["pixel_map"])
    return BandMap(int(given["number"]), str(given["name"]), placed, float(given["sigma_px"]))


def _tie_points(points: list[Mapping[str, Any]] | None) -> TiePoints:
    if not points:
        return NO_TIE_POINTS
    columns = {
        name: _floats([point[name] for point in points])
        for name in ("source_px", "reference_px", "covariance_px2", "score", "residual_px")
    }
    codes = [Status[str(point["status"]).upper()] for point in points]
    return TiePoints(**columns, status=np.array(codes, dtype=np.uint8))


def _floats(values: Any) -> FloatArray:
    """As an array; null is NaN."""
    return np.array(values, dtype=np.float64)


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same; null is NaN."""
    return {key: float("nan") if value is None else value for key, value in values.items()}


def _accuracy(given: Mapping[str, Any]) -> Accuracy:
    known = _known(_fields_of(Accuracy, given))
    if "residual_interval_px" in known:
        low, high = _floats(known["residual_interval_px"]).tolist()
        known["residual_interval_px"] = low, high
    return Accuracy(**known)


def _fields_of(kind: type, given: Mapping[str, Any]) -> Mapping[str, Any]:
    """What this version knows of; what an older one did not write has its default."""
    names = {field.name for field in fields(kind)}
    return {name: value for name, value in given.items() if name in names}


def _mask(given: Mapping[str, Any]) -> MaskUse:
    return MaskUse(**_known(given) | {"hide": tuple((low, high) for low, high in given["hide"])})


def _reason(given: Mapping[str, Any]) -> Reason:
    return Reason(**_known(given))


def _options(given: Mapping[str, Any]) -> AlignOptions:
    known = _fields_of(AlignOptions, given)
    lists = {field.name for field in fields(AlignOptions) if str(field.type).startswith("tuple")}
    values: dict[str, Any] = {k: tuple(v) if k in lists else v for k, v in known.items()}
    return AlignOptions(**values)
