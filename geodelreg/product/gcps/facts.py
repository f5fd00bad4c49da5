"""Numbers of a control point beside its place: written where a format has fields, and read back.

Lengths that end in ``_px`` are PAN pixels.  `SIGMA_X`, `SIGMA_Y` (units of the map) and
`ERROR_CORRELATION` are the covariance of the map position: with them a fit weighs the points anew,
and with `WEIGHT` and `FIT` as it did.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from geodelreg.errors import GcpFormatError
from geodelreg.geo.affine import affine_matrix, apply_affine
from geodelreg.geo.maps.header import header_map
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.options import MODELS
from geodelreg.values.points import FitForm, Gcp
from geodelreg.values.raster import FloatArray, Grid, IntArray
from geodelreg.values.result import Alignment

ENABLE, STATUS, BAND = "enable", "status", "band"
SIGMA_X, SIGMA_Y, ERROR_CORRELATION = "sigma_x", "sigma_y", "error_correlation"
HEADER = ("header_x", "header_y")
"""Map position of the pixel by the original header: of which raster the point is."""
COVARIANCE = (SIGMA_X, SIGMA_Y, ERROR_CORRELATION)
WEIGHT, FIT = "weight", "fit"
MEASURED = (*COVARIANCE, WEIGHT)
"""What no longer holds of a point that was moved."""
NAMES = (
    STATUS, BAND, "residual_right_px", "residual_down_px", "sigma_right_px", "sigma_down_px",
    "correlation", *MEASURED, *HEADER,
)  # fmt: skip
Facts = tuple[tuple[str, float | None], ...]


def facts_of(alignment: Alignment, order: IntArray) -> list[Facts]:
    """Facts of some tie points; None where one is not known."""
    points, source = alignment.tie_points, alignment.source.grid
    covariance = map_covariance(
        points.reference_px[order], points.covariance_px2[order], source, alignment.reference.grid
    )
    sigma = np.sqrt(covariance[:, (0, 1), (0, 1)])
    with np.errstate(invalid="ignore", divide="ignore"):
        together = covariance[:, 0, 1] / (sigma[:, 0] * sigma[:, 1])
    weight = np.full(len(points), np.nan) if points.weight is None else points.weight
    rows = np.column_stack(
        [
            points.status[order], np.zeros(len(order)), points.residual_px[order],
            points.sigma_px[order], points.score[order], sigma, together, weight[order],
            apply_affine(source.transform, points.source_px[order]),
        ]
    )  # fmt: skip
    return [
        tuple((n, v if math.isfinite(v) else None) for n, v in zip(NAMES, row, strict=True))
        for row in rows.tolist()
    ]


def of_bands(alignment: Alignment, gcps: Sequence[Gcp]) -> tuple[Gcp, ...]:
    """The same points where each band that lies apart shows them.

    Parameters
    ----------
    alignment : Alignment
    gcps : sequence of Gcp
        Of the common map.
    """
    at = np.array([(gcp.column, gcp.row) for gcp in gcps], dtype=np.float64).reshape(-1, 2)
    header_px, found = alignment.solution.map.forward(at), []
    for band in alignment.solution.bands:
        pixels = band.map.inverse(header_px)
        places = apply_affine(alignment.source.grid.transform, pixels)
        for gcp, (column, row), (x, y) in zip(gcps, pixels.tolist(), places.tolist(), strict=True):
            known = dict(gcp.facts) | {BAND: float(band.number), WEIGHT: None}
            facts = tuple((known | dict(zip(HEADER, (x, y), strict=True))).items())
            name = f"{gcp.id}b{band.number}"
            found.append(replace(gcp, id=name, column=column, row=row, facts=facts, form=None))
    return tuple(found)


def band_of(gcp: Gcp) -> int:
    """Number of the band that a point belongs to; 0 of the common map of all."""
    return int(dict(gcp.facts).get(BAND) or 0)


def map_covariance(
    reference_px: FloatArray, covariance_px2: FloatArray, source: Grid, reference: Grid
) -> FloatArray:
    """(N, 2, 2) covariances of PAN pixels, as those of map positions in the CRS of MS."""
    _, in_source = Inverse(header_map(source, reference)).carry(reference_px, covariance_px2)
    unit = affine_matrix(source.transform)[:, :2]
    return np.asarray(np.einsum("ij,njk,lk->nil", unit, in_source, unit))


def covariance_of(gcp: Gcp, file: str) -> FloatArray:
    """(2, 2) covariance of the map position, units of the map squared; NaN where it is not known.

    Raises
    ------
    GcpFormatError
        The facts are those of no point.
    """
    facts = dict(gcp.facts)
    x, y, together = (facts.get(name) for name in COVARIANCE)
    if x is None or y is None:
        return np.full((2, 2), np.nan)
    together = together or 0.0
    if not (x > 0 and y > 0 and abs(together) < 1):
        raise GcpFormatError(
            f"{file}: point {gcp.id} has standard errors {x:g} and {y:g}, correlation {together:g}",
            f"Give {SIGMA_X} and {SIGMA_Y} above 0, or leave them empty.",
        )
    both = together * x * y
    return np.array([[x * x, both], [both, y * y]])


def read_facts(fields: Mapping[str, Any], where: str) -> tuple[Facts, bool]:
    """Facts among the fields of a point, and whether it is enabled.

    Without a field ``enable`` those are whose ``status`` is 0 (kept).

    Raises
    ------
    GcpFormatError
        One is no number.
    """
    found = {name: _number(fields[name], where) for name in NAMES if name in fields}
    enable = _number(fields.get(ENABLE), where)
    enabled = not found.get(STATUS) if enable is None else enable != 0
    return tuple(found.items()), enabled


def fields_of(gcp: Gcp) -> dict[str, float | str | None]:
    """Enabled flag, facts and fit to write; none of a point of which nothing more is known."""
    if not gcp.facts:
        return {}
    form = {} if gcp.form is None else {FIT: json.dumps(asdict(gcp.form), allow_nan=False)}
    return {ENABLE: int(gcp.enabled), **dict(gcp.facts), **form}


def form_of(text: Any, where: str) -> FitForm | None:
    """The fit that a field of a point tells of; None of an empty one.

    Raises
    ------
    GcpFormatError
        It tells of none.
    """
    if text is None or text == "":
        return None
    try:
        said = json.loads(text)
        one, other = said["variance_px2"]
        rows = tuple(float(row) for row in said["jump_rows"])
        spread, reach = float(said["spread_px2"]), float(said["range_px"])
        form = FitForm(str(said["model"]), spread, reach, (float(one), float(other)), rows)
        known = form.model in MODELS[1:] and spread >= 0 and rows == tuple(sorted(set(rows)))
        field = form.model != "field" or (reach > 0 and min(form.variance_px2) > 0)
        if not (known and field and all(map(math.isfinite, (spread, reach, one, other, *rows)))):
            raise ValueError(f"a {form.model} of such numbers")
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise GcpFormatError(
            f"{where}: its {FIT} cannot be read ({error})",
            f"Leave {FIT} as it was exported, or empty it: the points are then fitted anew.",
        ) from error
    return form


def _number(value: Any, where: str) -> float | None:
    if value is None or value == "":
        return None
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise GcpFormatError(f"{where}: {value!r} is no number") from error
    return number if math.isfinite(number) else None
