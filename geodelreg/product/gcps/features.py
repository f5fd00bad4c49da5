"""Control points as features with a place and fields, whatever file they come from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from geodelreg.errors import GcpFormatError
from geodelreg.product.gcps.context import numbers
from geodelreg.product.gcps.facts import COVARIANCE, ENABLE, fields_of, read_facts
from geodelreg.values.points import Gcp


class Feature(NamedTuple):
    """A point as it was read.

    Attributes
    ----------
    fields : mapping
    place : (float, float) or None
        Where its geometry lies, in the CRS of ``x`` and ``y``.
    moved : bool
        The geometry does not lie where ``x`` and ``y`` say.
    """

    fields: Mapping[str, Any]
    place: tuple[float, float] | None
    moved: bool


def fields_of_gcp(gcp: Gcp) -> dict[str, Any]:
    """What stands beside the geometry of a point."""
    place = {"row": gcp.row, "col": gcp.column, "x": gcp.x, "y": gcp.y, "z": gcp.z}
    return {"id": gcp.id, "info": gcp.info, **place, **fields_of(gcp)}


def gcps_of(features: Sequence[Feature]) -> tuple[Gcp, ...]:
    """Control points of features that a person may have edited.

    Of a point that was exported and whose geometry lies elsewhere than its ``x`` and ``y``, the
    geometry holds, and its standard errors do not.  A point that was drawn has a geometry only.

    Raises
    ------
    GcpFormatError
        Something is missing or no number.
    """
    return tuple(_gcp(feature, index) for index, feature in enumerate(features, start=1))


def _gcp(feature: Feature, index: int) -> Gcp:
    fields, place, moved = feature
    missing = [name for name in ("row", "col", "x", "y") if fields.get(name) is None]
    if missing and place is None:
        raise GcpFormatError(f"feature {index} lacks the properties {', '.join(missing)}")
    facts, enabled = read_facts(fields, f"feature {index}")
    drawn = "x" in missing or "y" in missing
    if drawn or (moved and ENABLE in fields):
        assert place is not None
        x, y = place
        facts = tuple((name, value) for name, value in facts if name not in COVARIANCE)
    else:
        x, y = numbers([str(fields["x"]), str(fields["y"])], index)
    column = row = math.nan
    if "row" not in missing and "col" not in missing:
        column, row = numbers([str(fields["col"]), str(fields["row"])], index)
    z = numbers([str(fields.get("z") or 0.0)], index)[0]
    name, info = fields.get("id"), str(fields.get("info") or "")
    return Gcp(str(name or index), column, row, x, y, z, info, enabled, facts)
