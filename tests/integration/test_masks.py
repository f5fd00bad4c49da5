"""Masks through the reader: the pixels they hide, against independent geometry."""

from __future__ import annotations

import json
import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from rasterio.enums import Resampling
from shapely.geometry import mapping

from geodelreg.errors import MaskError, MissingExtraError
from geodelreg.raster import mask_raster, mask_vector
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import BoolArray, Window
from tests.conftest import TRANSFORM, UTM16, WriteRaster

UTM17 = "EPSG:32617"
SIDE = 60


def land(shape: tuple[int, int] = (SIDE, SIDE), bands: int = 2) -> NDArray[np.uint16]:
    return np.random.default_rng(1).integers(100, 900, (bands, *shape)).astype(np.uint16)


def hidden(image: Path, *masks: object, window: Window | None = None) -> BoolArray:
    """What the reader leaves out of an image that is otherwise valid everywhere."""
    with open_raster(image, [str(mask) for mask in masks]) as reader:
        height, width = reader.grid.shape
        band, *others = reader.read([1, 2], window or Window(0, 0, width, height))
    assert all(np.array_equal(band.valid, other.valid) for other in others)
    assert (band.data[~band.valid] == 0).all()
    return ~band.valid


def footprint(
    transform: Affine, column: int, row: int, via: Transformer | None = None
) -> shapely.Polygon:
    """Polygon of a pixel on the ground of another CRS, its edges densified."""
    ring = [(column, row), (column + 1, row), (column + 1, row + 1), (column, row + 1)]
    side = np.hypot(transform.a, transform.d)
    polygon = shapely.segmentize(shapely.Polygon([transform @ at for at in ring]), side / 4)
    if via is None:
        return polygon
    return shapely.transform(polygon, lambda xy: np.stack(via.transform(*xy.T), axis=1))


def expected(
    image: Path, shape: shapely.Geometry, via: Transformer | None = None, least: float = 1e-6
) -> BoolArray:
    """Pixels of which a geometry covers more than a trace, one by one."""
    with rasterio.open(image) as dataset:
        height, width, transform = dataset.height, dataset.width, dataset.transform
    pixels = [[footprint(transform, c, r, via) for c in range(width)] for r in range(height)]
    areas = shapely.area(shapely.intersection(np.array(pixels, dtype=object), shape))
    return np.asarray(areas > least)


def ground_of(mask: Path, values: set[int]) -> shapely.Geometry:
    """Union of the mask's pixels with some values."""
    with rasterio.open(mask) as dataset:
        stored, transform = dataset.read(1), dataset.transform
    rows, columns = np.nonzero(np.isin(stored, list(values)))
    return shapely.union_all(
        [footprint(transform, c, r) for c, r in zip(columns.tolist(), rows.tolist(), strict=True)]
    )


def geojson(path: Path, *shapes: shapely.Geometry, crs: str | None = None) -> Path:
    features: list[dict[str, Any]] = [
        {"type": "Feature", "properties": {}, "geometry": mapping(shape)} for shape in shapes
    ]
    document: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    if crs is not None:
        document["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def spots(shape: tuple[int, int], seed: int = 3, share: float = 0.04) -> NDArray[np.uint8]:
    return (np.random.default_rng(seed).random(shape) < share).astype(np.uint8)


# --- rasters -------------------------------------------------------------------------------------


def test_on_the_same_grid_a_mask_hides_its_own_pixels(write_raster: WriteRaster) -> None:
    image, values = write_raster("ms.tif", land()), spots((SIDE, SIDE))
    mask = write_raster("mask.tif", values)
    assert np.array_equal(hidden(image, mask), values > 0)
    window = Window(7, 11, 31, 23)
    assert np.array_equal(hidden(image, mask, window=window), values[11:34, 7:38] > 0)


GRIDS = {
    "coarser, same extent": (TRANSFORM @ Affine.scale(2), (30, 30)),
    "coarser, uneven": (TRANSFORM @ Affine.scale(3.5), (18, 18)),
    "finer": (TRANSFORM @ Affine.scale(0.25), (240, 240)),
    "finer, uneven": (TRANSFORM @ Affine.scale(0.4, 0.7), (86, 150)),
    "half a pixel off": (TRANSFORM @ Affine.translation(-0.5, -0.5), (61, 61)),
    "a thousandth of a pixel off": (TRANSFORM @ Affine.translation(-4e-4, 4e-4), (61, 61)),
    "larger": (TRANSFORM @ Affine.translation(-20, -31), (140, 130)),
    "partly beside": (TRANSFORM @ Affine.translation(25, 35), (80, 80)),
    "south-up": (TRANSFORM @ Affine.translation(0, 60) @ Affine.scale(1, -1), (60, 60)),
}


@pytest.mark.parametrize("name", GRIDS)
def test_on_another_grid_every_touched_pixel_is_hidden(
    write_raster: WriteRaster, name: str
) -> None:
    transform, shape = GRIDS[name]
    image = write_raster("ms.tif", land())
    mask = write_raster("mask.tif", spots(shape, share=0.02), transform=transform)
    # a sliver of a thousandth of a pixel is rounding
    oracle = expected(image, ground_of(mask, {1}), least=900 * 2e-3)
    assert 0 < oracle.sum() < oracle.size
    assert np.array_equal(hidden(image, mask), oracle)


@pytest.mark.parametrize("angle", [0.0, 20.0])
def test_in_another_crs_the_mask_lies_where_pyproj_says(
    write_raster: WriteRaster, angle: float
) -> None:
    image = write_raster("ms.tif", land())
    there = Transformer.from_crs(UTM16, UTM17, always_xy=True)
    x, y = there.transform(*(TRANSFORM @ (-20, -25)))
    transform = Affine.translation(x, y) @ Affine.rotation(angle) @ Affine.scale(75, -75)
    mask = write_raster("mask.tif", spots((70, 70)), transform=transform, crs=UTM17)
    # a sliver of a thousandth of a mask pixel, 0.1 m² here, is rounding
    oracle = expected(image, ground_of(mask, {1}), there, least=0.1)
    found = hidden(image, mask)
    assert 0 < oracle.sum() < oracle.size
    # the box around a turned pixel may touch a little more, never less
    assert not (oracle & ~found).any()
    assert (found & ~oracle).mean() < 0.06


def test_lookups_between_nodes_are_as_good_as_exact_ones(
    write_raster: WriteRaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = write_raster("ms.tif", land((300, 280)))
    there = Transformer.from_crs(UTM16, UTM17, always_xy=True)
    x, y = there.transform(*(TRANSFORM @ (-20, -25)))
    transform = Affine.translation(x, y) @ Affine.scale(20, -20)
    mask = write_raster("mask.tif", spots((700, 700)), transform=transform, crs=UTM17)
    between = hidden(image, mask)
    monkeypatch.setattr(mask_raster, "_NODE_STEP_PX", 1)
    assert (between ^ hidden(image, mask)).mean() < 1e-4


def test_blocks_of_a_large_window_join_without_a_seam(
    write_raster: WriteRaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = write_raster("ms.tif", land())
    mask = write_raster(
        "mask.tif", spots((240, 240), share=0.01), transform=TRANSFORM @ Affine.scale(0.25)
    )
    whole = hidden(image, mask)
    monkeypatch.setattr(mask_raster, "_MASK_BLOCK_PX", 100.0)
    assert np.array_equal(hidden(image, mask), whole)


def test_averages_leave_hidden_pixels_out(write_raster: WriteRaster) -> None:
    data = land((64, 64))
    values = np.zeros((64, 64), dtype=np.uint8)
    values[:32, ::4] = 1  # a quarter of each cell
    values[40:, 40:] = 1
    data[:, values > 0] = 60_000
    image, mask = write_raster("ms.tif", data), write_raster("mask.tif", values)
    with open_raster(image, [str(mask)]) as reader:
        band = reader.read([1], Window(0, 0, 64, 64), (16, 16))[0]
    seen = np.ma.array(data[0].astype(float), mask=values > 0).reshape(16, 4, 16, 4)
    assert np.array_equal(band.valid, seen.count(axis=(1, 3)) >= 8)
    mean = seen.mean(axis=(1, 3)).filled(0)
    assert np.allclose(band.data[band.valid], mean[band.valid], rtol=1e-5)


def test_overviews_are_masked_where_their_pixels_lie(
    write_raster: WriteRaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = land((512, 512), 1)
    image = write_raster("ms.tif", data)
    with rasterio.open(image, "r+") as dataset:
        dataset.build_overviews([2, 4], Resampling.average)
    values = np.zeros((512, 512), dtype=np.uint8)
    values[64:192, 256:320] = 1
    mask = write_raster("mask.tif", values)
    monkeypatch.setattr("geodelreg.raster.reader._EXACT_PIXELS", 1000)
    with open_raster(image, [str(mask)]) as reader:
        band = reader.read([1], Window(0, 0, 512, 512), (64, 64))[0]
    assert np.array_equal(~band.valid, values[::8, ::8] > 0)


def test_values_and_kinds_are_chosen_by_what_follows_the_name(write_raster: WriteRaster) -> None:
    values = np.tile(np.arange(12, dtype=np.uint8), (SIDE, 5))
    image = write_raster("ms.tif", land())
    mask = write_raster("classes.tif", values, nodata=7)
    assert np.array_equal(hidden(image, mask), (values != 0) & (values != 7))
    assert np.array_equal(hidden(image, f"{mask}=0"), values == 0)
    assert np.array_equal(hidden(image, f"{mask}=3,8-10"), np.isin(values, [3, 8, 9, 10]))
    assert np.array_equal(
        hidden(image, f"{mask}=sentinel2-scl"), np.isin(values, [0, 1, 3, 7, 8, 9, 10])
    )


def test_several_masks_hide_what_any_of_them_hides(write_raster: WriteRaster) -> None:
    image = write_raster("ms.tif", land())
    one, other = spots((SIDE, SIDE), 5), spots((SIDE, SIDE), 6)
    with open_raster(
        image, [str(write_raster("a.tif", one)), str(write_raster("b.tif", other))]
    ) as reader:
        band = reader.read([1], Window(0, 0, SIDE, SIDE))[0]
        reader.read([1], Window(0, 0, 5, 5))  # later reads are not counted
        assert reader.masks is not None
        uses, total = reader.masks.uses("source"), reader.masks.hidden_share
    assert np.array_equal(~band.valid, (one | other) > 0)
    assert [use.hidden_share for use in uses] == pytest.approx([one.mean(), other.mean()])
    assert total == pytest.approx((one | other).mean())


def test_a_mask_without_a_place_lies_on_an_image_of_its_size(
    write_raster: WriteRaster, tmp_path: Path
) -> None:
    image, values = write_raster("ms.tif", land()), spots((SIDE, SIDE)) * 255
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(
            tmp_path / "mask.png", "w", "PNG", SIDE, SIDE, 1, dtype=np.uint8
        ) as dataset:
            dataset.write(values, 1)
    assert np.array_equal(hidden(image, tmp_path / "mask.png"), values > 0)
    unprojected = write_raster("mask.tif", values, crs=None)
    assert np.array_equal(hidden(image, unprojected), values > 0)


# --- quality bands -------------------------------------------------------------------------------


def test_quality_files_are_known_by_their_names(write_raster: WriteRaster) -> None:
    image = write_raster("ms.tif", land())
    values = np.full((SIDE, SIDE), 21824, dtype=np.uint16)
    values[:10], values[10:20], values[20:30], values[30:40] = 22280, 23888, 30048, 21888
    qa = write_raster("LC08_L2SP_016035_20210608_20210615_02_T1_QA_PIXEL.TIF", values, nodata=1)
    assert np.array_equal(hidden(image, qa), np.isin(values, [22280, 23888]))
    classes = np.repeat(np.arange(12, dtype=np.uint8), 5)[:30, None] * np.ones(30, dtype=np.uint8)
    scl = write_raster(
        "T16PEU_20210608_SCL_20m.tif", classes, transform=TRANSFORM @ Affine.scale(2)
    )
    assert np.array_equal(
        hidden(image, scl), np.isin(classes, [0, 1, 3]).repeat(2, axis=0).repeat(2, axis=1)
    )
    with open_raster(image, [str(qa), str(scl)]) as reader:
        assert reader.masks is not None
        kinds = [use.kind for use in reader.masks.uses("source")]
    assert kinds == ["landsat-qa", "sentinel2-scl"]


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_a_quality_band_in_the_image_is_a_mask_and_no_image(
    write_raster: WriteRaster, dtype: type
) -> None:
    planes = np.concatenate([land(), np.full((1, SIDE, SIDE), 21824, dtype=np.uint16)])
    planes[2, :20] = 22280
    planes = planes[[0, 2, 1]].astype(dtype)
    image = write_raster("ms.tif", planes, descriptions=("SR_B2", "QA_PIXEL", "SR_B3"))
    with open_raster(image, ()) as reader:
        assert reader.band_names == ("SR_B2", "SR_B3")
        assert reader.masks is not None
        assert [(use.band, use.kind) for use in reader.masks.uses("source")] == [(2, "landsat-qa")]
        bands = reader.read([1, 2], Window(0, 0, SIDE, SIDE))
    for band, plane in zip(bands, planes[[0, 2]], strict=True):
        assert np.array_equal(~band.valid, planes[1] == 22280)
        assert np.array_equal(band.data[20:], plane[20:])
    with open_raster(image) as reader:
        assert reader.masks is None


def test_a_quality_file_among_the_band_files_masks_them(write_raster: WriteRaster) -> None:
    classes = np.full((30, 30), 4, dtype=np.uint8)
    classes[5:9] = 9
    paths = [
        write_raster("B02.tif", land(bands=1)),
        write_raster("B03.tif", land(bands=1)),
        write_raster("SCL_20m.tif", classes, transform=TRANSFORM @ Affine.scale(2)),
    ]
    with open_raster(paths, ()) as reader:
        assert reader.band_names == ("B02", "B03")
        assert reader.other_paths == (str(paths[2]),)
        bands = reader.read([1, 2], Window(0, 0, SIDE, SIDE))
    for band in bands:
        assert np.flatnonzero((~band.valid).all(axis=1)).tolist() == list(range(10, 18))


def test_a_quality_band_alone_is_an_image(write_raster: WriteRaster) -> None:
    path = write_raster("SCL.tif", np.full((30, 30), 9, dtype=np.uint8))
    with open_raster(path, ()) as reader:
        assert reader.band_names == ("band 1",)
        assert reader.masks is None
        assert reader.read([1], Window(0, 0, 30, 30))[0].valid.all()


def test_the_named_band_of_a_file_of_many_is_the_mask(write_raster: WriteRaster) -> None:
    image = write_raster("ms.tif", land())
    classes = np.full((SIDE, SIDE), 4, dtype=np.uint16)
    classes[:7] = 8
    stack = write_raster("l2a.tif", np.stack([land()[0], classes]), descriptions=("B02", "SCL"))
    assert np.array_equal(hidden(image, stack), classes == 8)


# --- vectors -------------------------------------------------------------------------------------

LAKE = shapely.Polygon(
    [(500_222, 1_399_888), (501_003, 1_399_630), (500_900, 1_398_900), (500_310, 1_399_100)],
    [[(500_500, 1_399_500), (500_700, 1_399_500), (500_600, 1_399_300)]],
)
ON_THE_LINES = shapely.box(500_030, 1_399_040, 500_150, 1_399_100)


@pytest.mark.parametrize("crs", ["EPSG:32616", "urn:ogc:def:crs:EPSG::32616"])
@pytest.mark.parametrize("shape", [LAKE, ON_THE_LINES], ids=["lake", "on the pixels' lines"])
def test_a_polygon_hides_every_pixel_that_it_touches(
    write_raster: WriteRaster, tmp_path: Path, shape: shapely.Polygon, crs: str
) -> None:
    image = write_raster("ms.tif", land())
    mask = geojson(tmp_path / "lakes.geojson", shape, crs=crs)
    oracle = expected(image, shape)
    assert np.array_equal(hidden(image, mask), oracle)
    window = Window(5, 9, 33, 28)
    assert np.array_equal(hidden(image, mask, window=window), oracle[9:37, 5:38])


def test_geojson_is_in_wgs84_and_straight_lines_are_straight_there(
    write_raster: WriteRaster, tmp_path: Path
) -> None:
    image = write_raster("ms.tif", land(), transform=TRANSFORM @ Affine.scale(100))
    via = Transformer.from_crs(UTM16, "OGC:CRS84", always_xy=True)
    corners = [
        TRANSFORM @ (100 * c, 100 * r) for c, r in ((3.3, 4.2), (58.4, 6.1), (50, 9.6), (5.5, 40.3))
    ]
    shape = shapely.Polygon(np.stack(via.transform(*np.transpose(corners)), axis=1))
    mask = geojson(tmp_path / "lakes.json", shape)
    assert np.array_equal(hidden(image, mask), expected(image, shape, via, least=1e-9))


@pytest.mark.parametrize("angle", [30.0, -130.0])
def test_a_turned_image_is_masked_in_its_own_pixels(
    write_raster: WriteRaster, tmp_path: Path, angle: float
) -> None:
    middle = Affine.translation(30, 30)
    turned = TRANSFORM @ middle @ Affine.rotation(angle) @ ~middle
    image = write_raster("ms.tif", land(), transform=turned)
    mask = geojson(tmp_path / "lakes.geojson", LAKE, crs="EPSG:32616")
    assert np.array_equal(hidden(image, mask), expected(image, LAKE))


def test_the_whole_world_but_an_island_can_be_a_mask(
    write_raster: WriteRaster, tmp_path: Path
) -> None:
    image = write_raster("ms.tif", land())
    via = Transformer.from_crs(UTM16, "OGC:CRS84", always_xy=True)
    island = shapely.transform(
        shapely.segmentize(LAKE, 60.0), lambda xy: np.stack(via.transform(*xy.T), axis=1)
    )
    sea = shapely.box(-180, -90, 180, 90) - island
    mask = geojson(tmp_path / "sea.geojson", sea)
    assert np.array_equal(hidden(image, mask), expected(image, sea, via, least=1e-13))


def test_averages_and_decimated_windows_are_masked_by_vectors_too(
    write_raster: WriteRaster, tmp_path: Path
) -> None:
    image = write_raster("ms.tif", land())
    mask = geojson(tmp_path / "box.geojson", shapely.box(500_300, 1_399_100, 500_900, 1_399_700),
                   crs="EPSG:32616")  # fmt: skip
    with open_raster(image, [str(mask)]) as reader:
        band = reader.read([1], Window(0, 0, 60, 60), (12, 12))[0]
    assert np.array_equal(np.argwhere(~band.valid).min(axis=0), [2, 2])
    assert (~band.valid).sum() == 16


FAR, NEAR = shapely.Point(500_200, 1_399_900), shapely.Point(500_100, 1_399_900)
BOXES = [
    shapely.box(500_001, 1_399_970, 500_029, 1_399_999),
    shapely.box(500_061, 1_399_911, 500_089, 1_399_929),
]
BOWTIE = shapely.Polygon(
    [(500_000, 1_400_000), (500_300, 1_399_700), (500_300, 1_400_000), (500_000, 1_399_700)]
)
SHAPES = {
    "line": (shapely.LineString([(500_015, 1_399_985), (500_015, 1_399_400)]), 20),
    "point": (NEAR, 1),
    "two polygons": (shapely.MultiPolygon(BOXES), 2),
    "collection": (shapely.GeometryCollection([NEAR, shapely.GeometryCollection([FAR])]), 2),
    "crosses itself": (BOWTIE, 60),
}


@pytest.mark.parametrize("name", SHAPES)
def test_any_geometry_hides_what_it_touches(
    write_raster: WriteRaster, tmp_path: Path, name: str
) -> None:
    shape, count = SHAPES[name]
    mask = geojson(tmp_path / "any.geojson", shape, crs="EPSG:32616")
    found = int(hidden(write_raster("ms.tif", land()), mask).sum())
    assert found == pytest.approx(count, abs=0 if name != "crosses itself" else 10)


def test_no_geometry_is_a_clear_sky(write_raster: WriteRaster, tmp_path: Path) -> None:
    image = write_raster("ms.tif", land())
    empty = geojson(tmp_path / "empty.geojson")
    document = json.loads(empty.read_text())
    document["features"] = [{"type": "Feature", "properties": {}, "geometry": None}]
    (tmp_path / "null.geojson").write_text(json.dumps(document))
    for path in (empty, tmp_path / "null.geojson"):
        with open_raster(image, [str(path)]) as reader:
            assert reader.masks is not None
            assert reader.read([1], Window(0, 0, SIDE, SIDE))[0].valid.all()
            assert reader.masks.warnings() == ()


@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".fgb", ".gml"])
def test_other_vector_formats_hide_the_same(
    write_raster: WriteRaster, tmp_path: Path, suffix: str
) -> None:
    image, path = write_raster("ms.tif", land()), tmp_path / f"lakes{suffix}"
    pyogrio.raw.write(
        path, np.array([shapely.to_wkb(LAKE)], dtype=object), [], [],
        crs="EPSG:32616", geometry_type="Polygon",
    )  # fmt: skip
    before = sorted(tmp_path.iterdir())
    assert np.array_equal(hidden(image, path), expected(image, LAKE))
    assert sorted(tmp_path.iterdir()) == before


# --- what is said --------------------------------------------------------------------------------


def test_partial_cover_and_geometries_elsewhere_are_said(
    write_raster: WriteRaster, tmp_path: Path
) -> None:
    image = write_raster("ms.tif", land())
    half = write_raster("half.tif", np.zeros((60, 30), dtype=np.uint8))
    far = geojson(tmp_path / "far.geojson", shapely.box(0, 0, 1, 1))
    with open_raster(image, [str(half), str(far)]) as reader:
        assert reader.masks is not None
        assert reader.masks.warnings() == (
            "the mask half.tif covers 50 % of ms.tif; beyond it nothing is hidden",
            "nothing in the mask far.geojson touches ms.tif",
        )


def broken_masks(write_raster: WriteRaster, folder: Path) -> dict[str, tuple[object, str, str]]:
    """Name of a mask, then what the error says of cause and remedy."""
    values, qa = spots((SIDE, SIDE)), np.full((SIDE, SIDE), 2720, dtype=np.uint16)
    (folder / "text.tif").write_text("no raster")
    (folder / "text.geojson").write_text("no JSON")
    (folder / "list.geojson").write_text("[1, 2]")
    (folder / "odd.geojson").write_text('{"type": "FeatureCollection", "features": [{}]}')
    (folder / "text.gpkg").write_text("no vector")
    pyogrio.raw.write(
        folder / "nowhere.shp", np.array([shapely.to_wkb(LAKE)], dtype=object), [], [],
        geometry_type="Polygon",
    )  # fmt: skip
    for layer in ("a", "b"):
        pyogrio.raw.write(
            folder / "two.gpkg", np.array([shapely.to_wkb(LAKE)], dtype=object), [], [],
            layer=layer, crs="EPSG:32616", geometry_type="Polygon", append=layer == "b",
        )  # fmt: skip
    degrees = geojson(folder / "degrees.geojson", LAKE)
    unknown = geojson(folder / "unknown.geojson", LAKE, crs="EPSG:999999")
    far = TRANSFORM @ Affine.translation(500, 0)
    return {
        "missing raster": (folder / "no.tif", "no.tif does not exist", "Check the path"),
        "missing vector": (folder / "no.geojson", "no.geojson does not exist", "Check the path"),
        "missing with a word": (folder / "no.tif=cloud", "does not exist", "landsat-qa"),
        "no raster": (folder / "text.tif", "text.tif is not a raster", "GeoTIFF"),
        "folder": (folder, "is a folder", "Name a raster file"),
        "elsewhere": (
            write_raster("far.tif", values, transform=far), "does not cover the image", "CRS",
        ),
        "no geotransform, other size": (
            write_raster("small.tif", values[1:], transform=Affine.identity()),
            "no geotransform, and it does not have the size", "gdal_edit.py",
        ),
        "no CRS, elsewhere": (
            write_raster("nocrs.tif", values, crs=None, transform=far),
            "no coordinate reference system, and it does not", "gdal_edit.py -a_srs",
        ),
        "a CRS without a place": (
            write_raster("site.tif", values, crs='LOCAL_CS["site",UNIT["metre",1]]'),
            "site.tif cannot be put on the image", "CRS",
        ),
        "many bands": (write_raster("rgb.tif", land()), "has 2 bands", "gdal_translate -b"),
        "Collection 1 called QA_PIXEL": (
            write_raster("x_QA_PIXEL.tif", qa), "such as 2720: it is from another", "=3,8-10",
        ),
        "Collection 1": (write_raster("x_BQA.tif", qa), "before Collection 2", "=2800,6896"),
        "pixel_qa": (write_raster("x_pixel_qa.tif", qa), "before Collection 2", "QA_PIXEL"),
        "SCL with other classes": (
            write_raster("SCL.tif", (values * 40).astype(np.uint8)), "Sentinel-2 SCL", "such as",
        ),
        "no JSON": (folder / "text.geojson", "text.geojson is not GeoJSON", "polygons"),
        "no object": (folder / "list.geojson", "list.geojson is not GeoJSON", "polygons"),
        "no features": (folder / "odd.geojson", "odd.geojson is not GeoJSON ('type')", "polygons"),
        "metres as degrees": (degrees, "coordinates up to 501003", "WGS 84"),
        "unknown CRS": (unknown, "'EPSG:999999' of the mask", "WGS 84"),
        "values of a vector": (f"{degrees}=3", "have no values", "what follows the ="),
        "no vector": (folder / "text.gpkg", "text.gpkg cannot be read", "ogrinfo"),
        "vector without CRS": (folder / "nowhere.shp", "no coordinate reference", "ogr2ogr -a_srs"),
        "two layers": (folder / "two.gpkg", "2 layers with geometries (a, b)", "ogr2ogr"),
    }  # fmt: skip


@pytest.mark.filterwarnings("ignore:'crs' was not provided", "ignore:The given matrix")
def test_masks_that_cannot_be_used_say_why_and_what_to_do(
    write_raster: WriteRaster, tmp_path: Path
) -> None:
    image = write_raster("ms.tif", land())
    for name, (mask, cause, remedy) in broken_masks(write_raster, tmp_path).items():
        with pytest.raises(MaskError) as caught:
            hidden(image, mask)
        assert "mask" in caught.value.cause, name
        assert cause in str(caught.value), name
        assert remedy in str(caught.value), name
        assert caught.value.exit_code == 1


def test_a_few_odd_values_are_forgiven(write_raster: WriteRaster) -> None:
    values = np.full((SIDE, SIDE), 21824, dtype=np.uint16)
    values[0, :5] = 2720
    assert not hidden(write_raster("ms.tif", land()), write_raster("QA_PIXEL.tif", values)).any()


def test_a_quality_band_in_the_image_with_odd_values_names_file_and_band(
    write_raster: WriteRaster,
) -> None:
    planes = np.concatenate([land(), np.full((1, SIDE, SIDE), 2720, dtype=np.uint16)])
    image = write_raster("ms.tif", planes, descriptions=("B2", "B3", "QA_PIXEL"))
    with pytest.raises(MaskError, match=r"ms\.tif \(band 3\) holds values"):
        hidden(image)


def test_a_truncated_mask_is_said_when_it_is_read(write_raster: WriteRaster) -> None:
    image = write_raster("ms.tif", land((600, 600)))
    mask = write_raster("mask.tif", spots((600, 600), share=0.5), compress="deflate")
    mask.write_bytes(mask.read_bytes()[: mask.stat().st_size // 2])
    with pytest.raises(MaskError, match=r"mask\.tif cannot be (decoded|opened)|is not a raster"):
        hidden(image, mask)


def test_formats_beyond_geojson_name_the_extra_that_is_missing(
    write_raster: WriteRaster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lakes.gpkg").touch()
    monkeypatch.setitem(__import__("sys").modules, "pyogrio", None)
    with pytest.raises(MissingExtraError, match=r"'\.\[vector\]'"):
        hidden(write_raster("ms.tif", land()), tmp_path / "lakes.gpkg")


def test_only_the_windows_needed_are_read(
    write_raster: WriteRaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = write_raster("ms.tif", land((2000, 2000)))
    mask = write_raster("mask.tif", spots((2000, 2000)))
    read: list[Window] = []
    stored = mask_raster.RasterMask._stored

    def watched(self: mask_raster.RasterMask, window: Window) -> NDArray[Any]:
        read.append(window)
        return stored(self, window)

    monkeypatch.setattr(mask_raster.RasterMask, "_stored", watched)
    hidden(image, mask, window=Window(900, 300, 50, 40))
    assert read == [Window(900, 300, 50, 40)]


def test_a_failed_mask_closes_the_image(write_raster: WriteRaster) -> None:
    image = write_raster("ms.tif", land())
    with ExitStack() as stack, pytest.raises(MaskError):
        stack.enter_context(open_raster(image, ["no.tif"]))
    image.unlink()


def test_crs84_is_longitude_and_latitude() -> None:
    assert CRS.from_user_input(mask_vector.WGS84).axis_info[0].direction == "east"
