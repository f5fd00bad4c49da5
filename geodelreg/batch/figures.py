"""What a table of pairs shows of an alignment."""

from __future__ import annotations

import math
from collections.abc import Mapping

from geodelreg.batch.job import FIGURES
from geodelreg.product.motion import header_motion
from geodelreg.values.result import Alignment, Misalignment


def figures_of(alignment: Alignment) -> dict[str, float | str | None]:
    """`FIGURES` of an alignment; those that only a check measures are None.

    So are the correction and its accuracy after a refusal: nothing was corrected.
    """
    accuracy, motion = alignment.accuracy, header_motion(alignment)
    evidence = {"coverage": accuracy.coverage, "tie_points": accuracy.kept}
    if not alignment.verdict.accepted:
        return dict.fromkeys(FIGURES) | _known(evidence)
    found: dict[str, float | str] = {
        "model": alignment.correction.model,
        "offset_px": motion.distance_px,
        "offset_m": motion.distance_m,
        "before_rmse_px": accuracy.before_rmse_px,
        "uncertainty_px": accuracy.uncertainty_px,
        "residual_rms_px": accuracy.residual_rms_px,
        "check_rmse_px": accuracy.check_rmse_px,
        "check_rmse_m": accuracy.check_rmse_m,
        "check_ce90_px": accuracy.check_ce90_px,
        "sigma_corner_px": accuracy.sigma_corner_px,
    }
    return dict.fromkeys(FIGURES) | _known(found) | _known(evidence)


def check_figures(misalignment: Misalignment) -> dict[str, float | str | None]:
    """What a check measures, for `FIGURES`."""
    return _known(
        {
            "misalignment_px": misalignment.distance_px,
            "misalignment_m": misalignment.distance_m,
            "misalignment_sigma_px": misalignment.sigma_px,
        }
    )


def _known(values: Mapping[str, float | str]) -> dict[str, float | str | None]:
    """The same; numbers that are not finite are None."""
    return {
        name: value if isinstance(value, str) or math.isfinite(value) else None
        for name, value in values.items()
    }
