"""Points out of a file, as a fit takes them: in pixels of the raster that they were made for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geodelreg.errors import PointsError
from geodelreg.geo.affine import affine_matrix, apply_affine
from geodelreg.product.gcps.context import GcpContext, ground_of, pixels_of
from geodelreg.product.gcps.facts import HEADER, MEASURED, STATUS, WEIGHT, band_of, covariance_of
from geodelreg.values.points import Gcp, GivenPoints, Status
from geodelreg.values.raster import Grid

_SAME_PX = 0.01  # of MS, between a pixel and where the header of its raster had it


def given_points(
    path: Path,
    format: str | None,  # noqa: A002 - the field's word
    source: Grid,
    reference: Grid | None,
    band: int | None,
) -> GivenPoints:
    """Read control points, also those that are not enabled.

    Parameters
    ----------
    path : Path
    format : str, optional
        Key of `geodelreg.product.gcps.GCP_FORMATS`.
    source : Grid
        Of MS, with its original header.
    reference : Grid, optional
        Of PAN.
    band : int, optional
        Take the points of this band, where there are any, instead of those of the common map.

    Raises
    ------
    GcpFormatError, PointsError, CrsTransformError
    """
    from geodelreg.product.gcps import in_crs_of, read_gcps

    context = GcpContext(source, reference=reference)
    gcps = in_crs_of(source, *read_gcps(path, format, context, every=True))
    bands = set(map(band_of, gcps))
    gcps = tuple(gcp for gcp in gcps if band_of(gcp) == (band if band in bands else 0))
    if not gcps:
        raise PointsError(f"{path} has no points", "Name the file that `export_gcps` has written.")
    gcps = _of_raster(path, gcps, source)
    unit = np.linalg.inv(affine_matrix(source.transform)[:, :2])
    covariance = np.stack([covariance_of(gcp, str(path)) for gcp in gcps])
    facts = [dict(gcp.facts) for gcp in gcps]
    score = np.array([fact.get("correlation") for fact in facts], dtype=np.float64)
    enabled = np.array([gcp.enabled for gcp in gcps])
    rejected = [int(fact.get(STATUS) or 0) for fact in facts]
    weight = np.array([fact.get(WEIGHT) for fact in facts], dtype=np.float64)
    weight[~((weight > 0) & np.isfinite(covariance).all(axis=(1, 2)))] = np.nan
    weight[enabled != (np.array(rejected) == Status.KEPT)] = np.nan
    forms = {gcp.form for gcp in gcps if gcp.form is not None}
    if len(forms) > 1:
        raise PointsError(
            f"{path}: its points come from {len(forms)} fits",
            "Empty the field fit: they are then fitted anew.",
        )
    status = [code if code in set(Status) and code else int(Status.EXCLUDED) for code in rejected]
    return GivenPoints(
        str(path),
        tuple(gcp.id for gcp in gcps),
        pixels_of(gcps),
        apply_affine(~source.transform, ground_of(gcps)),
        np.asarray(np.einsum("ij,njk,lk->nil", unit, covariance, unit)),
        score,
        enabled,
        np.array(status, dtype=np.uint8),
        weight,
        forms.pop() if forms else None,
    )


def _of_raster(path: Path, gcps: Sequence[Gcp], source: Grid) -> tuple[Gcp, ...]:
    """The points, those whose pixel was edited without standard errors.

    Raises
    ------
    PointsError
        Most were made for another raster, or one with another header.
    """
    said = [[dict(gcp.facts).get(name) for name in HEADER] for gcp in gcps]
    there = apply_affine(~source.transform, np.array(said, dtype=np.float64).reshape(-1, 2))
    gap = np.abs(there - pixels_of(gcps)).max(axis=1)
    elsewhere = gap > _SAME_PX
    if elsewhere.sum() > np.isfinite(gap).sum() / 2:
        raise PointsError(
            f"{path}: {elsewhere.sum()} of {np.isfinite(gap).sum()} points are those of another "
            "raster, or of this one with another header",
            "Name the raster that the points were made for, with its original header.",
        )
    return tuple(
        replace(gcp, facts=tuple(fact for fact in gcp.facts if fact[0] not in MEASURED))
        if moved
        else gcp
        for gcp, moved in zip(gcps, elsewhere.tolist(), strict=True)
    )
