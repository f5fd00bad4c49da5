"""The result of an alignment for machines (JSON with a schema) and for people (a few lines)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from geodelreg.errors import shown
from geodelreg.options import WriteOptions
from geodelreg.product.motion import header_motion, metres_per_px
from geodelreg.product.provenance import source_date
from geodelreg.values.points import Status, TiePoints
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import Accuracy, Alignment, BandMap, Outcome
from geodelreg.version import __version__

SCHEMA_VERSION = "2.0"
LATTICE = 17
"""Places along each axis where the standard error of the correction is listed."""
_UNSHOWN = re.compile("[\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069]")
"""What terminals obey and JSON need not escape."""


def report_schema() -> dict[str, Any]:
    """JSON Schema (2020-12) of `report_dict`."""
    text = files("geodelreg.product").joinpath("schema/report.schema.json").read_text("utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def report_json(alignment: Alignment, tie_points: bool = False) -> str:
    """`report_dict` as text: keys sorted, floats exact, unknown values null, no final newline."""
    return json_text(report_dict(alignment, tie_points))


def json_text(report: Mapping[str, Any]) -> str:
    """Text of a report: keys sorted, floats exact, no final newline."""
    text = json.dumps(report, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return escaped(text)


def escaped(text: str) -> str:
    """JSON in which what a terminal would obey is written as escapes."""
    return _UNSHOWN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def report_dict(alignment: Alignment, tie_points: bool = False) -> dict[str, Any]:
    """All that `align` found out, refused or not, as plain JSON values.

    Parameters
    ----------
    alignment : Alignment
    tie_points : bool
        List every tie point, the rejected ones too.

    Returns
    -------
    dict
        Valid under `report_schema`.  Values that are not known (NaN) are None.
    """
    report = {
        "schema_version": SCHEMA_VERSION,
        "tool": {"name": "geodelreg", "version": __version__},
        "created": source_date(),
        "inputs": _inputs(alignment),
        "correction": _correction(alignment),
        "found": _found(alignment),
        "tie_points": _tie_points(alignment.tie_points, tie_points),
        "search": alignment.solution.search,
        "step_counts": [
            {"step": step, "points": count}
            for step, count in alignment.solution.step_counts.items()
        ],
        "accuracy": _accuracy(alignment.accuracy),
        "band_weights": dict(alignment.solution.band_weights),
        "bands": [_band(alignment, band) for band in alignment.solution.bands],
        "masks": [asdict(use) for use in alignment.masks],
        "verdict": {
            "outcome": alignment.verdict.outcome.value,
            "accepted": alignment.verdict.accepted,
            "reasons": [asdict(reason) for reason in alignment.verdict.reasons],
        },
        "warnings": list(alignment.warnings),
        "crs_operation": alignment.crs_operation,
        "options": asdict(alignment.options),
        "timings_s": dict(alignment.timings_s),
        "versions": dict(alignment.versions),
    }
    return dict(plain(report))


def plain(value: Any) -> Any:
    """Value made of JSON types alone; numbers that are not finite become None."""
    if isinstance(value, float):  # first: fields have thousands
        return float(value) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    return value


def _inputs(alignment: Alignment) -> dict[str, Any]:
    inputs = {"source": alignment.source, "reference": alignment.reference}
    if alignment.points is not None:
        inputs["points"] = alignment.points
    return {
        role: {
            "files": [_file(*file) for file in zip(of.paths, of.fingerprints, strict=True)],
            **_grid(of.grid),
        }
        for role, of in inputs.items()
    }


def _file(path: str, digest: str) -> dict[str, Any]:
    local = Path(path)
    size = local.stat().st_size if digest and local.is_file() else None
    return {"path": path, "size_bytes": size, "fingerprint": digest or None}


def _grid(grid: Grid) -> dict[str, Any]:
    return {
        "width": grid.shape[1],
        "height": grid.shape[0],
        "geotransform": grid.transform.to_gdal(),
        "crs_wkt": grid.crs_wkt,
    }


def _correction(alignment: Alignment) -> dict[str, Any]:
    """Geotransforms; a map that is none has its own numbers instead."""
    correction, motion = alignment.correction, header_motion(alignment)
    found: dict[str, Any] = {
        "corrected_geotransform": correction.corrected.to_gdal(),
        "map_transform": correction.map_transform.to_gdal(),
    }
    if not alignment.fits_a_header:
        found = dict.fromkeys(found) | {"pixel_map": alignment.solution.map.to_json()}
    return {
        "model": correction.model,
        "crs_wkt": correction.crs_wkt,
        "original_geotransform": correction.original.to_gdal(),
        **found,
        "at_centre": {
            **asdict(motion),
            "distance_px": motion.distance_px,
            "distance_m": motion.distance_m,
        },
    }


def _accuracy(accuracy: Accuracy) -> dict[str, Any]:
    return asdict(accuracy) | {"uncertainty_px": accuracy.uncertainty_px}


def _band(alignment: Alignment, band: BandMap) -> dict[str, Any]:
    """Where one band lies, and how it would have to move at its centre."""
    found: dict[str, Any] = {"corrected_geotransform": None, "pixel_map": band.map.to_json()}
    affine = band.map.as_affine()
    if affine is not None:
        corrected = alignment.source.grid.transform @ affine
        found = {"corrected_geotransform": corrected.to_gdal(), "pixel_map": None}
    return {
        "number": band.number,
        "name": band.name,
        "shift_px": header_motion(
            replace(alignment, solution=replace(alignment.solution, map=band.map))
        ).shift_px,
        "sigma_px": band.sigma_px,
        **found,
    }


def _found(alignment: Alignment) -> dict[str, Any]:
    """The solution's map, believed or not, and how sure it is over the raster."""
    solution, shape = alignment.solution, alignment.source.grid.shape
    sigma = solution.map.sigma_at(lattice(shape).reshape(-1, 2))
    return {
        "model": solution.model,
        "pixel_map": solution.map.to_json(),
        "sigma_source_px": sigma.reshape(LATTICE, LATTICE),
    }


def lattice(shape: tuple[int, int]) -> FloatArray:
    """(n, n, 2) float64 pixels from corner to corner of a raster of (height, width)."""
    rows, columns = (np.linspace(0.0, size, LATTICE) for size in shape)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def _tie_points(points: TiePoints, listed: bool) -> dict[str, Any]:
    counts = np.bincount(points.status, minlength=len(Status))
    report: dict[str, Any] = {
        "total": len(points),
        "by_status": {status.name.lower(): counts[status] for status in Status},
    }
    if listed:
        names = "source_px", "reference_px", "covariance_px2", "score", "residual_px"
        each = zip(*(getattr(points, name).tolist() for name in names), strict=True)
        report["points"] = [
            {"status": Status(status).name.lower()} | dict(zip(names, values, strict=True))
            for status, values in zip(points.status.tolist(), each, strict=True)
        ]
    return report


def summary_text(alignment: Alignment, written: WriteOptions | None = None) -> str:
    """A few lines for people: what was found, how good it is, what to do next.

    Warnings are not repeated here.

    Parameters
    ----------
    alignment : Alignment
    written : WriteOptions, optional
        How the raster was written, if it was.
    """
    if alignment.verdict.outcome is Outcome.REFUSED:
        lines = _refused_lines(alignment)
    else:
        lines = [found_line(alignment), *accuracy_lines(alignment), masks_line(alignment)]
        lines.append(next_line(alignment, written))
    return "\n".join(shown(line) for line in lines if line)


def found_line(alignment: Alignment) -> str:
    """How far off MS lay, in one sentence."""
    motion = header_motion(alignment)
    if alignment.verdict.outcome is Outcome.ALREADY_ALIGNED:
        return "Already aligned: the header needs no correction and stays as it is."
    unit, truth = ("PAN px", "PAN") if alignment.has_pan else ("MS px", "the points")
    off = with_metres(motion.distance_px, motion.distance_m, unit)
    width, height = motion.scale
    parts = [moved(motion.shift_px)]
    if alignment.correction.model in ("scale", "similarity", "affine"):
        parts.append(f"scale × {width:.6f} by × {height:.6f}")
    if alignment.correction.model in ("similarity", "affine"):
        way = "clockwise" if motion.rotation_deg < 0 else "counterclockwise"
        parts.append(f"turned {abs(motion.rotation_deg):.4f}° {way}")
    if alignment.correction.model == "affine":
        parts.append(f"shear {motion.shear_deg:+.4f}°")
    return (
        f"Aligned: MS lay {off} off {truth}; at its centre it moves {', '.join(parts)} "
        f"(model {alignment.correction.model})."
    )


def accuracy_lines(alignment: Alignment) -> list[str]:
    """How good the fit is, what matters most first: uncertainty, residual, scatter of patches."""
    accuracy, metres = alignment.accuracy, metres_per_px(alignment)

    def both(px: float) -> str:
        return with_metres(px, px * metres, "PAN px" if alignment.has_pan else "MS px")

    lines = []
    if math.isfinite(accuracy.uncertainty_px):
        lines.append(
            f"Uncertainty of the correction: {both(accuracy.uncertainty_px)}, 95 % at the worst "
            "corner."
        )
    low, high = map(short, accuracy.residual_interval_px)
    if math.isfinite(accuracy.residual_rms_px):
        lines.append(
            f"Residual misregistration after it: {both(accuracy.residual_rms_px)} RMS (95 %: {low} "
            f"to {high}), 95th percentile {both(accuracy.residual_p95_px)}."
        )
    if not math.isfinite(accuracy.check_rmse_px):
        return [*lines, f"{accuracy.kept} tie points; too few to measure how patches scatter."]
    text = (
        f"Patch scatter, the noise of single matches: {both(accuracy.check_rmse_px)} RMS at "
        f"{accuracy.checked} check points"
    )
    if math.isfinite(accuracy.coverage):
        text += f", which span {100 * accuracy.coverage:.0f} % of the overlap"
    return [*lines, f"{text}."]


def masks_line(alignment: Alignment) -> str:
    """Which masks were used and how much each hides; empty without any."""
    images = {"source": "MS", "reference": "PAN"}
    used = [
        f"{Path(use.path).name} ({use.kind}) {100 * use.hidden_share:.1f} % of {images[use.image]}"
        for use in alignment.masks
        if math.isfinite(use.hidden_share)
    ]
    return f"Masks hide: {', '.join(used)}." if used else ""


def next_line(alignment: Alignment, written: WriteOptions | None = None) -> str:
    """What to do with an accepted result, in one sentence."""
    written = written or WriteOptions()
    if alignment.verdict.outcome is Outcome.ALREADY_ALIGNED:
        return "Next: use the raster as it is."
    if written.georef == "gcps":
        return "Next: OUT has control points and no grid; gdalwarp makes one of them."
    if written.warp:
        return "Next: the resampled grid is north-up, ready for pansharpening with PAN."
    if not alignment.fits_a_header:
        return (
            "Next: no geotransform holds this correction: resample with it (`warp=True`), or "
            "pass control points on (`export_gcps`)."
        )
    original, corrected = alignment.correction.original, alignment.correction.corrected
    if corrected.b or corrected.d:
        remedy = "for them add `warp=True`"
        if not (original.b or original.d):
            remedy += ", or keep the grid north-up with `model='scale'`"
        return (
            "Next: the corrected grid is rotated, which GDAL's pansharpening and gdalbuildvrt "
            f"refuse: {remedy}."
        )
    return "Next: the corrected grid is north-up, ready for pansharpening with PAN."


def _refused_lines(alignment: Alignment) -> list[str]:
    failed = [reason.message for reason in alignment.verdict.reasons if not reason.passed]
    return [
        "Refused: the images do not support an alignment; the header stays as it is.",
        *(f"  - {message}" for message in failed),
        masks_line(alignment),
        f"Next: {alignment.verdict.remedy}",
    ]


def moved(shift_px: tuple[float, float]) -> str:
    """A move along columns and rows, in pixels: "3.10 px right, 0.52 px up"."""
    right, down = shift_px
    return (
        f"{short(abs(right))} px {'right' if right >= 0 else 'left'}, "
        f"{short(abs(down))} px {'down' if down >= 0 else 'up'}"
    )


def with_metres(px: float, m: float, unit: str = "PAN px") -> str:
    """A length in pixels of PAN, and in metres where these are known."""
    return f"{short(px)} {unit}" + (f" ({short(m)} m)" if math.isfinite(m) else "")


def short(value: float) -> str:
    """Three significant digits without an exponent; "unknown" for NaN."""
    if not math.isfinite(value):
        return "unknown"
    digits = 2 - math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.{min(max(digits, 0), 4)}f}"
