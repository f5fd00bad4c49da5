"""Rasters that are no files: open datasets, arrays with grids, DataArrays; and what comes back."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
import rioxarray
import xarray
from affine import Affine
from rasterio.io import MemoryFile
from rasterio.vrt import WarpedVRT

import geodelreg
from geodelreg import AlignOptions, Grid, PansharpenOptions, WriteOptions
from geodelreg.errors import (
    ArrayShapeError,
    GeodelregError,
    MissingCrsError,
    MissingGeoreferenceError,
    RasterUnreadableError,
    UsageError,
)
from geodelreg.knobs import AlignKnobs, PansharpenKnobs, WriteKnobs
from geodelreg.product.report import report_json

SAMPLES = Path(__file__).resolve().parents[2] / "sample_tiles"
MS, PAN = SAMPLES / "ms.tif", SAMPLES / "pan.tif"
EXAMPLE = Path(__file__).resolve().parents[1] / "data" / "typed"


@pytest.fixture(scope="module")
def of_files() -> geodelreg.Alignment:
    return geodelreg.align(MS, PAN)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def placed_array(path: Path) -> tuple[np.ndarray[Any, Any], Grid]:
    with rasterio.open(path) as dataset:
        return dataset.read(), Grid(dataset.transform, dataset.shape, dataset.crs.to_wkt())


def in_memory(path: Path, stack: ExitStack) -> Any:
    file = stack.enter_context(MemoryFile(path.read_bytes()))
    return stack.enter_context(file.open())


def bands_apart(path: Path) -> xarray.Dataset:
    array = rioxarray.open_rasterio(path)
    assert isinstance(array, xarray.DataArray)
    variables = {f"B{n}": array.sel(band=n, drop=True) for n in array.band.values}
    return xarray.Dataset(variables).rio.write_crs(array.rio.crs)


KINDS: dict[str, Callable[[Path, ExitStack], Any]] = {
    "dataset": lambda path, stack: stack.enter_context(rasterio.open(path)),
    "memory file": in_memory,
    "warped": lambda path, stack: stack.enter_context(
        WarpedVRT(stack.enter_context(rasterio.open(path)))
    ),
    "array": lambda path, _: placed_array(path),
    "DataArray": lambda path, _: rioxarray.open_rasterio(path),
    "masked DataArray": lambda path, _: rioxarray.open_rasterio(path, masked=True),
    "dask": lambda path, _: rioxarray.open_rasterio(path, chunks={"x": 100, "y": 130}),
    "Dataset": lambda path, _: bands_apart(path),
}


def assert_same(one: geodelreg.Alignment, other: geodelreg.Alignment) -> None:
    """Sums over chunks of another size differ in their last digits."""
    for corner in ((0, 0), (200, 0), (0, 200), (200, 200)):
        there = ~other.correction.corrected @ (one.correction.corrected @ corner)
        assert np.hypot(*np.subtract(there, corner)) < 1e-5


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_the_correction_of_the_files(
    of_files: geodelreg.Alignment, stack: ExitStack, kind: str
) -> None:
    alignment = geodelreg.align(KINDS[kind](MS, stack), KINDS[kind](PAN, stack))
    assert_same(alignment, of_files)
    assert alignment.source.in_memory == (kind != "dataset")
    assert json.loads(report_json(alignment))["verdict"]["outcome"] == "aligned"


def test_bands_as_separate_arrays_and_kinds_mixed(of_files: geodelreg.Alignment) -> None:
    array = rioxarray.open_rasterio(MS)
    assert isinstance(array, xarray.DataArray)
    bands = [array.sel(band=n) for n in (1, 2, 3, 4)]
    assert_same(geodelreg.align(bands, PAN), of_files)


def test_pixels_that_masked_arrays_hide_are_not_matched(of_files: geodelreg.Alignment) -> None:
    pixels, grid = placed_array(MS)
    hidden = np.zeros(pixels.shape, dtype=bool)
    hidden[:, :, :80] = True
    rng = np.random.default_rng(3)
    noise = np.where(hidden, rng.integers(0, 2000, pixels.shape), pixels).astype(pixels.dtype)
    alignments = [
        geodelreg.align((np.ma.array(noise, mask=hidden), grid), PAN),
        geodelreg.align((np.where(hidden, np.nan, noise), grid), PAN),
        geodelreg.align((noise, grid), PAN, mask=hidden[0]),
    ]
    for alignment in alignments:
        points = alignment.tie_points
        assert points.kept.any()
        assert points.source_px[points.kept, 0].min() > 80
        apart = alignment.correction.corrected @ (100, 100)
        expected = of_files.correction.corrected @ (100, 100)
        assert np.hypot(*np.subtract(apart, expected)) < 0.1 * abs(grid.transform.a)
    (use,) = alignments[2].masks
    assert (use.image, use.kind) == ("source", "binary")
    assert use.hidden_share == pytest.approx(80 / pixels.shape[2], abs=0.02)


def test_masks_of_xarray_and_by_name_go_together(tmp_path: Path) -> None:
    pan = rioxarray.open_rasterio(PAN)
    assert isinstance(pan, xarray.DataArray)
    clouds = (pan.isel(band=0) * 0 + (pan.x < float(pan.x[100]))).astype("uint8")
    clouds = clouds.rio.write_crs(pan.rio.crs)
    clouds.rio.to_raster(tmp_path / "clouds.tif")
    alignment = geodelreg.align(MS, PAN, mask=tmp_path / "clouds.tif", pan_mask=[clouds])
    assert [use.image for use in alignment.masks] == ["source", "reference"]
    assert alignment.options.masks == (str(tmp_path / "clouds.tif"),)
    points = alignment.tie_points
    assert points.reference_px[points.kept, 0].min() > 100


def test_a_corrected_array_has_new_coordinates_and_the_same_values(
    of_files: geodelreg.Alignment, tmp_path: Path
) -> None:
    array = rioxarray.open_rasterio(MS, chunks=128)
    assert isinstance(array, xarray.DataArray)
    placed = of_files.apply(array)
    assert placed.chunks == array.chunks
    corrected = of_files.correction.corrected
    half = np.array([placed.x[0], placed.y[0]]) - corrected @ (0.5, 0.5)
    assert np.abs(half).max() < 1e-6
    assert placed.rio.transform(recalc=True).almost_equals(corrected, 1e-7)
    assert placed.attrs["GEODELREG_VERDICT"] == "aligned"
    placed.rio.to_raster(tmp_path / "out.tif")
    with rasterio.open(tmp_path / "out.tif") as out, rasterio.open(MS) as source:
        assert out.transform.almost_equals(corrected, 1e-7)
        assert np.array_equal(out.read(), source.read())
    variables = of_files.apply(bands_apart(MS))
    assert np.array_equal(variables.x, placed.x)
    again = geodelreg.align(placed, PAN)
    assert again.verdict.outcome.value == "already_aligned"


def test_a_rotated_correction_is_kept_in_the_geotransform() -> None:
    alignment = geodelreg.align(MS, PAN, model="affine")
    array = rioxarray.open_rasterio(MS)
    assert isinstance(array, xarray.DataArray)
    placed = alignment.apply(array)
    assert alignment.correction.corrected.b != 0
    assert "x" not in placed.coords
    assert placed.rio.transform().almost_equals(alignment.correction.corrected, 1e-9)
    check = geodelreg.check(placed, PAN, limit_px=0.3)
    assert check.outcome.value == "aligned"


def test_coordinates_count_more_than_a_geotransform_beside_them(
    of_files: geodelreg.Alignment,
) -> None:
    array = rioxarray.open_rasterio(MS)
    assert isinstance(array, xarray.DataArray)
    moved = array.assign_coords(x=array.x + 30.0, y=array.y - 12.0)
    alignment = geodelreg.align(moved, PAN)
    before = of_files.correction.original
    assert alignment.correction.original.almost_equals(
        Affine.translation(30.0, -12.0) @ before, 1e-6
    )
    upside_down = array.isel(y=slice(None, None, -1))
    flipped = geodelreg.align(upside_down, PAN)
    assert flipped.correction.original.e > 0
    for at in ((0.0, 0.0), (100.0, 150.0)):
        down = flipped.correction.corrected @ (at[0], array.sizes["y"] - at[1])
        expected = of_files.correction.corrected @ at
        assert np.hypot(*np.subtract(down, expected)) < 0.1 * before.a


def broken() -> xarray.DataArray:
    """A dask array that fails where it is computed."""

    def fail(block: Any) -> Any:
        raise OSError("the store is gone")

    array = rioxarray.open_rasterio(MS, chunks=64)
    assert isinstance(array, xarray.DataArray)
    failing = array.data.map_blocks(fail, dtype=array.dtype, meta=np.empty((0, 0, 0), array.dtype))
    return array.copy(data=failing)


def plain() -> xarray.DataArray:
    array = rioxarray.open_rasterio(MS)
    assert isinstance(array, xarray.DataArray)
    return array


def closed() -> Any:
    with rasterio.open(MS) as dataset:
        return dataset


BAD: dict[str, tuple[Callable[[], Any], type[Exception], str]] = {
    "shape": (
        lambda: (np.zeros((4, 5)), Grid(Affine.identity(), (5, 4), "EPSG:32618")),
        ArrayShapeError,
        "4, 5.*5 rows of 4 columns",
    ),
    "dimensions": (lambda: plain().expand_dims(time=2), ArrayShapeError, r"isel\(time=0\)"),
    "uneven": (
        lambda: plain().isel(x=[0, 1, 2, *range(5, 100)]),
        ArrayShapeError,
        "not evenly spaced",
    ),
    "no rows": (lambda: xarray.DataArray(np.zeros(5), dims="n"), ArrayShapeError, "no rows"),
    "no CRS": (lambda: plain().drop_vars("spatial_ref"), MissingCrsError, r"rio\.write_crs"),
    "unknown CRS": (
        lambda: (np.zeros((4, 5)), Grid(Affine.identity(), (4, 5), "https://example.org/4326")),
        MissingCrsError,
        "EPSG:32618",
    ),
    "no place": (
        lambda: plain().drop_vars(["x", "y", "spatial_ref"]).rio.write_crs("EPSG:32618"),
        MissingGeoreferenceError,
        "assign_coords",
    ),
    "fails": (broken, RasterUnreadableError, "cannot be computed.*the store is gone"),
    "complex": (lambda: plain() * 1j, RasterUnreadableError, "complex"),
    "text": (lambda: plain().astype(str), TypeError, "no numbers"),
    "closed": (closed, RasterUnreadableError, "is closed"),
    "bare": (lambda: np.zeros((4, 5)), TypeError, r"\(array, Grid\)"),
    "nothing": (lambda: None, TypeError, "is no raster"),
    "list": (lambda: ([[1]], Grid(Affine.identity(), (1, 1), "EPSG:4326")), TypeError, "no array"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_raster_is_refused_as_ms_and_as_pan(case: str) -> None:
    make, kind, words = BAD[case]
    with pytest.raises(kind, match=words) as refusal:
        geodelreg.align(make(), PAN)
    if isinstance(refusal.value, GeodelregError):
        assert refusal.value.remedy
    with pytest.raises(kind, match=words):
        geodelreg.check(MS, make())


@pytest.mark.parametrize(
    ("argument", "value", "kind"),
    [
        ("modl", "scale", TypeError),
        ("model", 3, UsageError),
        ("ratio", "half", TypeError),
        ("max_keypoints", -1, UsageError),
    ],
)
def test_wrong_keywords_are_named(argument: str, value: Any, kind: type[Exception]) -> None:
    with pytest.raises(kind, match=argument):
        geodelreg.align(MS, PAN, **{argument: value})


def test_keywords_replace_what_the_options_say(tmp_path: Path) -> None:
    alignment = geodelreg.align(MS, PAN, AlignOptions(model="affine", ratio=0.7), model="shift")
    assert (alignment.options.model, alignment.options.ratio) == ("shift", 0.7)
    (tmp_path / "out.tif").write_bytes(b"mine")
    geodelreg.write(alignment, tmp_path / "out.tif", overwrite=True)
    with rasterio.open(tmp_path / "out.tif") as dataset:
        assert dataset.transform == alignment.correction.corrected


@pytest.mark.parametrize(
    ("knobs", "options"),
    [
        (AlignKnobs, AlignOptions),
        (WriteKnobs, WriteOptions),
        (PansharpenKnobs, PansharpenOptions),
    ],
)
def test_keywords_are_the_fields_of_the_options(knobs: Any, options: Any) -> None:
    assert get_type_hints(knobs) == {
        name: hint
        for name, hint in get_type_hints(options).items()
        if name in {field.name for field in fields(options)}
    }


def test_what_has_no_file_is_not_written(tmp_path: Path) -> None:
    alignment = geodelreg.align(plain(), PAN)
    for write in (
        lambda: geodelreg.write(alignment, tmp_path / "out.tif"),
        lambda: geodelreg.write_in_place(alignment),
    ):
        with pytest.raises(UsageError, match=r"alignment\.apply"):
            write()
    geodelreg.export_gcps(alignment, tmp_path / "points.geojson")
    assert [path.name for path in tmp_path.iterdir()] == ["points.geojson"]


def test_a_page_of_arrays_is_refused_with_the_way_to_one(tmp_path: Path) -> None:
    ms, pan = (rioxarray.open_rasterio(path) for path in (MS, PAN))
    alignment = geodelreg.align(ms, pan)
    with pytest.raises(UsageError, match="no file") as told:
        geodelreg.write_report(alignment, tmp_path / "page.html")
    assert "geodelreg report" in told.value.remedy
    geodelreg.write_report(alignment, tmp_path / "report.json")
    assert {path.name for path in tmp_path.iterdir()} == {"report.json"}


def test_apply_refuses_what_it_cannot_place(of_files: geodelreg.Alignment) -> None:
    with pytest.raises(TypeError, match=r"correction\.apply"):
        of_files.apply(np.zeros((3, 3)))  # type: ignore[type-var]
    with pytest.raises(UsageError, match="another coordinate reference system"):
        of_files.apply(plain().rio.reproject("EPSG:4326"))


def test_an_alignment_speaks_in_the_names_of_the_report(of_files: geodelreg.Alignment) -> None:
    report = json.loads(report_json(of_files))
    assert json.loads(json.dumps(of_files.to_dict())) == report
    centre = report["correction"]["at_centre"]
    assert list(of_files.shift_px) == centre["shift_px"]
    assert list(of_files.shift_m) == centre["shift_m"]
    ours = {"schema_version", "tool", "created", "inputs"}
    for name in {*report, *report["inputs"]} - ours:
        assert hasattr(of_files, name), name
    for part in ("correction", "accuracy", "verdict"):
        for name in set(report[part]) - {"at_centre"}:
            assert hasattr(getattr(of_files, part), name), name
    for name in centre:
        assert hasattr(of_files.at_centre, name), name


def test_an_alignment_shows_itself(of_files: geodelreg.Alignment) -> None:
    text = repr(of_files)
    assert len(text) < 160
    right, down = of_files.shift_px
    assert f"({right:.2f}, {down:.2f})" in text
    assert of_files.summary().startswith("Aligned: MS lay")
    named = geodelreg.align(plain().rename("<b>"), PAN)
    table = ElementTree.fromstring(named._repr_html_())
    cells = {row[0].text: row[1].text for row in table.iter("tr")}
    assert cells["source"] == "DataArray '<b>'"
    assert cells["verdict"] == "aligned"


def test_tie_points_as_a_table(of_files: geodelreg.Alignment) -> None:
    table = of_files.to_geodataframe()
    points = of_files.tie_points
    assert len(table) == len(points)
    assert (table.status == "kept").sum() == points.kept.sum()
    assert table.crs == rasterio.open(PAN).crs.to_wkt()
    ground = np.stack([table.geometry.x, table.geometry.y], axis=1)
    transform = of_files.reference.grid.transform
    back = np.array([~transform @ tuple(xy) for xy in ground])
    assert np.abs(back - points.reference_px).max() < 1e-6
    assert np.array_equal(table.source_px_column, points.source_px[:, 0])
    assert np.array_equal(table.residual_px_row, points.residual_px[:, 1], equal_nan=True)


def test_applied_to_what_has_no_crs_the_remedy_is_that_of_arrays(
    of_files: geodelreg.Alignment,
) -> None:
    with pytest.raises(MissingCrsError, match=r"rio\.write_crs"):
        of_files.apply(plain().drop_vars("spatial_ref"))


def test_a_plot_shows_the_kept_points_where_they_lie(of_files: geodelreg.Alignment) -> None:
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    assert of_files.plot(axes) is axes
    drawn = np.concatenate([np.asarray(c.get_offsets()) for c in axes.collections])
    points = of_files.tie_points
    transform = of_files.reference.grid.transform
    first = transform @ tuple(points.reference_px[points.kept][0])
    assert np.hypot(*(drawn - first).T).min() < 1e-6
    assert str(int(points.kept.sum())) in axes.get_title()


def test_chunks_of_dask_are_not_computed_for_every_window() -> None:
    computed = 0

    def count(block: Any) -> Any:
        nonlocal computed
        computed += 1
        return block

    pan = rioxarray.open_rasterio(PAN, chunks=200)
    assert isinstance(pan, xarray.DataArray)
    meta = np.empty((0, 0, 0), pan.dtype)
    counted = pan.copy(data=pan.data.map_blocks(count, dtype=pan.dtype, meta=meta))
    blocks = int(np.prod(counted.data.numblocks))
    geodelreg.align(MS, counted)
    assert blocks <= computed <= 2 * blocks


def test_the_package_that_type_checkers_read_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, of_files: geodelreg.Alignment
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    survey = importlib.import_module("survey")
    found = survey.place(MS, PAN, tmp_path / "out.tif")
    assert (found.right_px, found.down_px) == pytest.approx(of_files.shift_px, abs=0.1)
    assert found.lines
    assert "does not exist" in survey.place(MS, tmp_path / "none.tif", tmp_path / "out.tif")
    pixels, grid = placed_array(PAN)
    placed = survey.place_array(plain(), pixels[0], grid.transform, grid.crs_wkt)
    assert placed.rio.transform().almost_equals(of_files.correction.corrected, 1e-3)
    survey.sharpen(MS, PAN, tmp_path / "sharp.tif")
    with rasterio.open(tmp_path / "sharp.tif") as dataset:
        assert dataset.shape == pixels.shape[1:]
