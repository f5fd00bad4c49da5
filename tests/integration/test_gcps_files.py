"""GCP files on disk, read by GDAL: through rasterio, and by its own tools where installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.rio.main import main_group
from rasterio.transform import from_gcps

from geodelreg.errors import GcpFormatError, RasterNotFoundError
from geodelreg.product.gcps import GCP_FORMATS, GcpContext, read_gcps, write_gcps
from geodelreg.values.points import Gcp
from geodelreg.values.raster import Grid
from tests.data.gcps import make

ORACLES = Path(__file__).parents[1] / "data" / "gcps"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder with the raster and all files that `make` writes."""
    make.main(tmp_path)
    return tmp_path


def values(gcps: tuple[Gcp, ...]) -> list[tuple[float, ...]]:
    return [(gcp.column, gcp.row, gcp.x, gcp.y, gcp.z) for gcp in gcps]


# --- VRT -----------------------------------------------------------------------------------------


def test_vrt_opens_with_the_points_and_every_band(folder: Path) -> None:
    with rasterio.open(folder / "points.vrt") as vrt, rasterio.open(folder / "ms.tif") as source:
        gcps, crs = vrt.gcps
        assert [(p.col, p.row, p.x, p.y, p.z) for p in gcps] == values(make.points())
        assert [(p.id, p.info) for p in gcps] == [(p.id, p.info) for p in make.points()]
        assert crs.to_epsg() == 32616
        assert vrt.transform == Affine.identity()
        assert np.array_equal(vrt.read(), source.read())
        assert vrt.descriptions == ("red", "near infrared")
        assert vrt.nodatavals == (0.0, 0.0)


def test_vrt_points_have_the_half_pixel_right(folder: Path) -> None:
    """GDAL's own fit through the points starts at the outer corner of the first pixel."""
    with rasterio.open(folder / "points.vrt") as vrt:
        fitted = from_gcps(vrt.gcps[0])
    assert fitted.almost_equals(make.TRUTH, 1e-6)


def test_vrt_is_the_committed_one(folder: Path) -> None:
    assert (folder / "points.vrt").read_text() == (ORACLES / "points.vrt").read_text()


def test_vrt_and_raster_move_together(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "moved"
    shutil.move(folder, elsewhere)
    with rasterio.open(elsewhere / "points.vrt") as vrt:
        assert vrt.read(2)[5, 7] == 95


def test_vrt_finds_its_raster_through_linked_folders(tmp_path: Path) -> None:
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "er")
    make.main(tmp_path)
    target = tmp_path / "link" / "points.vrt"
    write_gcps(target, make.points(), context=make.context(tmp_path))
    with rasterio.open(tmp_path / "deep" / "er" / "points.vrt") as vrt:
        assert vrt.read(1)[0, 5] == 5


def test_vrt_of_a_relative_source_path(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "out").mkdir()
    monkeypatch.chdir(folder)
    context = replace(make.context(folder), source_paths=("ms.tif",))
    write_gcps(Path("out", "points.vrt"), make.points(), context=context)
    assert "../ms.tif" in Path("out", "points.vrt").read_text()
    with rasterio.open("out/points.vrt") as vrt:
        assert vrt.read(1)[0, 5] == 5


def test_vrt_keeps_what_describes_the_pixels(tmp_path: Path) -> None:
    path = tmp_path / "rich.tif"
    profile = {"driver": "GTiff", "width": 8, "height": 6, "count": 2, "dtype": "uint8"}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", crs="EPSG:32616", transform=make.HEADER, **profile) as dataset,
    ):
        dataset.write(np.arange(96, dtype=np.uint8).reshape(2, 6, 8))
        dataset.colorinterp = (ColorInterp.palette, ColorInterp.undefined)
        dataset.write_colormap(1, {value: (value, 0, 255 - value, 255) for value in range(256)})
        dataset.update_tags(SENSOR="a & <b>\x01")
        dataset.update_tags(2, WAVELENGTH="0.8")
        dataset.scales, dataset.offsets, dataset.units = (1.0, 0.5), (0.0, -3.25), ("DN", "W")
        dataset.write_mask(np.tri(6, 8, dtype=bool))
    context = replace(make.context(tmp_path), source_paths=(str(path),))
    write_gcps(tmp_path / "rich.vrt", make.points(), context=context)
    with rasterio.open(tmp_path / "rich.vrt") as vrt, rasterio.open(path) as source:
        assert vrt.tags()["SENSOR"].startswith("a & <b>")
        assert vrt.tags(2)["WAVELENGTH"] == "0.8"
        assert vrt.colorinterp == source.colorinterp
        assert vrt.colormap(1) == source.colormap(1)
        assert (vrt.scales, vrt.offsets, vrt.units) == (source.scales, source.offsets, source.units)
        assert vrt.mask_flag_enums[0] == [MaskFlags.per_dataset]
        assert np.array_equal(vrt.dataset_mask(), source.dataset_mask())


def test_vrt_stacks_one_file_per_band(tmp_path: Path) -> None:
    paths = []
    for number, kind in enumerate(("uint16", "float32"), start=1):
        path = tmp_path / f"B{number}.tif"
        profile = {"driver": "GTiff", "width": 8, "height": 6, "count": 1, "dtype": kind}
        with rasterio.open(
            path, "w", crs="EPSG:32616", transform=make.HEADER, **profile
        ) as dataset:
            dataset.write(np.full((1, 6, 8), number, dtype=kind))
            mask = np.zeros((6, 8), dtype=bool)
            mask[number] = True
            dataset.write_mask(mask)
        paths.append(str(path))
    context = replace(make.context(tmp_path), source_paths=tuple(paths))
    write_gcps(tmp_path / "stack.vrt", make.points(), context=context)
    with rasterio.open(tmp_path / "stack.vrt") as vrt:
        assert vrt.dtypes == ("uint16", "float32")
        assert (vrt.read(1)[0, 0], vrt.read(2)[0, 0]) == (1, 2)
        assert [np.flatnonzero(mask.any(axis=1)).tolist() for mask in vrt.read_masks()] == [
            [1],
            [2],
        ]
        assert len(vrt.gcps[0]) == len(make.points())


def test_vrt_refuses_files_on_other_grids(folder: Path) -> None:
    context = make.context(folder)
    other = replace(context, source=Grid(make.HEADER, (6, 9), context.source.crs_wkt))
    with pytest.raises(GcpFormatError, match=r"ms\.tif is not on the grid"):
        write_gcps(folder / "other.vrt", make.points(), context=other)
    with pytest.raises(GcpFormatError, match="needs the raster it shows"):
        write_gcps(folder / "other.vrt", make.points(), context=replace(context, source_paths=()))
    missing = replace(context, source_paths=(str(folder / "none.tif"),))
    with pytest.raises(RasterNotFoundError, match=r"none\.tif does not exist"):
        write_gcps(folder / "other.vrt", make.points(), context=missing)
    assert not (folder / "other.vrt").exists()


def test_vrt_of_a_raster_inside_an_archive_keeps_gdals_name(folder: Path) -> None:
    shutil.make_archive(str(folder / "pack"), "zip", folder, "ms.tif")
    inside = f"/vsizip/{folder}/pack.zip/ms.tif"
    context = replace(make.context(folder), source_paths=(inside,))
    write_gcps(folder / "packed.vrt", make.points(), context=context)
    name = ET.parse(folder / "packed.vrt").find(".//SourceFilename")
    assert name is not None
    assert (name.text, name.get("relativeToVRT")) == (inside, "0")
    with rasterio.open(folder / "packed.vrt") as vrt:
        assert vrt.read(2)[5, 7] == 95


def test_vrt_with_a_geographic_crs_keeps_longitude_first(folder: Path) -> None:
    with rasterio.open(folder / "ms.tif") as dataset:
        profile = dataset.profile | {"crs": "EPSG:4326", "transform": Affine(1, 0, -87, 0, -1, 12)}
        pixels = dataset.read()
    with rasterio.open(folder / "lonlat.tif", "w", **profile) as dataset:
        dataset.write(pixels)
        grid = Grid(dataset.transform, dataset.shape, dataset.crs.to_wkt(version="WKT2_2019"))
    context = GcpContext(source=grid, source_paths=(str(folder / "lonlat.tif"),))
    corners = [(0.0, 0.0), (8.0, 0.0), (0.0, 6.0)]
    points = [Gcp(str(i), *px, *(grid.transform @ px)) for i, px in enumerate(corners)]
    write_gcps(folder / "lonlat.vrt", points, context=context)
    with rasterio.open(folder / "lonlat.vrt") as vrt:
        gcps, crs = vrt.gcps
        assert (gcps[1].x, gcps[1].y) == (-79.0, 12.0)
        with rasterio.vrt.WarpedVRT(vrt, src_crs=crs, crs="EPSG:4326") as warped:
            assert warped.bounds.left == pytest.approx(-87.0, abs=0.1)
            assert warped.bounds.top == pytest.approx(12.0, abs=0.1)
    found, _ = read_gcps(folder / "lonlat.vrt")
    assert values(found) == values(tuple(points))


# --- GeoJSON -------------------------------------------------------------------------------------


def test_geojson_equals_what_rio_prints_for_the_vrt(folder: Path) -> None:
    printed = CliRunner().invoke(
        main_group, ["gcps", "--collection", str(folder / "points.vrt")], catch_exceptions=False
    )
    theirs = json.loads(printed.stdout)["features"]
    ours = json.loads((folder / "points.geojson").read_text())["features"]
    for one, other in zip(ours, theirs, strict=True):
        assert one["properties"] == other["properties"]
        assert one["id"] == other["id"]
        assert one["geometry"]["coordinates"] == pytest.approx(other["geometry"]["coordinates"])


# --- gdal_translate, where installed; the committed output stands for it elsewhere ---------------


def gdal_points(folder: Path) -> tuple[dict[str, object], Affine]:
    """GCPs that ``gdal_translate --optfile`` gives a raster, as gdalinfo prints them."""
    committed = json.loads((ORACLES / "points.gcp.gdal.json").read_text())
    if shutil.which("gdal_translate") is None or shutil.which("gdalinfo") is None:
        return committed, make.TRUTH
    clean = {
        name: text for name, text in os.environ.items() if not name.startswith(("PROJ", "GDAL"))
    }
    command = ["gdal_translate", "-q", "--optfile", "points.gcp", "ms.tif", "out.tif"]
    subprocess.run(command, cwd=folder, env=clean, check=True)
    printed = subprocess.run(
        ["gdalinfo", "-json", "out.tif"], cwd=folder, env=clean, check=True, capture_output=True
    )
    live = json.loads(printed.stdout)["gcps"]
    assert 'ID["EPSG",32616]' in live["coordinateSystem"]["wkt"]
    with rasterio.open(folder / "out.tif") as dataset:
        fitted = from_gcps(dataset.gcps[0])
    return live | {"epsg": 32616}, fitted


def test_gdal_translate_takes_the_option_file(folder: Path) -> None:
    read, fitted = gdal_points(folder)
    items = read["gcpList"]
    assert isinstance(items, list)
    found = [tuple(item[key] for key in ("pixel", "line", "x", "y", "z")) for item in items]
    assert found == values(make.points())
    assert fitted.almost_equals(make.TRUTH, 1e-6)


@pytest.mark.parametrize("name", make.FORMATS)
def test_every_file_reads_back(folder: Path, name: str) -> None:
    found, _ = read_gcps(folder / name, context=make.context(folder))
    for one, other in zip(values(found), values(make.points()), strict=True):
        assert one == pytest.approx(other, abs=1e-8)


@pytest.mark.parametrize("end", [".points", ".gcp", ".csv", ".geojson", ".vrt", ".pts", ".txt"])
def test_a_file_too_large_for_points_is_not_read(tmp_path: Path, end: str) -> None:
    path = tmp_path / f"huge{end}"
    path.touch()
    os.truncate(path, 10**12)
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from geodelreg.errors import GcpFormatError\n"
        "from geodelreg.product.gcps import read_gcps\n"
        "try:\n    read_gcps(sys.argv[1])\n"
        "except GcpFormatError as error:\n    print(error)\n"
        # not ru_maxrss, which starts with that of the process that forked
        "lines = Path('/proc/self/status').read_text().splitlines()\n"
        "print(next(line.split()[1] for line in lines if line.startswith('VmHWM')))"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    message, peak_kb = done.stdout.splitlines()
    assert message.startswith(f"{path} is too large for a file of control points")
    assert "more than 50 MB" in message
    assert "Check that it is the right file" in message
    assert int(peak_kb) < 400_000


@pytest.mark.parametrize("name", GCP_FORMATS)
def test_as_many_points_as_can_be_asked_for_are_not_too_large(folder: Path, name: str) -> None:
    row = (12345.123456789123, 12345.678912345678, 500_000.123456789, 4_000_000.123456789)
    info = "residual -0.1234 -0.2345 px; sigma 0.1234 0.2345 px"
    gcps = [Gcp(str(100_000 + number), *row, info=info) for number in range(1000)]
    context = replace(make.context(folder), reference_px=None)
    write_gcps(folder / "many.dat", gcps, name, context=context)
    # of --max-keypoints 100000
    assert 100 * (folder / "many.dat").stat().st_size < 50_000_000
