"""The sample pair is what its README says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

from benchmarks.accuracy.measure import MeasureOptions, measure_offsets, read_raster
from benchmarks.scenes.truth import Truth, grid_rmse

SAMPLE = Path(__file__).parents[2] / "sample_tiles"
SIZE_LIMIT_BYTES = 3_000_000


def test_files_are_small() -> None:
    assert sum(p.stat().st_size for p in SAMPLE.rglob("*") if p.is_file()) < SIZE_LIMIT_BYTES


@pytest.mark.parametrize(("name", "count", "side"), [("ms.tif", 4, 200), ("pan.tif", 1, 800)])
def test_rasters_are_as_described(name: str, count: int, side: int) -> None:
    truth = Truth.load(SAMPLE / "truth.json")
    with rasterio.open(SAMPLE / name) as raster:
        assert (raster.count, raster.shape) == (count, (side, side))
        assert set(raster.dtypes) == {"uint16"}
        assert raster.crs.to_epsg() == 32618
        assert raster.profile["compress"] == "deflate"
        assert raster.profile["tiled"]
        assert raster.read().max() <= 4095
        header = truth.ms_header if name == "ms.tif" else truth.pan
        assert tuple(raster.transform)[:6] == header


def test_header_differs_from_the_truth_by_shift_and_scale() -> None:
    truth = Truth.load(SAMPLE / "truth.json")
    error = Affine(*truth.ms_true) @ ~Affine(*truth.ms_header)
    assert (error.a, error.b, error.d, error.e) == pytest.approx((1.0008, 0.0, 0.0, 0.9993))
    centre = np.array(Affine(*truth.ms_true) @ (100, 100)) - Affine(*truth.ms_header) @ (100, 100)
    # PAN pixels, rows counted downwards.
    assert centre / (10.0, -10.0) == pytest.approx((7.36, -4.62), abs=1e-6)
    assert 8.5 < grid_rmse(Affine(*truth.ms_header), truth)["rmse_px"] < 9.0


def test_images_agree_under_the_true_geotransform_only() -> None:
    truth = Truth.load(SAMPLE / "truth.json")
    pan, ms = read_raster(SAMPLE / "pan.tif"), read_raster(SAMPLE / "ms.tif")
    options = MeasureOptions(window_px=40, stride_px=32)
    wrong = measure_offsets(ms, pan, options)
    assert wrong.median_px == pytest.approx((-7.36, 4.62), abs=0.25)
    true = type(ms)(ms.data, ms.valid, Affine(*truth.ms_true), ms.crs_wkt)
    found = measure_offsets(true, pan, options)
    assert len(found.score) >= 20
    assert found.distance_px < 0.03
