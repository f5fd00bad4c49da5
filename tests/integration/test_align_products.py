"""What is made of an alignment: files that other software puts where they belong."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.transform import from_gcps
from rasterio.vrt import WarpedVRT
from scipy.spatial import KDTree

import geodelreg
from benchmarks.accuracy.measure import MeasureOptions, measure_offsets, read_raster
from benchmarks.scenes.truth import Truth
from geodelreg import Alignment, AlignOptions, WriteOptions
from geodelreg.errors import AlignmentRefusedError, OutputIsInputError
from geodelreg.product.gcps import read_gcps
from geodelreg.values.points import Status
from geodelreg.values.result import Outcome
from tests.integration.align_scenes import SAMPLE, Recipe, Scene, about, centred, make_scene, write

TURNED = Recipe(
    centred(4, 130), (130, 130), about(Affine.translation(1.3, -0.8) @ Affine.rotation(12), 130)
)
MEASURE = MeasureOptions(window_px=40, stride_px=30, search_px=2.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample pair, and nothing else."""
    made = tmp_path_factory.mktemp("sample")
    for name in ("ms.tif", "pan.tif"):
        shutil.copy(SAMPLE / name, made / name)
    return made


@pytest.fixture(scope="module")
def sample(folder: Path) -> Scene:
    return Scene(folder / "ms.tif", folder / "pan.tif", Truth.load(SAMPLE / "truth.json"))


@pytest.fixture(scope="module")
def aligned(sample: Scene) -> Alignment:
    return geodelreg.align(sample.ms, sample.pan)


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Alignment]:
    """A scene whose correction rotates."""
    scene = make_scene(tmp_path_factory.mktemp("turned"), TURNED)
    return scene, geodelreg.align(scene.ms, scene.pan)


def transform_of(path: Path) -> Affine:
    with rasterio.open(path) as dataset:
        return dataset.transform


def distance_px(ms: Path, pan: Path) -> float:
    """Of two files, by a measurement that shares nothing with the library."""
    found = measure_offsets(read_raster(ms), read_raster(pan), MEASURE)
    assert len(found.score) >= 8
    return found.distance_px


def test_the_written_raster_lies_on_pan(sample: Scene, aligned: Alignment, tmp_path: Path) -> None:
    out = tmp_path / "out.tif"
    assert geodelreg.write(aligned, out) == []
    assert sample.rmse_px(transform_of(out)) < 0.02
    assert distance_px(sample.ms, sample.pan) > 5
    assert distance_px(out, sample.pan) < 0.05
    with rasterio.open(sample.ms) as ms, rasterio.open(out) as corrected:
        assert np.array_equal(ms.read(), corrected.read())
        assert "GEODELREG_VERSION" in corrected.tags()


def test_an_aligned_raster_is_copied_with_its_header(
    sample: Scene, aligned: Alignment, tmp_path: Path
) -> None:
    first, second = tmp_path / "first.tif", tmp_path / "second.tif"
    geodelreg.write(aligned, first)
    again = geodelreg.align(first, sample.pan)
    assert again.verdict.outcome is Outcome.ALREADY_ALIGNED
    assert again.correction.model == "none"
    geodelreg.write(again, second)
    assert transform_of(second) == transform_of(first)
    before = first.read_bytes()
    assert geodelreg.write_in_place(again) == []
    assert first.read_bytes() == before


def test_in_place_and_back(sample: Scene, aligned: Alignment, tmp_path: Path) -> None:
    copy = shutil.copy(sample.ms, tmp_path / "ms.tif")
    before = copy.read_bytes()
    geodelreg.write_in_place(replace(aligned, source=replace(aligned.source, paths=(str(copy),))))
    assert sample.rmse_px(transform_of(copy)) < 0.02
    geodelreg.revert(copy)
    assert copy.read_bytes() == before


def test_a_rotation_is_written_as_it_is(turned: tuple[Scene, Alignment], tmp_path: Path) -> None:
    scene, alignment = turned
    geodelreg.write(alignment, tmp_path / "out.tif")
    assert transform_of(tmp_path / "out.tif").b != 0
    assert scene.rmse_px(transform_of(tmp_path / "out.tif")) < 0.03


@pytest.mark.parametrize("grid", ["ms", "pan"])
def test_warped_rasters_lie_north_up_on_pan(
    turned: tuple[Scene, Alignment], tmp_path: Path, grid: str
) -> None:
    scene, alignment = turned
    out = tmp_path / "out.tif"
    geodelreg.write(alignment, out, WriteOptions(warp=True, warp_grid=grid))
    transform = transform_of(out)
    assert transform.b == transform.d == 0.0
    if grid == "pan":
        assert transform == Affine(*scene.truth.pan)
        warped = decimated(out, tmp_path / "coarse.tif")
    else:
        assert abs(transform.a) == pytest.approx(40, rel=0.02)
        warped = out
    assert distance_px(warped, scene.pan) < 0.1


def decimated(path: Path, out: Path) -> Path:
    """The raster averaged to a quarter, as MS pixels are."""
    with rasterio.open(path) as dataset:
        data, mask = dataset.read(masked=True).filled(0), dataset.dataset_mask() > 0
        transform, crs = dataset.transform, dataset.crs.to_wkt()
    count, height, width = data.shape
    shape = (height // 4, 4, width // 4, 4)
    full = mask.reshape(shape).all(axis=(1, 3))
    coarse = data.reshape(count, *shape).mean(axis=(2, 4)) * full
    return write(out, coarse.astype(np.float32), transform @ Affine.scale(4), crs, 0)


def test_gcps_place_the_raster(sample: Scene, aligned: Alignment, tmp_path: Path) -> None:
    """GDAL's own fit through the exported points lies where the correction puts it."""
    geodelreg.export_gcps(aligned, tmp_path / "ms.tif.vrt", "vrt")
    with rasterio.open(tmp_path / "ms.tif.vrt") as vrt:
        assert sample.rmse_px(from_gcps(vrt.gcps[0])) < 0.05
    geodelreg.export_gcps(aligned, tmp_path / "ms.geojson")
    kept = int((aligned.tie_points.status == Status.KEPT).sum())
    points, _ = read_gcps(tmp_path / "ms.geojson")
    assert len(points) == kept == aligned.accuracy.kept


def test_several_files_share_the_ground_not_the_pixels(
    sample: Scene, aligned: Alignment, tmp_path: Path
) -> None:
    with rasterio.open(sample.ms) as ms:
        bands, header, crs = ms.read(), ms.transform, ms.crs.to_wkt()
    files = [write(tmp_path / f"B{n}.tif", band[None], header, crs) for n, band in enumerate(bands)]
    coarse = bands[:1].reshape(1, 100, 2, 100, 2).mean(axis=(2, 4))
    files.append(write(tmp_path / "B9.tif", coarse, header @ Affine.scale(2), crs))
    alignment = geodelreg.align(files, sample.pan)
    geodelreg.write(alignment, tmp_path / "out")
    corrected = [transform_of(tmp_path / "out" / path.name) for path in files]
    assert len(set(corrected[:4])) == 1
    assert sample.rmse_px(corrected[0]) < 0.02
    assert corrected[4].almost_equals(corrected[0] @ Affine.scale(2), 1e-9)
    with rasterio.open(tmp_path / "out" / "B9.tif") as other:
        assert np.array_equal(other.read(), coarse.astype(other.dtypes[0]))


def test_gdal_pansharpens_the_default_output(
    sample: Scene, aligned: Alignment, tmp_path: Path
) -> None:
    """VRTPansharpenedDataset takes MS and PAN by their geotransforms, and refuses rotated ones."""
    geodelreg.write(aligned, tmp_path / "out.tif")
    bands = "".join(
        f'<SpectralBand dstBand="{n}"><SourceFilename>{tmp_path / "out.tif"}</SourceFilename>'
        f"<SourceBand>{n}</SourceBand></SpectralBand>"
        for n in (1, 2, 3)
    )
    vrt = (
        '<VRTDataset subClass="VRTPansharpenedDataset"><PansharpeningOptions>'
        "<SpatialExtentAdjustment>Intersection</SpatialExtentAdjustment>"
        f"<PanchroBand><SourceFilename>{sample.pan}</SourceFilename>"
        f"<SourceBand>1</SourceBand></PanchroBand>{bands}"
        "</PansharpeningOptions></VRTDataset>"
    )
    (tmp_path / "sharp.vrt").write_text(vrt, encoding="utf-8")
    with rasterio.open(tmp_path / "sharp.vrt") as sharp, rasterio.open(sample.pan) as pan:
        assert sharp.count == 3
        assert sharp.res == pan.res
        data = sharp.read()
        with WarpedVRT(pan, transform=sharp.transform, width=sharp.width, height=sharp.height,
                       crs=sharp.crs) as same:  # fmt: skip
            detail = same.read(1)
    inner = (slice(100, -100), slice(100, -100))
    assert np.corrcoef(data[1][inner].ravel(), detail[inner].ravel())[0, 1] > 0.95


def test_gdalinfo_sees_the_corrected_corner(
    sample: Scene, aligned: Alignment, tmp_path: Path
) -> None:
    if shutil.which("gdalinfo") is None:
        pytest.skip("gdalinfo is not installed")
    geodelreg.write(aligned, tmp_path / "out.tif")
    seen = subprocess.run(["gdalinfo", tmp_path / "out.tif"], capture_output=True, text=True,
                          check=True)  # fmt: skip
    origin = next(line for line in seen.stdout.splitlines() if line.startswith("Origin"))
    x, y = (float(value) for value in origin.split("(")[1].rstrip(")").split(","))
    true = Affine(*sample.truth.ms_true)
    assert (x, y) == pytest.approx((true.c, true.f), abs=0.5)


def judged(scene: Scene, method: str) -> Alignment:
    """The alignment, refused or right."""
    try:
        found = geodelreg.align(scene.ms, scene.pan, AlignOptions(method=method))
    except AlignmentRefusedError as refused:
        return alignment_of(refused)
    assert scene.rmse_px(found.correction.corrected) < 1.0
    return found


def alignment_of(refused: AlignmentRefusedError) -> Alignment:
    assert refused.alignment is not None
    assert not refused.alignment.verdict.accepted
    return refused.alignment


@pytest.mark.parametrize("method", ["zhang2013", "sift"])
def test_the_papers_methods_run_and_are_judged(sample: Scene, method: str) -> None:
    """Their points only get fewer, and what is written is right."""
    found = judged(sample, method)
    counts = list(found.solution.step_counts.items())
    assert [name for name, _ in counts[:2]] == ["keypoints MS", "keypoints PAN"]
    points = [number for _, number in counts[2:]]
    assert points == sorted(points, reverse=True)
    assert points[0] == counts[0][1]
    assert points[-1] == found.tie_points.kept.sum() > 100
    assert found.correction.model in ("affine", "none")


def test_the_papers_methods_start_from_lowes_keypoints(tmp_path: Path) -> None:
    """All that his threshold leaves, wherever they lie, at the resolution of the coarser raster."""
    scene = make_scene(tmp_path, Recipe(centred(1, 400), (400, 400)))
    with rasterio.open(scene.pan) as raster:
        pan = raster.read(1).astype(np.float32)
    low, high = np.percentile(pan, (0.5, 99.5))
    grey = np.rint(np.clip((pan - low) * (255 / (high - low)), 0, 255)).astype(np.uint8)
    # OpenCV's documentation: Lowe's 0.03 is 0.09 here
    sift = cv2.SIFT.create(contrastThreshold=0.09, enable_precise_upscale=True)
    places = np.array([point.pt for point in sift.detect(grey, None)]) + 0.5
    found = judged(scene, "sift")
    assert found.solution.step_counts["keypoints PAN"] == len(places) > 1000
    assert KDTree(places).query(found.tie_points.reference_px)[0].max() < 1e-3


def test_the_papers_fit_is_plain_least_squares_of_its_points(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, Recipe(centred(4, 130), (130, 130)))
    found = geodelreg.align(scene.ms, scene.pan, AlignOptions(method="zhang2013"))
    points, header = found.tie_points, Affine(*scene.truth.ms_header)
    source = points.source_px[points.kept]
    x, y = ~header @ Affine(*scene.truth.pan) @ tuple(points.reference_px[points.kept].T)
    rows = np.column_stack([source, np.ones(len(source))])
    across, down = np.linalg.lstsq(rows, np.column_stack([x, y]), rcond=None)[0].T
    expected = header @ Affine(*across, *down)
    assert np.allclose(found.correction.corrected[:6], expected[:6], rtol=0, atol=1e-5)


def test_the_papers_filter_beats_plain_sift(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, Recipe(centred(4, 130), (130, 130)))
    found = geodelreg.align(scene.ms, scene.pan, AlignOptions(method="zhang2013"))
    assert found.verdict.outcome is Outcome.ALIGNED
    assert scene.rmse_px(found.correction.corrected) < 0.3
    with pytest.raises(AlignmentRefusedError) as refused:
        geodelreg.align(scene.ms, scene.pan, AlignOptions(method="sift"))
    assert len(alignment_of(refused.value).tie_points) == len(found.tie_points)


def test_an_input_is_not_an_output(sample: Scene, aligned: Alignment) -> None:
    before = sample.ms.read_bytes()
    with pytest.raises(OutputIsInputError):
        geodelreg.write(aligned, sample.ms, WriteOptions(overwrite=True))
    assert sample.ms.read_bytes() == before


def test_nothing_is_left_beside_the_inputs(folder: Path, aligned: Alignment) -> None:
    assert aligned.verdict.accepted
    assert {path.name for path in folder.iterdir()} == {"ms.tif", "pan.tif"}
