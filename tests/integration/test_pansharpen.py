"""Sharpened rasters: every pixel where it belongs, and GDAL's Brovey to the last digit."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray

import geodelreg
from benchmarks.sharpening.ramps import measure
from geodelreg import PansharpenOptions
from geodelreg.errors import NoOverlapError, OutputIsInputError, UsageError
from geodelreg.geotiff.atomic import together

SAMPLES = Path(__file__).resolve().parents[2] / "sample_tiles"
UTM = "EPSG:32618"
ORIGIN = (437_000.0, 4_176_000.0)
SUM = 4000.0


def write(path: Path, data: NDArray[Any], transform: Affine, **profile: Any) -> Path:
    count, height, width = data.shape
    shape = {"count": count, "height": height, "width": width, "dtype": data.dtype}
    placed = {"crs": UTM, "transform": transform, "driver": "GTiff"}
    with rasterio.open(path, "w", **(shape | placed | profile)) as dataset:
        dataset.write(data)
    return path


def ramps(folder: Path, ratio: int, offset_px: tuple[float, float], side: int = 30) -> Path:
    """MS whose bands are the PAN column and row of the place they show, and SUM minus those."""
    pixel = float(ratio)
    east, south = (float(ORIGIN[0] + offset_px[0]), float(ORIGIN[1] - offset_px[1]))
    transform = Affine(pixel, 0, east, 0, -pixel, south)
    columns, rows = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    x = columns * ratio + offset_px[0] + 1000
    y = rows * ratio + offset_px[1] + 1000
    bands = np.stack([x, SUM - x, y, SUM - y]).astype(np.float32)
    return write(folder / "ms.tif", bands, transform)


def flat_pan(folder: Path, width: int, height: int) -> Path:
    """PAN of 1 m, so bright that sharpening with equal weights leaves the bands as they are."""
    data = np.full((1, height, width), SUM / 2, dtype=np.float32)
    return write(folder / "pan.tif", data, Affine(1, 0, ORIGIN[0], 0, -1, ORIGIN[1]))


@pytest.mark.parametrize("ratio", [2, 3, 4])
@pytest.mark.parametrize("offset", [-5.75, -0.25, 8.0])
def test_every_pixel_lies_where_ms_says_and_is_broveys(
    tmp_path: Path, ratio: int, offset: float
) -> None:
    """`python -m benchmarks ramps` has all offsets."""
    found = measure(tmp_path, ratio, offset)
    assert found.is_good, found
    with rasterio.open(tmp_path / "sharp.tif") as sharp, rasterio.open(tmp_path / "pan.tif") as pan:
        assert (sharp.transform, sharp.shape) == (pan.transform, pan.shape)


def brovey(
    bands: NDArray[Any], pan: NDArray[Any], weights: list[float], top: int
) -> NDArray[np.float64]:
    """Every band times PAN over the weighted sum, in double precision."""
    wide = bands.astype(np.float64)
    pseudo = np.einsum("b,bhw->hw", np.array(weights), wide)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(pseudo > 0, pan / pseudo, 0.0)
    return np.clip(wide * ratio, 0, top)


@pytest.fixture
def aligned(tmp_path: Path) -> Path:
    """The sample's MS where it really lies."""
    alignment = geodelreg.align(SAMPLES / "ms.tif", SAMPLES / "pan.tif")
    geodelreg.write(alignment, tmp_path / "aligned.tif")
    return tmp_path / "aligned.tif"


def test_values_are_those_of_a_plain_weighted_brovey(tmp_path: Path, aligned: Path) -> None:
    weights = [0.1, 0.3, 0.4, 0.2]
    text = ",".join(map(str, weights))
    pan, out, wide = SAMPLES / "pan.tif", tmp_path / "sharp.tif", tmp_path / "wide.tif"
    geodelreg.pansharpen(aligned, pan, out, PansharpenOptions(weights=text))
    with rasterio.open(pan) as dataset:
        grid = (dataset.transform, dataset.width, dataset.height, dataset.crs)
        values = dataset.read(1).astype(np.float64)
    with (
        rasterio.open(aligned) as dataset,
        rasterio.vrt.WarpedVRT(
            dataset,
            transform=grid[0],
            width=grid[1],
            height=grid[2],
            crs=grid[3],
            resampling=rasterio.enums.Resampling.cubic,
            tolerance=1e-3,
            add_alpha=True,
        ) as warped,
    ):
        bands = warped.read([1, 2, 3, 4])
    expected = brovey(bands, values, weights, 65535)
    with rasterio.open(out) as dataset:
        assert np.abs(dataset.read() - expected).max() <= 0.5 + 1e-3
    assert not wide.exists()


def test_blocks_are_the_whole_and_vrt_is_the_tiff(tmp_path: Path) -> None:
    alignment = geodelreg.align(SAMPLES / "ms.tif", SAMPLES / "pan.tif")
    outs = [tmp_path / "sharp.tif", tmp_path / "sharp.vrt"]
    for out in outs:
        geodelreg.pansharpen(SAMPLES / "ms.tif", SAMPLES / "pan.tif", out, alignment=alignment)
    with rasterio.open(outs[0]) as tiff, rasterio.open(outs[1]) as vrt:
        whole = vrt.read()
        assert np.array_equal(tiff.read(), whole)
        assert np.array_equal(tiff.dataset_mask() > 0, vrt.dataset_mask() > 0)
        rng = np.random.default_rng(1)
        for _ in range(20):
            row, column = (int(v) for v in rng.integers(0, 700, 2))
            window = ((row, row + 97), (column, column + 61))
            assert np.array_equal(
                vrt.read(window=window), whole[:, row : row + 97, column : column + 61]
            )


def test_a_vrt_can_move_with_its_sources(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    ramps(here, 3, (0.5, 0.25))
    flat_pan(here, 90, 90)
    geodelreg.pansharpen(here / "ms.tif", here / "pan.tif", here / "sharp & <more>.vrt")
    with rasterio.open(here / "sharp & <more>.vrt") as dataset:
        before = dataset.read()
    here.rename(there)
    with rasterio.open(there / "sharp & <more>.vrt") as dataset:
        assert np.array_equal(dataset.read(), before, equal_nan=True)


def test_no_data_and_cover(tmp_path: Path) -> None:
    bands = np.full((2, 20, 20), 100, dtype=np.uint16)
    bands[1, 5, 5] = 0
    ms = write(tmp_path / "ms.tif", bands, Affine(2, 0, ORIGIN[0], 0, -2, ORIGIN[1]), nodata=0)
    pan = write(
        tmp_path / "pan.tif",
        np.full((1, 50, 60), 90, dtype=np.uint16),
        Affine(1, 0, ORIGIN[0] - 10, 0, -1, ORIGIN[1] + 4),
    )
    out = tmp_path / "sharp.tif"
    geodelreg.pansharpen(ms, pan, out, PansharpenOptions(resampling="nearest", weights="equal"))
    with rasterio.open(out) as dataset:
        assert (dataset.nodata, dataset.dtypes[0], dataset.shape) == (0, "uint16", (50, 60))
        data = dataset.read()
    valid = np.zeros((50, 60), dtype=bool)
    valid[4:44, 10:50] = True
    valid[14:16, 20:22] = False
    assert ((data == 90).all(axis=0) == valid).all()
    assert (data[:, ~valid] == 0).all()
    geodelreg.pansharpen(
        ms, pan, out, PansharpenOptions(extent="intersection", overwrite=True, nodata=7)
    )
    with rasterio.open(out) as dataset:
        assert (dataset.nodata, dataset.shape) == (7, (40, 40))
        assert dataset.transform == Affine(1, 0, ORIGIN[0], 0, -1, ORIGIN[1])


def test_a_mask_tells_what_is_not_covered_when_there_is_no_no_data_value(tmp_path: Path) -> None:
    ms, pan = ramps(tmp_path, 2, (3.0, 5.0), side=10), flat_pan(tmp_path, 40, 40)
    for name in ("sharp.tif", "sharp.vrt"):
        geodelreg.pansharpen(ms, pan, tmp_path / name)
        with rasterio.open(tmp_path / name) as dataset:
            mask = dataset.dataset_mask() > 0
            assert dataset.nodata is None
        assert mask[5:25, 3:23].all()
        assert mask.sum() == 400


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_the_mask_is_that_of_any_number_of_bands(tmp_path: Path, count: int) -> None:
    """GDAL makes masks of an alpha band beside one or three bands, and of no other number."""
    bands = np.full((count, 20, 20), 100, dtype=np.uint16)
    ms = write(tmp_path / "ms.tif", bands, Affine(2, 0, ORIGIN[0], 0, -2, ORIGIN[1]))
    place = Affine(1, 0, ORIGIN[0] - 10, 0, -1, ORIGIN[1] + 10)
    pan = write(tmp_path / "pan.tif", np.full((1, 60, 60), 90, dtype=np.uint16), place)
    for name in ("sharp.tif", "sharp.vrt"):
        geodelreg.pansharpen(ms, pan, tmp_path / name, weights="equal")
        with rasterio.open(tmp_path / name) as dataset:
            mask = dataset.dataset_mask() > 0
        assert mask[10:50, 10:50].all()
        assert mask.sum() == 1600


def test_pan_that_is_not_everywhere_hides_what_it_does_not_show(tmp_path: Path) -> None:
    ms = ramps(tmp_path, 2, (0.0, 0.0), side=20)
    data = np.full((1, 40, 40), 500, dtype=np.uint16)
    data[0, :, :7] = 0
    pan = write(tmp_path / "pan.tif", data, Affine(1, 0, ORIGIN[0], 0, -1, ORIGIN[1]), nodata=0)
    for name in ("sharp.tif", "sharp.vrt"):
        geodelreg.pansharpen(ms, pan, tmp_path / name)
        with rasterio.open(tmp_path / name) as dataset:
            mask = dataset.dataset_mask() > 0
        assert not mask[:, :7].any()
        assert mask[:, 7:].all()


def test_files_of_single_bands_in_other_places(tmp_path: Path) -> None:
    paths = []
    with rasterio.open(SAMPLES / "ms.tif") as dataset:
        for band in (1, 2, 3):
            path = tmp_path / f"B{band}.tif"
            write(path, dataset.read([band]), dataset.transform, crs=dataset.crs)
            paths.append(path)
    out = tmp_path / "sharp.tif"
    one = tmp_path / "one.tif"
    pan = SAMPLES / "pan.tif"
    geodelreg.pansharpen(paths, pan, out, PansharpenOptions(weights="1,2,1", bands="3,2,1"))
    geodelreg.pansharpen(
        SAMPLES / "ms.tif", pan, one, PansharpenOptions(weights="1,2,1", bands="3,2,1")
    )
    with rasterio.open(out) as many, rasterio.open(one) as single:
        assert np.array_equal(many.read(), single.read())
        assert many.descriptions == ("B3", "B2", "B1")


def test_fitted_weights_keep_the_brightness_of_ms(tmp_path: Path, aligned: Path) -> None:
    out = tmp_path / "sharp.tif"
    geodelreg.pansharpen(aligned, SAMPLES / "pan.tif", out)
    with rasterio.open(out) as sharp, rasterio.open(aligned) as ms:
        before, after = ms.read().mean(axis=(1, 2)), sharp.read().mean(axis=(1, 2))
    assert after == pytest.approx(before, rel=0.02)


def test_a_cog_has_overviews_and_the_same_pixels(tmp_path: Path) -> None:
    ms, pan = ramps(tmp_path, 2, (0.0, 0.0), side=400), flat_pan(tmp_path, 800, 800)
    told: list[tuple[float, str]] = []
    for name, driver in (("plain.tif", "GTiff"), ("cog.tif", "COG")):
        geodelreg.pansharpen(
            ms, pan, tmp_path / name, driver=driver, progress=lambda *step: told.append(step)
        )
        assert told[-1][0] == 1.0
    assert [fraction for fraction, _ in told[1:]] == sorted(f for f, _ in told[1:])
    with rasterio.open(tmp_path / "plain.tif") as plain, rasterio.open(tmp_path / "cog.tif") as cog:
        assert cog.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert cog.overviews(1)
        assert np.array_equal(cog.read(), plain.read(), equal_nan=True)


def test_bit_depth_clips(tmp_path: Path) -> None:
    transform = Affine(2, 0, ORIGIN[0], 0, -2, ORIGIN[1])
    ms = write(tmp_path / "ms.tif", np.full((1, 10, 10), 4000, dtype=np.uint16), transform)
    pan = write(
        tmp_path / "pan.tif",
        np.full((1, 20, 20), 9000, dtype=np.uint16),
        Affine(1, 0, ORIGIN[0], 0, -1, ORIGIN[1]),
    )
    options = PansharpenOptions(weights="1", bit_depth=12)
    geodelreg.pansharpen(ms, pan, tmp_path / "sharp.tif", options)
    with rasterio.open(tmp_path / "sharp.tif") as dataset:
        assert dataset.read().max() == 4095


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"weights": "1,2"}, "4 bands are sharpened"),
        ({"bands": "1,9"}, "4 bands of MS"),
        ({"driver": "PNG"}, "no format of sharpened rasters"),
        ({"driver": "VRT", "nodata": 0.0}, "a VRT has none"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_written(
    tmp_path: Path, options: dict[str, Any], word: str
) -> None:
    ms, pan = ramps(tmp_path, 2, (0.0, 0.0)), flat_pan(tmp_path, 60, 60)
    with pytest.raises(UsageError, match=word):
        geodelreg.pansharpen(ms, pan, tmp_path / "sharp.tif", PansharpenOptions(**options))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ms.tif", "pan.tif"]


def test_pan_must_be_the_finer_one(tmp_path: Path) -> None:
    ms, pan = ramps(tmp_path, 2, (0.0, 0.0)), flat_pan(tmp_path, 60, 60)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(UsageError, match=r"PAN \(ms.tif, 2 m\) are larger .* MS \(pan.tif, 1 m\)"):
        geodelreg.pansharpen(pan, ms, tmp_path / "sharp.tif")
    assert sorted(tmp_path.iterdir()) == before


def test_inputs_stay_and_ground_must_be_shared(tmp_path: Path) -> None:
    ms, pan = ramps(tmp_path, 2, (0.0, 0.0)), flat_pan(tmp_path, 60, 60)
    with pytest.raises(OutputIsInputError):
        geodelreg.pansharpen(ms, pan, pan, PansharpenOptions(overwrite=True))
    far = ramps(tmp_path, 2, (500.0, 0.0))
    with pytest.raises(NoOverlapError, match="share no ground"):
        geodelreg.pansharpen(
            far, pan, tmp_path / "sharp.tif", PansharpenOptions(extent="intersection")
        )


@pytest.mark.parametrize("name", ["part.tif", "part.tif.ovr", "ms.vrt.msk", "pan.tif.aux.xml"])
def test_whatever_the_inputs_consist_of_stays(tmp_path: Path, name: str) -> None:
    pan = flat_pan(tmp_path, 60, 60)
    ramps(tmp_path, 2, (0.0, 0.0)).rename(tmp_path / "part.tif")
    rasterio.shutil.copy(tmp_path / "part.tif", tmp_path / "ms.vrt", driver="VRT")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    options = PansharpenOptions(overwrite=True, driver="GTiff")
    with pytest.raises(OutputIsInputError):
        geodelreg.pansharpen(tmp_path / "ms.vrt", pan, tmp_path / name, options)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_virtual_raster_beside_the_output_that_is_an_input_stays(tmp_path: Path) -> None:
    ms, pan = ramps(tmp_path, 2, (0.0, 0.0)), flat_pan(tmp_path, 60, 60)
    geodelreg.pansharpen(ms, pan, tmp_path / "one.vrt")
    part = (tmp_path / "one.vrt.ms1.vrt").read_bytes()
    options = PansharpenOptions(overwrite=True)
    with pytest.raises(OutputIsInputError):
        geodelreg.pansharpen(tmp_path / "one.vrt.ms1.vrt", pan, tmp_path / "one.vrt", options)
    assert (tmp_path / "one.vrt.ms1.vrt").read_bytes() == part


def test_two_sharpened_rasters_appear_together_or_not_at_all(tmp_path: Path) -> None:
    ms, pan = ramps(tmp_path, 2, (0.0, 0.0)), flat_pan(tmp_path, 60, 60)
    with ExitStack() as stack:
        stack.enter_context(pytest.raises(UsageError))
        stack.enter_context(together())
        geodelreg.pansharpen(ms, pan, tmp_path / "sharp.tif")
        geodelreg.pansharpen(ms, pan, tmp_path / "more.tif", PansharpenOptions(bands="9"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ms.tif", "pan.tif"]


def test_a_lazy_raster_asks_for_no_number_of_threads(tmp_path: Path) -> None:
    ms, pan = ramps(tmp_path, 2, (0.0, 0.0)), flat_pan(tmp_path, 60, 60)
    geodelreg.pansharpen(ms, pan, tmp_path / "sharp.vrt")
    for vrt in tmp_path.glob("*.vrt"):
        text = vrt.read_text()
        assert "NumThreads" not in text
        assert "NUM_THREADS" not in text
