"""`check` against known displacements: of the header, of single bands, of parts of the image."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray

import geodelreg
from geodelreg.errors import UsageError
from geodelreg.fine.layers import many_elsewhere
from geodelreg.judge.check import is_affine_enough, judge_misalignment
from geodelreg.judge.words import local_distortion
from geodelreg.product.check import check_dict, check_text
from geodelreg.product.report import report_schema
from geodelreg.report.words import advice
from geodelreg.values.points import Status, TiePoints
from geodelreg.values.raster import FloatArray
from geodelreg.values.result import CheckOutcome, Misalignment
from tests.cli.helpers import SAMPLES

TRUTH = json.loads((SAMPLES / "truth.json").read_text(encoding="utf-8"))
PAN = SAMPLES / "pan.tif"
TRUE = Affine(*TRUTH["ms_true"])
PAN_PX_PER_MS_PX = 4.0

Pixels = NDArray[np.uint16]
WriteMs = Callable[..., Path]


def unchanged(bands: Pixels) -> Pixels:
    return bands


@pytest.fixture
def write_ms(tmp_path: Path) -> WriteMs:
    """``write_ms(change, transform)``: the sample MS with changed pixels, by default in place."""

    def write(
        change: Callable[[Pixels], Pixels] = unchanged, transform: Affine = TRUE, name: str = "ms"
    ) -> Path:
        with rasterio.open(SAMPLES / "ms.tif") as dataset:
            profile, bands = dataset.profile | {"transform": transform}, dataset.read()
        path = tmp_path / f"{name}.tif"
        with rasterio.open(path, "w", **profile) as dataset:
            dataset.write(change(bands))
        return path

    return write


def largest_displacement_px(header: Affine) -> float:
    """PAN pixels from a header's to the true place of the MS corners inside PAN, at most."""
    height, width = TRUTH["ms_shape"]
    pan = Affine(*TRUTH["pan"])
    corners = [(0, 0), (width, 0), (0, height), (width, height)]
    return max(
        float(np.hypot(*np.subtract(~pan @ (TRUE @ at), ~pan @ (header @ at)))) for at in corners
    )


@pytest.mark.parametrize("shift_m", [(7.1, -2.0), (-3.0, 6.0)])
def test_the_largest_displacement_is_measured_with_its_error(
    write_ms: WriteMs, shift_m: tuple[float, float]
) -> None:
    header = Affine.translation(*shift_m) @ TRUE @ Affine.scale(1.0002, 1.0)
    found = geodelreg.check(write_ms(transform=header), PAN)
    off = found.misalignment
    assert found.outcome is CheckOutcome.MISALIGNED
    assert off.distance_px == pytest.approx(largest_displacement_px(header), abs=0.1)
    assert off.distance_m == pytest.approx(10 * off.distance_px)
    assert 0 < off.sigma_px < 0.05
    assert found.affine_enough
    assert found.reason == ""


def test_the_tolerance_decides(write_ms: WriteMs) -> None:
    path = write_ms(transform=Affine.translation(7.1, 0.0) @ TRUE)
    assert geodelreg.check(path, PAN, limit_px=0.5).outcome is CheckOutcome.MISALIGNED
    loose = geodelreg.check(path, PAN, limit_px=0.9)
    assert loose.outcome is CheckOutcome.ALIGNED
    assert "aligned, off by at most 0.7" in check_text(loose)


def test_a_tolerance_below_the_standard_error_is_not_decided(write_ms: WriteMs) -> None:
    path = write_ms()
    exact = geodelreg.align(path, PAN, geodelreg.AlignOptions(tolerance_px=0.0))
    corrected = exact.correction.corrected
    found = geodelreg.check(write_ms(transform=corrected, name="exact"), PAN, limit_px=0.001)
    assert found.outcome is CheckOutcome.CANNOT_TELL
    assert "standard error" in found.reason
    assert "`limit_px`" in found.remedy
    assert "`search_radius_px`" not in found.remedy
    assert "would move" not in check_text(found)
    assert "larger tolerance" in advice(found.alignment, found)


def test_a_band_that_is_shifted_is_named(write_ms: WriteMs) -> None:
    def shift_third_and_blank_fourth(bands: Pixels) -> Pixels:
        bands[2] = np.roll(bands[2], 2, axis=1)
        bands[3] = 7
        return bands

    seen: list[float] = []
    found = geodelreg.check(
        write_ms(shift_third_and_blank_fourth),
        PAN,
        limit_px=1.0,
        per_band=True,
        progress=lambda fraction, _: seen.append(fraction),
    )
    assert seen == sorted(seen)
    assert 0.6 < seen[-1] <= 1.0
    assert found.bands is not None
    outcomes = [band.outcome.value for band in found.bands]
    assert outcomes == ["aligned", "aligned", "misaligned", "cannot_tell"]
    assert found.raster_outcome is CheckOutcome.CANNOT_TELL  # no one place is right for all bands
    assert found.outcome is CheckOutcome.MISALIGNED
    third, fourth = found.bands[2:]
    assert third.shift_px[0] == pytest.approx(-2 * PAN_PX_PER_MS_PX, abs=0.5)
    assert third.shift_px[1] == pytest.approx(0, abs=0.5)
    assert 0 < third.sigma_px < 0.2
    assert "too little tells where it lies" in fourth.reason
    assert np.isnan(fourth.shift_px).all()
    jsonschema.validate(check_dict(found), report_schema())


def points_of_relief(amplitude_px: float = 1.2, elsewhere_px: float = 3.0) -> TiePoints:
    """600 tie points that agree on a wave, and 300 that lie elsewhere."""
    rng = np.random.default_rng(0)
    source: FloatArray = rng.uniform(0, 1000, (900, 2))
    residual: FloatArray = rng.normal(0, 0.05, (900, 2))
    residual[:, 0] += amplitude_px * np.sin(2 * np.pi * source[:, 1] / 1000)
    residual[600:] = elsewhere_px
    status = np.where(np.arange(900) < 600, Status.KEPT, Status.RESIDUAL).astype(np.uint8)
    covariance = np.tile(np.eye(2), (900, 1, 1))
    return TiePoints(source, source, covariance, np.ones(900), status, residual)


def test_distortion_counts_although_many_lie_elsewhere() -> None:
    points = points_of_relief()
    off = Misalignment(0.1, 1.0, 0.05, local_distortion(points))
    assert off.local_px == pytest.approx(1.2 / np.sqrt(2), rel=0.15)
    assert judge_misalignment(off, 0.5) is CheckOutcome.MISALIGNED
    assert is_affine_enough(off, 0.5, points) is False


def test_many_elsewhere_leave_open_whether_an_affine_is_enough() -> None:
    points, near = points_of_relief(0.0), points_of_relief(0.0, elsewhere_px=0.1)
    flat = Misalignment(0.1, 1.0, 0.05, local_distortion(points))
    assert many_elsewhere(points)
    assert is_affine_enough(flat, 0.5, points) is None
    assert not many_elsewhere(near)
    assert is_affine_enough(flat, 0.5, near) is True


@pytest.mark.parametrize("amplitude_ms_px", [0.15, 0.5])
def test_a_bent_image_never_passes_for_aligned(write_ms: WriteMs, amplitude_ms_px: float) -> None:
    def bend(bands: Pixels) -> Pixels:
        rows, columns = np.indices(bands.shape[1:], dtype=np.float32)
        wave = np.sin(2 * np.pi * rows / 100).astype(np.float32)
        moved = columns + np.float32(amplitude_ms_px) * wave
        return np.stack([cv2.remap(band, moved, rows, cv2.INTER_CUBIC) for band in bands])

    found = geodelreg.check(write_ms(bend), PAN, limit_px=0.2)
    assert found.outcome is not CheckOutcome.ALIGNED
    assert found.affine_enough is not True
    assert "One affine is enough" not in check_text(found)


def test_distortion_that_is_left_is_said_and_counts(write_ms: WriteMs) -> None:
    found = geodelreg.check(write_ms(), PAN)
    assert "One affine is enough" in check_text(found)
    off = replace(found.misalignment, local_px=0.8)
    bent = replace(
        found,
        misalignment=off,
        raster_outcome=judge_misalignment(off, found.limit_px),
        affine_enough=is_affine_enough(off, found.limit_px, found.alignment.tie_points),
    )
    assert bent.outcome is CheckOutcome.MISALIGNED
    assert bent.reason == "0.800 PAN px RMS of local distortion"
    assert "One affine is not enough: it leaves 0.800 PAN px RMS" in check_text(bent)
    assert check_dict(bent)["check"]["affine_enough"] is False
    assert is_affine_enough(off, 2.0, found.alignment.tie_points) is False
    bent_less = replace(off, local_px=0.25)
    assert is_affine_enough(bent_less, 0.2, found.alignment.tie_points) is False


def test_the_tolerance_of_align_hides_nothing(write_ms: WriteMs) -> None:
    path = write_ms(transform=Affine.translation(9.0, 0.0) @ TRUE)
    found = geodelreg.check(path, PAN, geodelreg.AlignOptions(tolerance_px=100.0))
    assert found.misalignment.distance_px == pytest.approx(0.9, abs=0.1)


def test_unknown_without_evidence() -> None:
    assert judge_misalignment(Misalignment(), 0.5) is CheckOutcome.CANNOT_TELL
    assert is_affine_enough(Misalignment(), 0.5, points_of_relief()) is None


@pytest.mark.parametrize(
    ("distance", "sigma", "local", "outcome"),
    [
        (0.49, 0.01, 0.0, "aligned"),
        (0.52, 0.01, 0.0, "aligned"),
        (0.54, 0.01, 0.0, "misaligned"),
        (0.54, 0.01, float("nan"), "misaligned"),
        (0.10, 0.16, float("nan"), "aligned"),
        (0.10, 0.17, 0.0, "cannot_tell"),
        (2.00, 0.17, 0.0, "misaligned"),
        (0.10, 0.01, 0.6, "misaligned"),
    ],
)
def test_more_than_the_tolerance_by_three_standard_errors(
    distance: float, sigma: float, local: float, outcome: str
) -> None:
    off = Misalignment(distance, 10 * distance, sigma, local)
    assert judge_misalignment(off, 0.5) is CheckOutcome(outcome)


@pytest.mark.parametrize("limit_px", [-0.1, float("nan"), float("inf")])
def test_an_impossible_tolerance_is_wrong_usage(limit_px: float) -> None:
    with pytest.raises(UsageError, match="limit_px"):
        geodelreg.check(SAMPLES / "ms.tif", PAN, limit_px=limit_px)
