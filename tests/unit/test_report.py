"""The report: valid under its schema, exact, stable; and the lines for people."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from affine import Affine
from jsonschema import Draft202012Validator, FormatChecker
from jsonschema.exceptions import ValidationError
from pyproj import CRS, Geod

from geodelreg.options import MODELS, AlignOptions, WriteOptions
from geodelreg.product.motion import header_motion
from geodelreg.product.report import report_dict, report_json, report_schema, summary_text
from geodelreg.values.points import Status
from geodelreg.values.raster import Grid
from geodelreg.values.result import Accuracy, Outcome, Reason, Verdict
from tests.unit.alignment_sample import (
    GEOGRAPHIC,
    MS_HEADER,
    PAN_HEADER,
    SHIFTED,
    UTM16,
    UTM17,
    alignment,
    refused,
)

VALIDATOR = Draft202012Validator(report_schema(), format_checker=FormatChecker())


def rotated(angle_deg: float, scale: tuple[float, float] = (1.0, 1.0)) -> Affine:
    """MS header turned counterclockwise about the raster's centre, pixels grown by `scale`."""
    centre = MS_HEADER @ (50.0, 40.0)
    about = Affine.translation(*centre) @ Affine.rotation(angle_deg) @ ~Affine.translation(*centre)
    grown = Affine.translation(50, 40) @ Affine.scale(*scale) @ Affine.translation(-50, -40)
    return about @ MS_HEADER @ grown


# --- schema --------------------------------------------------------------------------------------


def test_schema_is_a_schema() -> None:
    Draft202012Validator.check_schema(report_schema())


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("made", [alignment(), refused()], ids=["aligned", "refused"])
def test_report_is_valid(made: Any, listed: bool) -> None:
    report = report_dict(made, tie_points=listed)
    VALIDATOR.validate(report)
    assert ("points" in report["tie_points"]) is listed


@pytest.mark.parametrize(
    "path",
    [(), ("inputs",), ("correction", "at_centre"), ("accuracy",), ("options",), ("verdict",)],
)
def test_schema_is_strict_at_every_level(path: tuple[str, ...]) -> None:
    more = json.loads(report_json(alignment()))
    place = more
    for key in path:
        place = place[key]
    place["extra"] = 1
    with pytest.raises(ValidationError, match="'extra' was unexpected"):
        VALIDATOR.validate(more)
    del place["extra"]
    place.pop(next(iter(place)))
    with pytest.raises(ValidationError, match="is a required property"):
        VALIDATOR.validate(more)


def test_schema_knows_every_status_option_figure_and_model() -> None:
    properties = report_schema()["properties"]
    statuses = properties["tie_points"]["properties"]["by_status"]["properties"]
    assert list(statuses) == [status.name.lower() for status in Status]
    assert set(properties["options"]["properties"]) == {f.name for f in fields(AlignOptions)}
    figures = {f.name for f in fields(Accuracy)} | {"uncertainty_px"}
    assert set(properties["accuracy"]["properties"]) == figures
    models = properties["correction"]["properties"]["model"]["enum"]
    assert set(models) == {"none", *MODELS} - {"auto"}
    outcomes = properties["verdict"]["properties"]["outcome"]["enum"]
    assert outcomes == [outcome.value for outcome in Outcome]
    for option in fields(AlignOptions):
        if option.metadata["choices"]:
            choices = properties["options"]["properties"][option.name]["enum"]
            assert choices == list(option.metadata["choices"])


# --- contents ------------------------------------------------------------------------------------


def test_floats_are_exact_and_unknown_values_null() -> None:
    report = json.loads(report_json(alignment()))
    assert report["accuracy"]["check_rmse_px"] == 0.0512345678901234
    assert report["accuracy"]["sigma_corner_px"] is None
    assert report["accuracy"]["kept"] == 4


def test_geotransforms_are_in_gdal_order() -> None:
    correction = report_dict(alignment())["correction"]
    assert correction["original_geotransform"] == [500000.0, 8.0, 0.0, 1300000.0, 0.0, -8.0]
    assert correction["corrected_geotransform"] == [500006.0, 8.0, 0.0, 1299997.0, 0.0, -8.0]
    assert correction["map_transform"] == [6.0, 1.0, 0.0, -3.0, 0.0, 1.0]


def test_points_are_counted_by_status() -> None:
    points = report_dict(alignment(), tie_points=True)["tie_points"]
    assert points["total"] == 5
    assert {name: count for name, count in points["by_status"].items() if count} == {
        "kept": 4,
        "star": 1,
    }
    assert points["points"][4]["status"] == "star"
    assert points["points"][4]["residual_px"] == [None, None]
    assert points["points"][0]["source_px"] == [90.5, 70.25]


def test_steps_stay_in_their_order() -> None:
    made = alignment(step_counts={"zebra": 112, "ant": 97, "mule": 91})
    steps = json.loads(report_json(made))["step_counts"]
    assert [(step["step"], step["points"]) for step in steps] == [
        ("zebra", 112),
        ("ant", 97),
        ("mule", 91),
    ]


def test_numpy_values_become_plain_ones() -> None:
    made = alignment(
        accuracy=Accuracy(check_rmse_px=np.float64(0.25), kept=np.int64(7)),
        verdict=Verdict(
            Outcome.REFUSED, (Reason("n", np.float32(0.5), math.inf, np.bool_(False), "few"),)
        ),
        band_weights={"red": np.float32(0.5)},
    )
    report = json.loads(report_json(made))
    VALIDATOR.validate(report)
    assert report["accuracy"]["check_rmse_px"] == 0.25
    assert report["verdict"]["reasons"][0] == {
        "name": "n",
        "value": 0.5,
        "limit": None,
        "passed": False,
        "message": "few",
    }


def test_text_is_sorted_and_the_same_every_time() -> None:
    text = report_json(alignment(), tie_points=True)
    assert text == report_json(alignment(), tie_points=True)
    assert list(json.loads(text)) == sorted(json.loads(text))
    assert not text.endswith("\n")


def test_refused_report_keeps_the_reasons() -> None:
    report = report_dict(refused())
    assert report["verdict"]["outcome"] == "refused"
    assert report["verdict"]["accepted"] is False
    assert report["verdict"]["reasons"][1]["value"] is None
    assert report["correction"]["at_centre"]["distance_px"] == 0.0


# --- motion in plain terms -----------------------------------------------------------------------


def test_shift_is_in_pan_pixels_and_metres() -> None:
    motion = header_motion(alignment())
    assert motion.shift_px == pytest.approx((3.0, 1.5))
    assert motion.shift_m == pytest.approx((6.0, -3.0))
    assert motion.distance_m == pytest.approx(math.hypot(6, 3))
    assert (motion.rotation_deg, motion.shear_deg) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert motion.scale == pytest.approx((1.0, 1.0))


def test_shift_counts_in_pixels_of_a_rotated_pan() -> None:
    pan = PAN_HEADER @ Affine.rotation(90.0)  # its columns run south, its rows west
    made = alignment(reference=Grid(pan, (320, 400), UTM16))
    assert header_motion(made).shift_px == pytest.approx((1.5, -3.0))


def test_rotation_is_counterclockwise_on_the_ground() -> None:
    made = alignment(model="similarity", corrected=rotated(0.3))
    motion = header_motion(made)
    assert motion.rotation_deg == pytest.approx(0.3)
    assert motion.distance_px == pytest.approx(0.0, abs=1e-6)
    assert motion.scale == pytest.approx((1.0, 1.0))


def test_rotation_across_the_half_turn() -> None:
    made = alignment(model="similarity", corrected=rotated(-179.5))
    assert header_motion(made).rotation_deg == pytest.approx(-179.5)


def test_scale_is_along_columns_and_rows() -> None:
    made = alignment(model="affine", corrected=rotated(2.0, (1.01, 0.97)))
    motion = header_motion(made)
    assert motion.scale == pytest.approx((1.01, 0.97))
    assert motion.rotation_deg == pytest.approx(2.0)
    assert motion.shear_deg == pytest.approx(0.0, abs=1e-9)


def test_shear_is_the_change_of_the_right_angle() -> None:
    sheared = MS_HEADER @ Affine.shear(0.0, 1.5)
    motion = header_motion(alignment(model="affine", corrected=sheared))
    assert abs(motion.shear_deg) == pytest.approx(1.5)
    assert abs(motion.rotation_deg) == pytest.approx(0.75)


def test_metres_of_degrees_come_from_the_ellipsoid() -> None:
    header = Affine(1e-4, 0.0, 10.0, 0.0, -1e-4, 60.0)
    moved = Affine.translation(2e-4, 1e-4) @ header
    made = alignment(
        source=Grid(header, (80, 100), GEOGRAPHIC),
        reference=Grid(header @ Affine.scale(0.25), (320, 400), GEOGRAPHIC),
        model="shift",
        corrected=moved,
    )
    motion = header_motion(made)
    geod, (x, y) = Geod(ellps="WGS84"), header @ (50.0, 40.0)
    east = geod.inv(x, y, x + 2e-4, y)[2]
    north = geod.inv(x, y, x, y + 1e-4)[2]
    assert motion.shift_m == pytest.approx((east, north), rel=1e-6)
    assert motion.shift_px == pytest.approx((8.0, -4.0), rel=1e-6)


def test_rotation_on_the_ground_where_degrees_are_unequal() -> None:
    """At 60° north a degree east is half a degree north: a true rotation is none in degrees."""
    header = Affine(2e-4, 0.0, 10.0, 0.0, -1e-4, 60.0)
    geod, (x, y) = Geod(ellps="WGS84"), header @ (50.0, 40.0)
    east = geod.inv(x - 5e-5, y, x + 5e-5, y)[2]
    north = geod.inv(x, y - 5e-5, x, y + 5e-5)[2]
    to_metres = Affine.scale(east, north) @ Affine.translation(-x, -y)
    turned = ~to_metres @ Affine.rotation(1.0) @ to_metres @ header
    made = alignment(
        source=Grid(header, (80, 100), GEOGRAPHIC),
        model="similarity",
        corrected=turned,
    )
    motion = header_motion(made)
    assert motion.rotation_deg == pytest.approx(1.0, rel=1e-5)
    assert motion.scale == pytest.approx((1.0, 1.0), rel=1e-5)
    assert motion.shear_deg == pytest.approx(0.0, abs=1e-5)


def test_motion_in_another_crs_than_pans() -> None:
    pan = Affine(2.0, 0.0, -153000.0, 0.0, -2.0, 1306000.0)
    motion = header_motion(alignment(reference=Grid(pan, (3000, 3000), UTM17)))
    # zone 17 is turned and stretched a little against zone 16 out here, not more
    assert motion.distance_px == pytest.approx(math.hypot(3.0, 1.5), rel=0.01)
    assert motion.shift_px != pytest.approx((3.0, 1.5), rel=1e-4)


def test_motion_is_unknown_in_pixels_when_no_operation_connects_the_crss() -> None:
    site = CRS.from_wkt(
        'ENGCRS["site",EDATUM["site"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    )
    made = alignment(reference=Grid(PAN_HEADER, (320, 400), site.to_wkt()))
    motion = header_motion(made)
    assert math.isnan(motion.distance_px)
    assert motion.scale == pytest.approx((1.0, 1.0))
    VALIDATOR.validate(report_dict(made))
    assert "unknown" in summary_text(made)


# --- for people ----------------------------------------------------------------------------------


def test_summary_of_a_shift() -> None:
    assert summary_text(alignment()) == (
        "Aligned: MS lay 3.35 PAN px (6.71 m) off PAN; at its centre it moves 3.00 px right, "
        "1.50 px down (model shift).\n"
        "Patch scatter, the noise of single matches: 0.0512 PAN px (0.102 m) RMS at 4 check "
        "points, which span 87 % of the overlap.\n"
        "Next: the corrected grid is north-up, ready for pansharpening with PAN."
    )


def test_summary_of_a_rotation_names_the_remedies() -> None:
    text = summary_text(alignment(model="affine", corrected=rotated(0.3)))
    assert "turned 0.3000° counterclockwise" in text
    assert "`warp=True`" in text
    assert "`model='scale'`" in text


def test_summary_of_a_rotation_to_the_right_has_no_sign() -> None:
    text = summary_text(alignment(model="affine", corrected=rotated(-0.3)))
    assert "turned 0.3000° clockwise" in text


def test_summary_of_what_was_resampled_or_has_control_points_recommends_neither() -> None:
    turned = alignment(model="affine", corrected=rotated(0.3))
    assert "`warp=True`" not in summary_text(turned, WriteOptions(warp=True))
    last = summary_text(alignment(), WriteOptions(georef="gcps")).splitlines()[-1]
    assert "control points" in last
    assert "north-up" not in last


def test_summary_of_a_raster_that_was_rotated_before() -> None:
    before, after = rotated(5.0), Affine.translation(1.0, 2.0) @ rotated(5.0)
    made = alignment(source=Grid(before, (80, 100), UTM16), model="shift", corrected=after)
    text = summary_text(made)
    assert "`warp=True`" in text
    assert "`model='scale'`" not in text


def test_summary_when_nothing_is_to_do() -> None:
    made = alignment(
        model="none",
        corrected=MS_HEADER,
        verdict=Verdict(Outcome.ALREADY_ALIGNED),
    )
    first, *_, last = summary_text(made).splitlines()
    assert first.startswith("Already aligned")
    assert last == "Next: use the raster as it is."


def test_summary_of_a_refusal_says_why_and_what_to_try() -> None:
    text = summary_text(refused())
    assert text.startswith("Refused")
    assert "0 tie points agree, 8 are needed" in text
    assert "not measured" not in text
    assert "`search_radius_px`" in text


def test_summary_without_check_points() -> None:
    made = alignment(accuracy=Accuracy(kept=3))
    assert "3 tie points; too few" in summary_text(made)


def test_summary_of_the_sample_uses_its_own_numbers() -> None:
    moved = Affine.translation(120.0, 0.0) @ SHIFTED
    text = summary_text(alignment(model="shift", corrected=moved))
    assert "63.0 px right" in text
