"""GCP values and the text of each format, against hand-made and other programs' readings."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Transformer

from geodelreg.errors import GcpFormatError, OutputExistsError
from geodelreg.product.gcps import (
    GCP_FORMATS,
    GcpContext,
    gcp_context,
    gcps_from_alignment,
    read_gcps,
    write_gcps,
)
from geodelreg.product.gcps.envi import projection_info
from geodelreg.values.points import Gcp
from geodelreg.values.raster import Grid
from tests.data.gcps import make
from tests.unit.alignment_sample import GEOGRAPHIC, SHIFTED, UTM16, UTM17, alignment, tie_points

ORACLES = Path(__file__).parents[1] / "data" / "gcps"
# formats that keep every bit of the pixel and of the map position
EXACT = ("gdal", "csv", "geojson")


def oracle_context() -> GcpContext:
    return replace(make.context(ORACLES), source_paths=("ms.tif",))


def same_points(found: tuple[Gcp, ...], expected: tuple[Gcp, ...], tolerance: float) -> None:
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        values = (one.column, one.row, one.x, one.y)
        assert values == pytest.approx((other.column, other.row, other.x, other.y), abs=tolerance)


# --- from an alignment ---------------------------------------------------------------------------


def test_points_are_the_kept_tie_points_in_reading_order() -> None:
    gcps = gcps_from_alignment(alignment())
    assert [(gcp.row, gcp.column) for gcp in gcps] == [
        (20.0, 10.0),
        (20.0, 80.0),
        (60.0, 15.5),
        (70.25, 90.5),
    ]
    assert [gcp.id for gcp in gcps] == ["1", "2", "3", "4"]
    assert gcps[0].info == "residual 0.0000 0.0500 px; sigma 0.0200 0.0300 px"


def test_map_positions_are_those_of_the_reference() -> None:
    gcps = gcps_from_alignment(alignment())
    for gcp in gcps:
        assert (gcp.x, gcp.y) == pytest.approx(SHIFTED @ (gcp.column, gcp.row), abs=1e-9)


def test_map_positions_change_crs_exactly() -> None:
    pan = Affine(2.0, 0.0, -153000.0, 0.0, -2.0, 1306000.0)
    made = alignment(
        reference=Grid(pan, (3000, 3000), UTM17), tie_points=tie_points(SHIFTED, PAN_IN_UTM16)
    )
    points = made.tie_points
    to_utm16 = Transformer.from_crs(32617, 32616, always_xy=True)
    for gcp in gcps_from_alignment(made):
        index = int(np.flatnonzero((points.source_px == (gcp.column, gcp.row)).all(axis=1))[0])
        expected = to_utm16.transform(*(pan @ tuple(points.reference_px[index])))
        assert (gcp.x, gcp.y) == pytest.approx(expected, abs=1e-6)


PAN_IN_UTM16 = Affine(2.0, 0.0, 500000.0, 0.0, -2.0, 1300000.0)


def test_info_leaves_out_what_is_not_known() -> None:
    points = replace(tie_points(), residual_px=np.full((5, 2), np.nan))
    assert gcps_from_alignment(alignment(tie_points=points))[0].info == "sigma 0.0200 0.0300 px"


def test_context_has_the_reference_pixels_in_the_order_of_the_points() -> None:
    made = alignment()
    context = gcp_context(made)
    assert context.reference_px is not None
    for gcp, pan_px in zip(gcps_from_alignment(made), context.reference_px, strict=True):
        assert made.reference.grid.transform @ tuple(pan_px) == pytest.approx((gcp.x, gcp.y))


# --- committed files -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in make.FORMATS if not name.endswith(".vrt")])
def test_text_of_each_format_is_the_committed_one(name: str) -> None:
    spec = GCP_FORMATS[make.FORMATS[name]]
    text = spec.encode(make.points(), oracle_context(), ORACLES / name)
    committed = (ORACLES / name).read_text()
    if name.endswith(".geojson"):  # PROJ may differ in the last bit of longitude and latitude
        assert _rounded(json.loads(text)) == _rounded(json.loads(committed))
    else:
        assert text == committed


def _rounded(value: object) -> object:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return round(value, 9) if isinstance(value, float) else value


@pytest.mark.parametrize("name", make.FORMATS)
def test_committed_files_read_back(name: str) -> None:
    found, crs_wkt = read_gcps(ORACLES / name, context=oracle_context())
    same_points(found, make.points(), 1e-9)
    if name.endswith(".csv"):
        assert crs_wkt is None
    else:
        assert crs_wkt is not None
        assert CRS.from_wkt(crs_wkt).to_epsg() == 32616


def test_gdal_reads_the_option_file_as_meant() -> None:
    read = json.loads((ORACLES / "points.gcp.gdal.json").read_text())
    _same_as_gdal(read)


def test_gdal_reads_the_vrt_as_meant() -> None:
    read = json.loads((ORACLES / "points.vrt.gdal.json").read_text())
    _same_as_gdal(read)
    assert [item["info"] for item in read["gcpList"]] == [gcp.info for gcp in make.points()]


def _same_as_gdal(read: dict[str, object]) -> None:
    assert read["epsg"] == 32616
    items = read["gcpList"]
    assert isinstance(items, list)
    values = [tuple(item[key] for key in ("pixel", "line", "x", "y", "z")) for item in items]
    assert values == [(gcp.column, gcp.row, gcp.x, gcp.y, gcp.z) for gcp in make.points()]


def test_gdal_reads_the_table_as_meant() -> None:
    rows = json.loads((ORACLES / "points.csv.ogr.json").read_text())
    for row, gcp in zip(rows, make.points(), strict=True):
        values = tuple(float(row[key]) for key in ("column", "line", "x", "y", "z"))
        assert values == (gcp.column, gcp.row, gcp.x, gcp.y, gcp.z)
        assert (row["id"], row["info"]) == (gcp.id, gcp.info)


def test_geojson_is_that_of_rio_gcps() -> None:
    ours = json.loads((ORACLES / "points.geojson").read_text())
    theirs = json.loads((ORACLES / "points.geojson.rio.json").read_text())
    assert _rounded(ours) == _rounded(theirs)


def test_qgis_columns_give_the_points_under_the_original_header() -> None:
    """QGIS's rules, written here without our reader: by position, one header line skipped."""
    lines = (ORACLES / "points.points").read_text().splitlines()
    assert lines[0].startswith("#CRS: PROJCRS")
    assert lines[1] == "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"
    for line, gcp in zip(lines[2:], make.points(), strict=True):
        map_x, map_y, source_x, source_y, enable, *residuals = line.split(",")
        column = (float(source_x) - 500010.0) / 30.0
        row = (1300020.0 - float(source_y)) / 30.0
        assert (column, row) == pytest.approx((gcp.column, gcp.row), abs=1e-9)
        assert (float(map_x), float(map_y)) == (gcp.x, gcp.y)
        assert enable == "1"
        assert [float(text) for text in residuals] == [0.0, 0.0, 0.0]


def test_qgis_residual_is_model_minus_pixel_with_rows_upwards() -> None:
    off = replace(oracle_context(), corrected=make.TRUTH @ Affine.translation(-0.25, 0.5))
    text = GCP_FORMATS["qgis"].encode(make.points(), off, Path("x.points"))
    fields = text.splitlines()[2].split(",")
    assert [float(field) for field in fields[5:]] == pytest.approx(
        [0.25, 0.5, math.hypot(0.25, 0.5)], abs=1e-6
    )


@pytest.mark.parametrize("name", ["qgis_by_hand.points", "qgis_tabs.points"])
def test_points_of_qgis_read(name: str) -> None:
    """The disabled point is no control point."""
    found, crs_wkt = read_gcps(ORACLES / name, context=oracle_context())
    expected = make.points()
    same_points(found, (expected[0], expected[3]), 1e-9)
    if name == "qgis_by_hand.points":
        assert CRS.from_wkt(crs_wkt).to_epsg() == 32616
    else:
        assert crs_wkt is None


def test_points_of_envi_count_from_one() -> None:
    found, crs_wkt = read_gcps(ORACLES / "envi_by_hand.pts")
    expected = make.points()
    same_points(found, (expected[0], expected[3]), 1e-9)
    assert CRS.from_wkt(crs_wkt).to_epsg() == 32616


def test_envi_image_to_image_pairs_both_rasters_pixels() -> None:
    """Base is PAN, warp is MS; read with a plain parser: GDAL's pixel plus one in each."""
    rows = np.loadtxt(ORACLES / "points.pts", comments=";")
    for (base_x, base_y, warp_x, warp_y), gcp in zip(rows, make.points(), strict=True):
        assert (warp_x - 1, warp_y - 1) == pytest.approx((gcp.column, gcp.row), abs=1e-9)
        ground = make.PAN @ (base_x - 1, base_y - 1)
        assert ground == pytest.approx((gcp.x, gcp.y), abs=1e-8)


def test_envi_reference_pixels_come_from_the_grid_when_not_given() -> None:
    given_px = oracle_context()
    from_grid = replace(given_px, reference_px=None)
    encode = GCP_FORMATS["envi"].encode
    path = Path("x.pts")
    assert encode(make.points(), from_grid, path) == encode(make.points(), given_px, path)


@pytest.mark.parametrize(
    ("epsg", "info"),
    [
        (32720, "{UTM, 20, South, WGS-84, units=Meters}"),
        (26714, "{UTM, 14, North, North America 1927, units=Meters}"),
        (4326, "{Geographic Lat/Lon, WGS-84, units=Degrees}"),
        (25832, "{Arbitrary, units=Unknown}"),  # ETRS89 is no datum of ENVI's
        (2225, "{Arbitrary, units=Unknown}"),  # US survey feet would turn into others
    ],
)
def test_envi_projection_is_exact_or_not_claimed(epsg: int, info: str) -> None:
    assert projection_info(CRS.from_epsg(epsg).to_wkt()) == info


# --- round trips ---------------------------------------------------------------------------------

pixel = st.floats(-1e5, 1e5, allow_nan=False)
name = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Zl", "Zp")))
any_points = st.lists(
    st.builds(
        Gcp,
        id=name.filter(bool),
        column=pixel,
        row=pixel,
        x=st.floats(2e5, 8e5),
        y=st.floats(-5e6, 9e6),
        z=st.floats(-500, 9000),
        info=name,
    ),
    max_size=5,
).map(tuple)


@pytest.mark.parametrize("kind", EXACT)
@given(points=any_points)
def test_exact_formats_keep_every_bit(kind: str, points: tuple[Gcp, ...]) -> None:
    spec = GCP_FORMATS[kind]
    found, _ = spec.decode(spec.encode(points, oracle_context(), Path("x")), oracle_context())
    if kind == "gdal":
        points = tuple(replace(p, id=str(i), info="") for i, p in enumerate(points, start=1))
    assert found == points


@pytest.mark.parametrize("kind", ["qgis", "envi", "envi-map"])
@given(points=any_points)
def test_other_formats_keep_a_micropixel(kind: str, points: tuple[Gcp, ...]) -> None:
    spec = GCP_FORMATS[kind]
    context = replace(oracle_context(), reference_px=None)
    found, _ = spec.decode(spec.encode(points, context, Path("x")), context)
    same_points(found, points, 1e-6)


@given(points=any_points)
def test_numpy_numbers_are_written_as_plain_ones(points: tuple[Gcp, ...]) -> None:
    wrapped = tuple(
        Gcp(p.id, *map(np.float64, (p.column, p.row, p.x, p.y, p.z)), info=p.info) for p in points
    )
    for kind in ("qgis", "gdal", "csv"):
        encode = GCP_FORMATS[kind].encode
        path = Path("x")
        assert encode(wrapped, oracle_context(), path) == encode(points, oracle_context(), path)


def test_custom_crs_survives_the_option_file() -> None:
    wkt = CRS.from_proj4(
        "+proj=tmerc +lat_0=0 +lon_0=-86.5 +k=0.9997 +x_0=1000 +ellps=GRS80"
    ).to_wkt()
    context = replace(oracle_context(), source=Grid(make.HEADER, (6, 8), wkt))
    spec = GCP_FORMATS["gdal"]
    _, found = spec.decode(spec.encode(make.points(), context, Path("x")), None)
    assert found is not None
    assert CRS.from_wkt(found).equals(CRS.from_wkt(wkt))
    assert "EPSG:" not in spec.encode(make.points(), context, Path("x"))


def test_geographic_points_keep_longitude_first() -> None:
    point = Gcp("1", 3.0, 4.0, -86.5, 11.75)
    context = GcpContext(source=Grid(Affine(1e-4, 0, -87, 0, -1e-4, 12), (6, 8), GEOGRAPHIC))
    for kind in ("gdal", "geojson", "qgis", "envi-map"):
        spec = GCP_FORMATS[kind]
        text = spec.encode([point], context, Path("x"))
        found, crs_wkt = spec.decode(text, context)
        same_points(found, (point,), 1e-9)
        assert CRS.from_wkt(crs_wkt).to_epsg() == 4326
    collection = json.loads(GCP_FORMATS["geojson"].encode([point], context, Path("x")))
    assert collection["features"][0]["geometry"]["coordinates"] == [-86.5, 11.75, 0.0]


# --- refusals ------------------------------------------------------------------------------------


def test_unknown_extension_lists_the_formats(tmp_path: Path) -> None:
    with pytest.raises(GcpFormatError) as refusal:
        write_gcps(tmp_path / "points.shp", make.points(), context=oracle_context())
    for kind in GCP_FORMATS:
        assert kind in str(refusal.value)
    assert not list(tmp_path.iterdir())


def test_unknown_format_lists_the_formats(tmp_path: Path) -> None:
    with pytest.raises(GcpFormatError, match=r"'erdas' is unknown.*qgis.*envi-map"):
        write_gcps(tmp_path / "points.csv", make.points(), "erdas", context=oracle_context())


def test_not_finite_coordinate_is_refused(tmp_path: Path) -> None:
    points = (*make.points(), Gcp("7", 1.0, 2.0, math.nan, 3.0))
    with pytest.raises(GcpFormatError, match="point 7"):
        write_gcps(tmp_path / "points.csv", points, context=oracle_context())
    assert not list(tmp_path.iterdir())


def test_existing_file_stays_without_overwrite(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("mine")
    with pytest.raises(OutputExistsError):
        write_gcps(path, make.points(), context=oracle_context())
    assert path.read_text() == "mine"
    write_gcps(path, make.points(), context=oracle_context(), overwrite=True)
    assert path.read_text() == (ORACLES / "points.csv").read_text()


def test_format_goes_by_extension_whatever_its_case(tmp_path: Path) -> None:
    write_gcps(tmp_path / "POINTS.CSV", make.points(), context=oracle_context())
    with (tmp_path / "POINTS.CSV").open() as stream:
        assert len(list(csv.DictReader(stream))) == len(make.points())


@pytest.mark.parametrize(
    ("name", "text", "cause"),
    [
        ("a.points", "mapX,mapY\n1,2,3\n", "line 2: fewer than 4 columns"),
        ("a.points", "#CRS: EPSG:32616\nmapX,mapY\n1,2,3,x,1\n", "line 3: could not convert"),
        ("a.points", "#CRS: nonsense\nmapX,mapY\n", "CRS 'nonsense' is unknown"),
        ("a.gcp", "-gcp 1 2 3\n", "line 1: -gcp takes 4 or 5 numbers"),
        ("a.gcp", '-a_srs "EPSG\n', "line 1: No closing quotation"),
        ("a.gcp", "-gcp 1 2 3 nan\n", "line 1: a coordinate is not finite"),
        ("a.csv", "id,column,line,x\n", "the header line lacks y"),
        ("a.csv", "column,line,x,y\n1,2,3\n", "line 2: could not convert"),
        ("a.csv", "", "the header line lacks column, line, x, y"),
        ("a.geojson", "[1, 2]", "not a collection of GeoJSON features"),
        ("a.geojson", "{", "it is not GeoJSON"),
        ("a.geojson", '{"type": "Feature", "properties": {"row": 1}}', "lacks the properties col"),
        ("a.vrt", "<VRTDataset/>", "it has no GCPList"),
        ("a.vrt", "not xml", "it is not XML"),
        ("a.vrt", "<V><GCPList><GCP Pixel='1'/></GCPList></V>", "line 1: could not convert"),
        ("a.pts", "; ENVI Image to Map GCP File\n1 2 3\n", "line 2: 3 columns instead of 4"),
    ],
)
def test_broken_file_is_refused_by_name_and_line(
    tmp_path: Path, name: str, text: str, cause: str
) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(GcpFormatError) as refusal:
        read_gcps(path, context=oracle_context())
    assert str(path) in str(refusal.value)
    assert cause in str(refusal.value)


def test_missing_and_binary_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GcpFormatError, match="cannot be read"):
        read_gcps(tmp_path / "none.csv")
    (tmp_path / "image.csv").write_bytes(b"II*\0\xff\xfe")
    with pytest.raises(GcpFormatError, match="cannot be read"):
        read_gcps(tmp_path / "image.csv")


@pytest.mark.parametrize("name", ["points.points", "points.pts"])
def test_formats_that_refer_to_rasters_ask_for_them(name: str) -> None:
    with pytest.raises(GcpFormatError, match="Name th"):
        read_gcps(ORACLES / name)


def test_features_of_two_crss_are_refused(tmp_path: Path) -> None:
    collection = json.loads((ORACLES / "points.geojson").read_text())
    collection["features"][0]["properties"]["crs"] = "EPSG:32617"
    path = tmp_path / "mixed.json"
    path.write_text(json.dumps(collection))
    with pytest.raises(GcpFormatError, match="different CRSs"):
        read_gcps(path)


def test_sequence_of_features_is_read_as_rio_prints_it(tmp_path: Path) -> None:
    features = json.loads((ORACLES / "points.geojson").read_text())["features"]
    path = tmp_path / "sequence.json"
    path.write_text("".join(f"\x1e{json.dumps(feature)}\n" for feature in features))
    found, crs_wkt = read_gcps(path)
    assert found == make.points()
    assert CRS.from_wkt(crs_wkt).equals(CRS.from_wkt(UTM16))


def test_points_beyond_the_globe_have_no_geojson(tmp_path: Path) -> None:
    first, *others = make.points()
    points = (replace(first, x=1e30), *others)
    with pytest.raises(GcpFormatError, match="no place in WGS 84"):
        write_gcps(tmp_path / "points.geojson", points, context=oracle_context())
