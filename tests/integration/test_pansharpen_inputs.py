"""What can be sharpened from Python: files, and what is in none; everything else is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rioxarray
import xarray
from affine import Affine
from numpy.typing import NDArray

import geodelreg
from geodelreg import Grid
from geodelreg.errors import (
    AlignmentRefusedError,
    ArrayShapeError,
    GeodelregError,
    MissingCrsError,
    RasterUnreadableError,
    UsageError,
)
from tests.cli.helpers import copy_samples

UTM = "EPSG:32618"
MS_PLACE = Affine(3, 0, 437_000.5, 0, -3, 4_176_000.25)
PAN_PLACE = Affine(1, 0, 437_000, 0, -1, 4_176_000)


def noise(*shape: int, kind: str = "uint16") -> NDArray[Any]:
    return np.random.default_rng(3).integers(1000, 4000, shape).astype(kind)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for name, data, place in (
        ("ms.tif", noise(3, 30, 40), MS_PLACE),
        ("pan.tif", noise(1, 90, 120), PAN_PLACE),
    ):
        count, height, width = data.shape
        shape = {"driver": "GTiff", "count": count, "height": height, "width": width}
        with rasterio.open(
            tmp_path / name, "w", dtype="uint16", crs=UTM, transform=place, nodata=0, **shape
        ) as dataset:
            dataset.write(data)
    return tmp_path


def sharpened(ms: Any, pan: Any, folder: Path, **knobs: Any) -> NDArray[Any]:
    out = folder / "sharp.tif"
    geodelreg.pansharpen(ms, pan, out, overwrite=True, **knobs)
    with rasterio.open(out) as dataset:
        return np.concatenate([dataset.read(), dataset.read_masks(1)[None]])


def as_arrays(path: Path) -> Any:
    with rasterio.open(path) as dataset:
        data = np.ma.masked_equal(dataset.read(), 0)
        return data, Grid(dataset.transform, dataset.shape, UTM)


def as_variables(path: Path) -> xarray.Dataset:
    return rioxarray.open_rasterio(path, chunks=16, band_as_variable=True)  # type: ignore[return-value]


@pytest.mark.parametrize(
    "way",
    [
        rasterio.open,
        as_arrays,
        as_variables,
        lambda path: rioxarray.open_rasterio(path, chunks=16),
        lambda path: rioxarray.open_rasterio(path, masked=True),
    ],
    ids=["dataset", "arrays", "variables", "dask", "floats"],
)
def test_whatever_holds_the_pixels_gives_the_same(files: Path, way: Callable[[Path], Any]) -> None:
    before = sorted(path.name for path in files.iterdir())
    knobs = {"weights": "0.2,0.3,0.5", "resampling": "bilinear"}
    expected = sharpened(files / "ms.tif", files / "pan.tif", files, **knobs)
    got = sharpened(way(files / "ms.tif"), way(files / "pan.tif"), files, **knobs)
    assert np.array_equal(got[-1], expected[-1])
    inside = expected[-1] > 0
    rounded = 3.0 if got.dtype.kind == "f" else 0.0  # half a value of MS, times PAN over the sum
    assert np.abs(got[:-1] - expected[:-1].astype(float))[:, inside].max() <= rounded
    assert sorted(path.name for path in files.iterdir()) == [*before, "sharp.tif"]


def broken(block: NDArray[Any]) -> NDArray[Any]:
    raise OSError("the store is gone")


def without_crs(files: Path) -> Any:
    rows, columns = np.arange(30.0)[::-1], np.arange(40.0)
    return xarray.DataArray(noise(30, 40), coords={"y": rows, "x": columns}, dims=("y", "x"))


def failing(files: Path) -> Any:
    whole = rioxarray.open_rasterio(files / "ms.tif", chunks=16)
    return whole.copy(data=whole.data.map_blocks(broken, dtype="uint16"))  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("ms", "kind", "words"),
    [
        (without_crs, MissingCrsError, "rio.write_crs"),
        (failing, RasterUnreadableError, "the store is gone"),
        (
            lambda files: (noise(30, 41), Grid(MS_PLACE, (30, 40), UTM)),
            ArrayShapeError,
            r"\(30, 41\).*30 rows of 40",
        ),
        (
            lambda files: (noise(30, 40), Grid(MS_PLACE.to_gdal(), (30, 40), UTM)),
            TypeError,
            "no Affine",
        ),
        (
            lambda files: (noise(30, 40), Grid(MS_PLACE, (30, 40), "")),
            MissingCrsError,
            "EPSG",
        ),
        (lambda files: 7, TypeError, "int is no raster"),
        (lambda files: np.zeros((3, 30, 40)), TypeError, "ndarray is no raster"),
        (lambda files: [files / "ms.tif", None], TypeError, "NoneType is no raster"),
        (lambda files: (noise(30, 40, kind="complex64"), Grid(MS_PLACE, (30, 40), UTM)),
         GeodelregError, "complex"),
        (lambda files: [], UsageError, "no raster"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_and_nothing_written(
    files: Path, ms: Callable[[Path], Any], kind: type[Exception], words: str
) -> None:
    before = sorted(files.iterdir())
    with pytest.raises(kind, match=words):
        geodelreg.pansharpen(ms(files), files / "pan.tif", files / "sharp.tif")
    assert sorted(files.iterdir()) == before


@pytest.mark.parametrize(
    "knobs",
    [
        {"weights": [0.5, 0.3, 0.2]},
        {"weights": (1, 1, 1)},
        {"bands": [3, 2, 1], "weights": np.array([0.5, 0.3, 0.2])},
    ],
)
def test_weights_and_bands_may_be_numbers(files: Path, knobs: dict[str, Any]) -> None:
    typed = {name: ",".join(map(str, values)) for name, values in knobs.items()}
    pair = files / "ms.tif", files / "pan.tif"
    assert np.array_equal(sharpened(*pair, files, **knobs), sharpened(*pair, files, **typed))


@pytest.mark.parametrize(
    ("knobs", "kind", "words"),
    [
        ({"weights": [0.5, 0.5]}, UsageError, "are 2, and 3 bands"),
        ({"weights": ["a"]}, UsageError, "are no weights"),
        ({"weights": None}, TypeError, "weights=None"),
        ({"bands": [0]}, UsageError, "are no bands"),
        ({"bands": "²"}, UsageError, "are no bands"),
        ({"bands": 3}, TypeError, "bands=3"),
        ({"bit_depth": "12"}, TypeError, "bit_depth='12'"),
        ({"bit_depth": 1.5}, TypeError, "no whole number"),
        ({"creation_options": "COMPRESS=ZSTD"}, TypeError, "no sequence of KEY=VALUE"),
        ({"creation_options": {"COMPRESS": "ZSTD"}}, TypeError, "no sequence of KEY=VALUE"),
        ({"creation_options": [1]}, UsageError, "creation option 1"),
        ({"alignment": "report.json"}, TypeError, "str is no Alignment"),
        ({"allow": "moon"}, UsageError, "allow='moon'"),
        ({"target": "-"}, UsageError, "standard output"),
        ({"nodata": "0"}, TypeError, "nodata='0'"),
        ({"nodata": -1.0}, UsageError, r"nodata=-1\.0.*uint16"),
        ({"resampling": "best"}, UsageError, "resampling='best'"),
        ({"pan_band": 2}, GeodelregError, "band 2"),
    ],
)
def test_options_that_mean_nothing(
    files: Path, knobs: dict[str, Any], kind: type[Exception], words: str
) -> None:
    before = sorted(files.iterdir())
    given = {"target": files / "sharp.tif"} | knobs
    with pytest.raises(kind, match=words):
        geodelreg.pansharpen(files / "ms.tif", files / "pan.tif", **given)
    assert sorted(files.iterdir()) == before


def test_a_lazy_raster_names_files_and_no_arrays(files: Path) -> None:
    with pytest.raises(UsageError, match="is no file that it could name"):
        geodelreg.pansharpen(as_arrays(files / "ms.tif"), files / "pan.tif", files / "sharp.vrt")
    assert not (files / "sharp.vrt").exists()


def test_an_alignment_of_other_rasters_is_refused(files: Path, tmp_path: Path) -> None:
    pair = tmp_path / "pair"
    pair.mkdir()
    copy_samples(pair)
    alignment = geodelreg.align(pair / "ms.tif", pair / "pan.tif")
    with pytest.raises(UsageError, match=r"the alignment is of .*ms\.tif"):
        geodelreg.pansharpen(
            files / "ms.tif", files / "pan.tif", files / "sharp.tif", alignment=alignment
        )
    geodelreg.write_in_place(alignment)
    with pytest.raises(UsageError, match="leave the alignment out"):
        geodelreg.pansharpen(
            pair / "ms.tif", pair / "pan.tif", files / "sharp.tif", alignment=alignment
        )


def test_a_refused_alignment_is_refused_again(files: Path) -> None:
    with pytest.raises(AlignmentRefusedError) as caught:
        geodelreg.align(files / "ms.tif", files / "pan.tif")
    with pytest.raises(AlignmentRefusedError, match="there is no correction"):
        geodelreg.pansharpen(
            files / "ms.tif",
            files / "pan.tif",
            files / "sharp.tif",
            alignment=caught.value.alignment,
        )
    assert not (files / "sharp.tif").exists()
