"""A plane seen from elsewhere: the model that no header holds, from pixels to control points."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner
from numpy.typing import NDArray
from pyproj import CRS
from scipy import ndimage

import geodelreg
from geodelreg import Alignment, AlignOptions, WriteOptions
from geodelreg.errors import UsageError
from geodelreg.product.gcps import read_gcps
from geodelreg.product.report import report_dict, report_schema, summary_text
from geodelreg_cli.main import cli
from tests.integration.align_scenes import write

SIDE = 400
PLACE = Affine(4.0, 0.0, 500_000.0, 0.0, -4.0, 1_000_000.0)
TRUTH = np.array([[1.004, -0.003, 2.1], [0.002, 0.997, -3.3], [9e-6, -6e-6, 1.0]])
CORNERS = np.array([[0.0, 0.0], [SIDE, 0.0], [0.0, SIDE], [SIDE, SIDE], [SIDE / 2, SIDE / 2]])


def true_map(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """MS pixels to the pixels of PAN, on MS's header, where their content lies."""
    there = xy @ TRUTH[:, :2].T + TRUTH[:, 2]
    return np.asarray(there[:, :2] / there[:, 2:])


@dataclass(frozen=True)
class Pair:
    ms: Path
    pan: Path


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Pair:
    """PAN of smooth noise; MS looks it up through the truth, by a spline of order 5."""
    folder = tmp_path_factory.mktemp("projective")
    noise = np.random.default_rng(3).standard_normal((SIDE + 40, SIDE + 40))
    ground = ndimage.gaussian_filter(noise, 1.6)
    ground = 3000 + 1200 * ground / ground.std()
    columns, rows = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    at = true_map(np.stack([columns.ravel(), rows.ravel()], 1)) + 20 - 0.5
    seen = ndimage.map_coordinates(ground, [at[:, 1], at[:, 0]], order=5)
    crs = CRS.from_epsg(32616).to_wkt()
    ms = write(folder / "ms.tif", seen.reshape(1, SIDE, SIDE).astype(np.uint16), PLACE, crs)
    around = PLACE @ Affine.translation(-20, -20)
    return Pair(ms, write(folder / "pan.tif", ground[None].astype(np.uint16), around, crs))


@pytest.fixture(scope="module")
def found(pair: Pair) -> Alignment:
    return geodelreg.align(pair.ms, pair.pan, AlignOptions(model="projective"))


def error_px(alignment: Alignment) -> float:
    gap = alignment.solution.map.forward(CORNERS) - true_map(CORNERS)
    return float(np.hypot(*gap.T).max())


def test_a_projective_map_is_found_where_an_affine_falls_short(
    pair: Pair, found: Alignment
) -> None:
    assert found.solution.model == "projective"
    assert error_px(found) < 0.02
    affine = geodelreg.align(pair.ms, pair.pan, AlignOptions(model="affine"))
    assert error_px(affine) > 10 * error_px(found)
    sigma = found.solution.map.sigma_at(CORNERS)
    assert ((sigma > 0) & (sigma < 0.01)).all()
    assert found.accuracy.check_rmse_px < 0.7 * affine.accuracy.check_rmse_px


def test_auto_never_takes_it(pair: Pair) -> None:
    assert geodelreg.align(pair.ms, pair.pan).solution.model == "affine"


def test_the_report_tells_the_map_and_no_geotransform(found: Alignment) -> None:
    report = json.loads(json.dumps(report_dict(found)))
    jsonschema.validate(report, report_schema())
    correction = report["correction"]
    assert correction["model"] == "projective"
    assert correction["corrected_geotransform"] is None
    assert correction["pixel_map"]["kind"] == "projective"
    np.testing.assert_allclose(correction["pixel_map"]["matrix"], TRUTH, rtol=0, atol=0.03)
    assert "`export_gcps`" in summary_text(found)


def test_control_points_carry_it(found: Alignment, tmp_path: Path) -> None:
    geodelreg.export_gcps(found, tmp_path / "points.csv")
    gcps, _ = read_gcps(tmp_path / "points.csv")
    pixels = np.array([(gcp.column, gcp.row) for gcp in gcps])
    ground = np.array([(gcp.x, gcp.y) for gcp in gcps])
    expected = np.array([PLACE @ tuple(xy) for xy in true_map(pixels)])
    assert np.abs(ground - expected).max() < 4.0 * 0.2


def test_no_header_is_written(found: Alignment, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no header, can hold it") as refused:
        geodelreg.write(found, tmp_path / "out.tif")
    assert "`export_gcps`" in refused.value.remedy
    with pytest.raises(UsageError):
        geodelreg.write_in_place(found)
    assert not list(tmp_path.iterdir())


def test_it_is_resampled_to_where_the_truth_is(
    pair: Pair, found: Alignment, tmp_path: Path
) -> None:
    """Looked up by scipy through the inverse of the truth, on the grid of PAN."""
    options = WriteOptions(warp=True, warp_grid="pan", resampling="bilinear")
    geodelreg.write(found, tmp_path / "out.tif", options)
    with rasterio.open(tmp_path / "out.tif") as out, rasterio.open(pair.ms) as ms:
        got, source = out.read(1).astype(float), ms.read(1).astype(float)
    rows, columns = np.mgrid[40:400, 40:400] + 0.5
    back = np.linalg.inv(TRUTH)
    there = np.stack([columns - 20, rows - 20], axis=-1) @ back[:, :2].T + back[:, 2]
    at = there[..., :2] / there[..., 2:] - 0.5
    expected = ndimage.map_coordinates(source, [at[..., 1], at[..., 0]], order=1)
    gap = got[40:400, 40:400] - expected
    assert gap.std() < 0.01 * expected.std()


@pytest.mark.parametrize("way", [["-o", "out.tif"], ["--in-place"]])
def test_the_command_refuses_before_the_work(tmp_path: Path, way: list[str]) -> None:
    """Before it looks for the files, which do not exist."""
    run = CliRunner().invoke(cli, ["align", "no.tif", "none.tif", "--model", "projective", *way])
    assert isinstance(run.exception, UsageError | SystemExit)
    refusal = run.exception
    assert refusal.exit_code == 2 if isinstance(refusal, UsageError) else refusal.code == 2


def test_the_command_passes_it_on_as_control_points(pair: Pair, tmp_path: Path) -> None:
    points = tmp_path / "points.csv"
    command = ["align", str(pair.ms), str(pair.pan), "--model", "projective", "--dry-run"]
    run = CliRunner().invoke(cli, [*command, "--gcps", str(points), "--quiet"])
    assert run.exit_code == 0, run.output
    assert len(read_gcps(points)[0]) > 50
