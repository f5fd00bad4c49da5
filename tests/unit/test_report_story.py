"""What a page says in words, and which places it shows, of pairs whose fault is known."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray

from geodelreg.geo.maps.affine import AffineMap
from geodelreg.judge.verdict import Evidence, judge, too_few_for_a_field
from geodelreg.options import AlignOptions
from geodelreg.report.drawing import mesh
from geodelreg.report.frame import frame_of
from geodelreg.report.places import places
from geodelreg.report.residuals import error_map, sigma_map
from geodelreg.report.words import bar, bars, command, story
from geodelreg.values.points import Status, TiePoints
from geodelreg.values.raster import Grid
from geodelreg.values.result import Alignment, Outcome, Reason, Verdict
from tests.unit.alignment_sample import MS_HEADER, PAN_HEADER, SHIFTED, UTM16, alignment, refused

SIDE = 12
"""Patches along an axis of MS, 100 × 80 pixels."""
REFUSED = Verdict(Outcome.REFUSED, (Reason("rival_motion", 0.9, 0.67, False, "0.9 patches"),))


def patches(
    residual: NDArray[np.float64], away: NDArray[np.bool_], silent: NDArray[np.bool_] | None = None
) -> TiePoints:
    """A lattice of patches with (N, 2) residuals in PAN pixels; some lie elsewhere."""
    x, y = np.meshgrid(np.linspace(4, 96, SIDE), np.linspace(4, 76, SIDE))
    source = np.stack([x.ravel(), y.ravel()], axis=1)
    there = np.array([~PAN_HEADER @ (SHIFTED @ tuple(xy)) for xy in source])
    status = np.where(away, Status.CONSENSUS, Status.KEPT).astype(np.uint8)
    if silent is not None:
        status[silent] = Status.TEXTURE
        residual = np.where(silent[:, None], np.nan, residual)
    return TiePoints(
        source_px=source,
        reference_px=there - residual if silent is None else there,
        covariance_px2=np.tile(np.diag([1e-4, 1e-4]), (len(source), 1, 1)),
        score=np.full(len(source), 0.9),
        status=status,
        residual_px=residual,
    )


def lattice() -> NDArray[np.float64]:
    x, y = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def noise(scale: float) -> NDArray[np.float64]:
    return np.random.default_rng(3).normal(0, scale, (SIDE * SIDE, 2))


def torn() -> Alignment:
    lower = lattice()[:, 1] > 0.7
    residual = noise(0.02) + np.where(lower[:, None], [5.0, -3.0], [0.0, 0.0])
    return alignment(tie_points=patches(residual, lower), verdict=REFUSED)


def bent() -> Alignment:
    x, y = lattice().T
    residual = noise(0.02) + np.stack([2 * np.sin(3 * y), 2 * np.cos(3 * x) * y], axis=1)
    return alignment(tie_points=patches(residual, y > 0.4), verdict=REFUSED)


def cloudy() -> Alignment:
    x, y = lattice().T
    cloud = (x < 0.68) & (y < 0.68)
    silent = cloud & (np.arange(SIDE * SIDE) % 4 > 0)
    residual = noise(0.02) + np.where(cloud[:, None], noise(2.0), 0.0)
    return alignment(tie_points=patches(residual, cloud, silent))


@pytest.mark.parametrize(
    ("made", "told"),
    [
        (
            torn(),
            ("the lower 33 % of the patches", "between rows 50 and 56 of MS", "all alike (5.0",
             "right and 3.0", "up), as if that part were torn"),
        ),
        (bent(), ("in directions that change gradually, as if the picture were bent",)),
        (
            cloudy(),
            ("patches showed nothing to match, as water does", "in the upper left of",
             "each in its own direction, as clouds"),
        ),
    ],
    ids=["torn", "bent", "cloudy"],
)  # fmt: skip
def test_the_story_says_what_is_wrong_and_where(made: Alignment, told: tuple[str, ...]) -> None:
    text = " ".join(story(made))
    for words in told:
        assert words in text


def test_of_misfits_all_around_the_story_says_where_it_fits() -> None:
    """A bend's patches fit in one corner and lie elsewhere at all sides of it."""
    x, y = lattice().T
    away = (x < 0.55) | (y > 0.45)
    residual = noise(0.02) + np.where(away[:, None], np.stack([3 * y, 2 * x + 1], axis=1), 0.0)
    text = " ".join(story(alignment(tie_points=patches(residual, away), verdict=REFUSED)))
    assert "all over the picture (those that fit: mostly in the upper right of" in text
    assert "in the middle" not in text


def test_a_refusal_says_what_was_refused() -> None:
    text = " ".join(story(torn()))
    assert "moves MS at its centre 3.00 right and 1.50 down (PAN px, model shift)" in text


def test_the_story_of_a_good_pair_alarms_nobody() -> None:
    good = alignment(tie_points=patches(noise(0.02), np.zeros(SIDE * SIDE, dtype=bool)))
    text = " ".join(story(good))
    assert "MS lay" in text
    for alarming in ("elsewhere", "torn", "bent", "nothing to match"):
        assert alarming not in text


def test_where_nothing_matched_is_told_and_shown() -> None:
    lower = lattice()[:, 1] > 0.55
    points = patches(noise(0.02), np.zeros(SIDE * SIDE, dtype=bool))
    points = replace(points, status=np.where(lower, Status.CONVERGENCE, points.status))
    made = alignment(tie_points=points, verdict=REFUSED)
    text = " ".join(story(made))
    assert "60 of 144 patches match nothing near where the others say" in text
    assert "the lower" in text
    assert "as water does" not in text
    *_, last = places(made.tie_points, frame_of(made))
    assert last.name == "unmatched"
    assert last.where.startswith("lower")


def test_the_worst_place_lies_where_the_fault_is_and_the_best_does_not() -> None:
    made = torn()
    found = {place.name: place for place in places(made.tie_points, frame_of(made))}
    assert list(found) == ["worst", "typical", "best"]
    assert found["worst"].residual_px == pytest.approx((5.0, -3.0), abs=0.1)
    assert "lower" in found["worst"].where
    for name in ("typical", "best"):
        assert found[name].distance_px < 0.1
        assert "lower" not in found[name].where
    assert found["best"].distance_px <= found["typical"].distance_px
    window = frame_of(made).window
    for place in found.values():
        column, row, width, height = place.window
        assert window.column <= column
        assert column + width <= window.column + window.width
        assert window.row <= row
        assert row + height <= window.row + window.height


def test_the_best_place_holds_no_gross_misfits_and_the_typical_one_is_as_the_rest() -> None:
    x, y = lattice().T
    residual = np.stack([0.2 + 3 * x, 0 * x], axis=1)  # more and more to the right
    spot = np.flatnonzero((x < 0.25) & (y < 0.5))[::3]
    residual[spot] = 15.0  # a third of the points at the upper left: their median does not show it
    away = np.zeros(SIDE * SIDE, dtype=bool)
    away[spot] = True
    made = alignment(tie_points=patches(residual, away))
    found = {place.name: place for place in places(made.tie_points, frame_of(made))}
    assert "left" in found["best"].where
    assert "upper" not in found["best"].where
    assert found["typical"].distance_px == pytest.approx(1.7, abs=0.4)
    assert found["worst"].where.endswith("right")


def test_a_place_where_much_is_missing_is_none_of_the_three() -> None:
    x, y = lattice().T
    residual = noise(0.02)
    far = (x > 0.85) & (y > 0.85)
    residual[far] = 9.0
    every = patches(residual, far)
    there = ~((x > 0.45) & (y > 0.45)) | far  # no data, but for a scrap in the corner
    given = {field.name: getattr(every, field.name) for field in fields(every)}
    kept = {name: values[there] for name, values in given.items() if values is not None}
    made = alignment(tie_points=TiePoints(**kept))
    for place in places(made.tie_points, frame_of(made)):
        low = np.array(place.window[:2])
        at = every.reference_px
        inside = ((at >= low) & (at < low + place.window[2:])).all(axis=1)
        assert (inside & there).sum() >= (inside & ~there).sum()
        assert place.distance_px < 1.0


def test_the_map_of_what_is_left_is_large_where_the_fault_is() -> None:
    made = torn()
    values = error_map(made.tie_points, frame_of(made))
    upper, lower = values[: len(values) // 2], values[-len(values) // 8 :]
    assert np.nanmax(upper) < 0.2
    assert np.nanmin(lower) > 5.0
    # three gross mismatches among good neighbours are nobody's fault
    residual = noise(0.02)
    residual[[14, 70, 120]] += 30.0
    away = np.zeros(SIDE * SIDE, dtype=bool)
    away[[14, 70, 120]] = True
    made = alignment(tie_points=patches(residual, away))
    assert np.nanmax(error_map(made.tie_points, frame_of(made))) < 0.2


def test_no_standard_error_is_shown_where_no_point_supports_the_correction() -> None:
    def known_of(made: Alignment) -> NDArray[np.bool_]:
        found = AffineMap(~MS_HEADER @ SHIFTED, lambda xy: np.full(len(xy), 0.01))
        made = replace(made, solution=replace(made.solution, map=found))
        return np.isfinite(sigma_map(made.tie_points, frame_of(made)))

    known = known_of(torn())
    assert known[5 : len(known) // 2, 5:-5].all()  # MS ends beside
    assert not known[-len(known) // 5 :].any()
    # nor under a cloud wider than the reach of the points around it
    x, y = lattice().T
    cloud = (x < 0.75) & (y < 0.75)
    known = known_of(alignment(tie_points=patches(noise(0.02), cloud & False, cloud)))
    assert not known[: len(known) // 4, : len(known[0]) // 4].any()
    assert known[-len(known) // 8 :, -len(known[0]) // 8 :].any()


def test_the_mesh_bridges_no_gap() -> None:
    x = lattice()[:, 0]
    cloud = (x > 0.2) & (x < 0.8)
    points = patches(noise(0.02), cloud & False, cloud)
    sides = points.source_px[mesh(points), 0]
    assert len(sides) == 2 * 2 * 2 * (SIDE - 1)  # two strips, three columns of points each
    assert (np.ptp(sides, axis=1) < 20).all()


def test_of_a_map_without_standard_errors_none_is_shown() -> None:
    assert np.isnan(sigma_map(refused().tie_points, frame_of(refused()))).all()


def test_without_points_the_middle_is_shown() -> None:
    points = patches(noise(0.1), np.zeros(SIDE * SIDE, dtype=bool), np.ones(SIDE * SIDE, bool))
    made = alignment(tie_points=points)
    (place,) = places(made.tie_points, frame_of(made))
    assert place.name == "middle"
    assert place.where == "middle"


def test_ms_that_lies_nowhere_on_pan_shows_all_of_pan() -> None:
    far = Affine.translation(1e6, 0) @ MS_HEADER
    made = alignment(source=Grid(far, (80, 100), UTM16), corrected=far)
    assert frame_of(made).window == (0, 0, 400, 320)


@pytest.mark.parametrize(
    ("value", "limit", "passed", "name", "used"),
    [
        (0.35, 0.7, True, "sigma_px", 0.5),
        (1.4, 0.7, False, "sigma_px", 2.0),
        (16.0, 8.0, True, "tie_points", 0.5),
        (4.0, 8.0, False, "tie_points", 2.0),
        (-200.0, -2.0, True, "log_nfa", 0.01),
        (-1.0, -2.0, False, "log_nfa", 2.0),
        (3.0, -2.0, False, "log_nfa", 2.0),
        (0.0, 0.5, True, "local", 0.0),
        (float("nan"), 0.5, False, "local", 2.0),
        (float("nan"), 0.5, True, "local", 0.0),
    ],
)
def test_a_bar_is_beyond_the_limit_when_its_reason_failed(
    value: float, limit: float, passed: bool, name: str, used: float
) -> None:
    found = bar(Reason(name, value, limit, passed, ""))
    assert found.used == pytest.approx(used)
    assert (found.used <= 1.0) is passed


@pytest.mark.parametrize("interval", [(float("nan"), float("nan")), (0.0, 0.1)])
def test_what_was_not_measured_has_neither_passed_nor_failed(
    interval: tuple[float, float],
) -> None:
    """The whole is not asked when patches agree on a rival motion; its zeros are no measure."""
    zeros = tuple(Reason(name, 0.0, 0.5, True, "0 of") for name in ("two_motions", "local"))
    made = bent()
    made = replace(
        made,
        solution=replace(
            made.solution,
            verdict=Verdict(Outcome.REFUSED, REFUSED.reasons + zeros),
            accuracy=replace(made.solution.accuracy, residual_interval_px=interval),
        ),
    )
    rival, *whole = bars(made)
    assert rival.passed is False
    for found in whole:
        assert found.passed is (None if np.isnan(interval[0]) else True)
        assert ("not measured" in found.message) is bool(np.isnan(interval[0]))


def test_each_reason_of_the_gate_has_its_words() -> None:
    kinds = {"words": "", "bands_words": ""}
    unknown = {field.name: kinds.get(field.name, float("nan")) for field in fields(Evidence)}
    limits = AlignOptions(
        max_shift_px=1.0,
        max_rotation_deg=1.0,
        max_scale=1.1,
        max_uncertainty_px=1,
        on_local="refuse",
    )
    reasons = (*judge(Evidence(**unknown), limits), too_few_for_a_field(5))  # type: ignore[arg-type]
    assert {"strain", "bands", "local", "max_shift"} <= {reason.name for reason in reasons}
    for found in map(bar, reasons):
        assert found.passed is False
        assert found.meaning
        assert not found.failure.endswith(": no.")


def test_the_command_has_every_option_that_was_changed() -> None:
    asked: dict[str, Any] = {
        "model": "shift", "masks": ("my clouds.tif", "b.tif=3"), "threads": 3, "max_shift_px": 9.5,
        "north_up": True,
    }  # fmt: skip
    told = command(alignment(options=AlignOptions(**asked)))
    assert told == (
        "geodelreg align scene/ms.tif scene/pan.tif --dry-run --report again.html --model shift "
        "--north-up --mask 'my clouds.tif' --mask b.tif=3 --max-shift 9.5"
    )
