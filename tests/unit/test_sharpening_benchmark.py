"""The figures of ``python -m benchmarks wald`` against examples worked by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import sewar
from numpy.typing import NDArray

from benchmarks.sharpening.quality import Quality, hyper_product, q2n, quality_of
from benchmarks.sharpening.wald import Row, matters_px

RNG = np.random.default_rng(7)


def image(bands: int, side: int = 64) -> NDArray[np.float64]:
    return RNG.uniform(50, 200, (side, side, bands))


def test_a_perfect_image_has_the_best_figures() -> None:
    reference = image(4)
    ms = reference.reshape(16, 4, 16, 4, 4).mean(axis=(1, 3))
    quality = quality_of(reference.copy(), reference, ms, reference.mean(axis=2), 4)
    assert quality.ergas == pytest.approx(0, abs=1e-9)
    assert quality.sam_deg == pytest.approx(0, abs=1e-4)
    assert (quality.scc, quality.q2n) == pytest.approx((1, 1), abs=1e-9)


def test_ergas_of_a_constant_error() -> None:
    reference = np.full((32, 32, 2), 100.0)
    reference[..., 1] = 400.0
    wrong = reference + 5.0
    expected = 100 / 4 * math.sqrt(((5 / 100) ** 2 + (5 / 400) ** 2) / 2)
    quality = quality_of(wrong, reference, reference[::4, ::4], reference[..., 0], 4)
    assert quality.ergas == pytest.approx(expected, rel=1e-9)


def test_sam_of_known_angles() -> None:
    one = np.tile([1.0, 0.0, 0.0], (2, 2, 1))
    other = np.tile([1.0, 1.0, 0.0], (2, 2, 1))
    other[0, 0] = [0.0, 0.0, 3.0]
    assert np.degrees(sewar.sam(one, other)) == pytest.approx((90 + 3 * 45) / 4)


def hamilton(a: Any, b: Any) -> NDArray[np.float64]:
    """Quaternions multiplied term by term."""
    (a0, a1, a2, a3), (b0, b1, b2, b3) = a, b
    return np.array(
        [
            a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
            a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
            a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
            a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
        ]
    )


def test_hypercomplex_numbers_are_quaternions_and_octonions() -> None:
    for _ in range(20):
        a, b = RNG.normal(size=(2, 4))
        assert hyper_product(a, b) == pytest.approx(hamilton(a, b))
        c, d = RNG.normal(size=(2, 8))
        lengths = np.linalg.norm(c) * np.linalg.norm(d)
        assert np.linalg.norm(hyper_product(c, d)) == pytest.approx(lengths)


def test_q2n_of_one_band_is_the_universal_quality_index() -> None:
    one, other = image(1, 32), image(1, 32)
    other = 0.7 * one + 0.3 * other + 10
    x, y = one.ravel(), other.ravel()
    covariance = np.cov(x, y, bias=True)
    expected = (
        4 * covariance[0, 1] * x.mean() * y.mean()
        / ((covariance[0, 0] + covariance[1, 1]) * (x.mean() ** 2 + y.mean() ** 2))
    )  # fmt: skip
    assert q2n(one, other) == pytest.approx(expected)


def test_q2n_of_four_bands_is_that_of_quaternions() -> None:
    one, other = image(4, 32), image(4, 32)
    x, y = one.reshape(-1, 4), other.reshape(-1, 4)
    turned = y * [1, -1, -1, -1]
    mean = np.mean([hamilton(*pair) for pair in zip(x, turned, strict=True)], axis=0)
    covariance = mean - hamilton(x.mean(axis=0), turned.mean(axis=0))
    spread = x.var(axis=0).sum() + y.var(axis=0).sum()
    lengths = [np.linalg.norm(v.mean(axis=0)) for v in (x, y)]
    expected = 4 * np.linalg.norm(covariance) * lengths[0] * lengths[1]
    expected /= spread * (lengths[0] ** 2 + lengths[1] ** 2)
    assert q2n(one, other) == pytest.approx(expected)


def test_where_it_begins_to_matter_lies_between_the_errors_measured() -> None:
    rows = [
        Row("", True, 2, error, "", 0.0, Quality(ergas, 0, 0, 0, 0), Quality(1, 0, 0, 0, 0))
        for error, ergas in ((0.0, 2.0), (0.5, 2.04), (1.0, 2.16))
    ]
    assert matters_px(rows) == pytest.approx(0.75)
    assert matters_px(rows[:2]) == math.inf
