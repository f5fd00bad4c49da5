"""An alignment with known numbers, for tests of what is made from one."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from affine import Affine
from pyproj import CRS

from geodelreg.geo.maps.affine import IDENTITY, AffineMap
from geodelreg.options import AlignOptions
from geodelreg.values.points import NO_TIE_POINTS, Status, TiePoints
from geodelreg.values.raster import Grid
from geodelreg.values.result import (
    Accuracy,
    Alignment,
    Input,
    Outcome,
    Reason,
    Solution,
    Verdict,
)

UTM16 = CRS.from_epsg(32616).to_wkt()
UTM17 = CRS.from_epsg(32617).to_wkt()
GEOGRAPHIC = CRS.from_epsg(4326).to_wkt()

MS_HEADER = Affine(8.0, 0.0, 500000.0, 0.0, -8.0, 1300000.0)
PAN_HEADER = Affine(2.0, 0.0, 500000.0, 0.0, -2.0, 1300000.0)
# moves the MS raster by 6 m east and 3 m south at its centre, with no rotation or scale
SHIFTED = Affine(8.0, 0.0, 500006.0, 0.0, -8.0, 1299997.0)

# given out of reading order, on purpose
SOURCE_PX = np.array([[90.5, 70.25], [10.0, 20.0], [80.0, 20.0], [15.5, 60.0], [50.0, 41.0]])


def tie_points(corrected: Affine = SHIFTED, pan: Affine = PAN_HEADER) -> TiePoints:
    """Five points on the corrected header; the last one is rejected and far off."""
    reference = np.array([~pan @ (corrected @ tuple(xy)) for xy in SOURCE_PX])
    reference[-1] += 25.0
    status = np.full(len(reference), Status.KEPT, dtype=np.uint8)
    status[-1] = Status.STAR
    residual = np.array([[0.03, -0.04], [0.0, 0.05], [-0.06, 0.0], [0.0, 0.0], [np.nan, np.nan]])
    return TiePoints(
        source_px=SOURCE_PX,
        reference_px=reference,
        covariance_px2=np.tile(np.diag([0.0004, 0.0009]), (5, 1, 1)),
        score=np.array([0.99, 0.98, 0.97, 0.96, 0.4]),
        status=status,
        residual_px=residual,
    )


def alignment(**changes: Any) -> Alignment:
    """A pair 100 × 80 (MS) and 400 × 320 (PAN), 4:1, whose header was 6 m and 3 m off.

    `changes` are fields of the alignment or of its solution; ``corrected`` is the geotransform that
    its map makes of the source's, ``source_paths`` and ``reference_path`` name the inputs.
    """
    source_paths = changes.pop("source_paths", ("scene/ms.tif",))
    reference_path = changes.pop("reference_path", "scene/pan.tif")
    source = changes.pop("source", Grid(MS_HEADER, (80, 100), UTM16))
    reference = changes.pop("reference", Grid(PAN_HEADER, (320, 400), UTM16))
    corrected = changes.pop("corrected", SHIFTED)
    solution = Solution(
        model="shift",
        map=AffineMap(~source.transform @ corrected),
        tie_points=tie_points(),
        accuracy=Accuracy(
            fit_rmse_px=0.04,
            check_rmse_px=0.0512345678901234,
            check_ce90_px=0.07,
            check_rmse_m=0.1024691357802468,
            check_ce90_m=0.14,
            before_rmse_px=3.4,
            before_rmse_m=6.8,
            coverage=0.87,
            kept=4,
            checked=4,
        ),
        verdict=Verdict(
            Outcome.ALIGNED,
            (Reason("check_rmse", 0.05, 0.5, True, "check points agree to 0.05 px"),),
        ),
        step_counts={"initial": 5, "star": 4},
        band_weights={"red": 0.25, "green": 0.75},
        warnings=("a warning",),
    )
    of_solution = {field.name for field in fields(Solution)} & set(changes)
    solution = replace(solution, **{name: changes.pop(name) for name in of_solution})
    made = Alignment(
        source=Input(source_paths, source, ("",) * len(source_paths)),
        reference=Input((reference_path,), reference, ("",)),
        solution=solution,
        options=AlignOptions(),
        warnings=solution.warnings,
        versions={"geodelreg": "0.1.0", "numpy": "2.0"},
        timings_s={"match": 0.5},
    )
    return replace(made, **changes)


def refused() -> Alignment:
    """Nothing was found: no tie points, an identity correction, unknown accuracy."""
    return alignment(
        model="none",
        map=IDENTITY,
        tie_points=NO_TIE_POINTS,
        accuracy=Accuracy(),
        verdict=Verdict(
            Outcome.REFUSED,
            (
                Reason("kept", 0.0, 8.0, False, "0 tie points agree, 8 are needed"),
                Reason("ncc", float("nan"), float("inf"), True, "not measured"),
            ),
        ),
    )
