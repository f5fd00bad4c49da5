"""Resampling through a map that no geotransform holds: positions, gaps, masks and jumps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from pyproj import Transformer

from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.kriging import Kernel
from geodelreg.geo.maps.projective import ProjectiveMap
from geodelreg.options import WriteOptions
from geodelreg.product.warp import write_warped
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import Grid
from geodelreg.values.result import Correction

Array = NDArray[np.float64]
UTM18 = rasterio.crs.CRS.from_epsg(32618).to_wkt()
UTM19 = rasterio.crs.CRS.from_epsg(32619).to_wkt()
HEADER = Affine(4.0, 0.0, 700_000.0, 0.0, -4.0, 4_500_000.0)
HEIGHT, WIDTH = 60, 75
FINE = Grid(Affine(1.0, 0.0, 700_010.0, 0.0, -1.0, 4_499_990.0), (220, 270), UTM18)


def move(xy: Array) -> Array:
    """Waves of half a pixel, 60 pixels long."""
    turns = 2 * np.pi * xy[..., ::-1] / 60.0
    return np.asarray(0.5 * np.sin(turns + np.array([0.0, 1.0])))


def field(jumps: tuple[float, ...] = ()) -> FieldMap:
    """Through exact points of the waves; what lies below a jump is 0.8 px right and 0.6 px down."""
    axes = np.arange(2.5, WIDTH, 5.0), np.arange(2.5, HEIGHT, 5.0)
    xy = np.stack([v.ravel() for v in np.meshgrid(*axes)], axis=1)
    target = xy + move(xy)
    for row in jumps:
        target[xy[:, 1] > row] += (0.8, 0.6)
    return FieldMap(xy, target, np.full(xy.shape, 1e-8), Kernel(40.0, (0.2, 0.2), 0.0), jumps)


def write_ramps(path: Path, **profile: Any) -> Path:
    """Raster whose two bands are the column and the row of each pixel's centre."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    settings = {"driver": "GTiff", "height": HEIGHT, "width": WIDTH, "count": 2}
    settings |= {"dtype": "float64", "crs": UTM18, "transform": HEADER, "nodata": -9.0}
    with rasterio.open(path, "w", **settings | profile) as dataset:
        dataset.write(np.stack([columns, rows]).astype(settings["dtype"]))
    return path


def warped(
    source: Path, placement: PixelMap, grid: Grid = FINE, **options: Any
) -> tuple[Array, NDArray[np.bool_]]:
    """Values, and where they are valid, of the warped raster on a grid."""
    correction = Correction("field", UTM18, HEADER, HEADER)
    out = source.with_name("out.tif")
    how = WriteOptions(warp=True, warp_grid="pan", **options)
    write_warped(source, out, correction, grid, {}, how, placement=placement)
    with rasterio.open(out) as dataset:
        assert (dataset.transform, dataset.shape) == (grid.transform, grid.shape)
        return dataset.read().astype(float), np.asarray(dataset.read_masks() > 0)


def truth(placement: PixelMap, grid: Grid = FINE) -> Array:
    """(H, W, 2) source pixels of the target's pixel centres, by pyproj and the map's inverse."""
    rows, columns = np.mgrid[: grid.shape[0], : grid.shape[1]] + 0.5
    x, y = grid.transform @ (columns, rows)
    if grid.crs_wkt != UTM18:
        x, y = Transformer.from_crs(grid.crs_wkt, UTM18, always_xy=True).transform(x, y)
    header_px = np.stack(~HEADER @ (x, y), axis=-1)
    return np.asarray(placement.inverse(header_px.reshape(-1, 2)).reshape(header_px.shape))


def inside(at: Array, margin: float = 3.0) -> NDArray[np.bool_]:
    low, high = (at >= margin).all(axis=-1), (at <= (WIDTH - margin, HEIGHT - margin)).all(axis=-1)
    return np.asarray(low & high)


@pytest.mark.parametrize("resampling", ["bilinear", "cubic", "cubicspline", "lanczos"])
def test_every_pixel_comes_from_where_the_map_says(tmp_path: Path, resampling: str) -> None:
    placement = field()
    got, valid = warped(write_ramps(tmp_path / "ms.tif"), placement, resampling=resampling)
    at = truth(placement)
    far = inside(at, 4.0)
    assert valid[:, far].all()
    most = 0.03 if resampling == "lanczos" else 0.0015  # Lanczos itself bends a ramp
    assert np.abs(np.moveaxis(got, 0, -1)[far] - at[far]).max() < most


def test_map_and_change_of_crs_are_one_resampling(tmp_path: Path) -> None:
    place = Transformer.from_crs(UTM18, UTM19, always_xy=True).transform(700_020, 4_499_980)
    grid = Grid(Affine(1.1, 0.0, place[0], 0.0, -1.1, place[1]), (150, 200), UTM19)
    placement = field()
    source = write_ramps(tmp_path / "ms.tif")
    got, valid = warped(source, placement, grid, resampling="bilinear")
    at = truth(placement, grid)
    assert inside(at).mean() > 0.5
    assert valid[:, inside(at)].all()
    assert np.abs(np.moveaxis(got, 0, -1) - at)[inside(at)].max() < 0.0015


def test_a_projective_map_is_warped_alike(tmp_path: Path) -> None:
    placement = ProjectiveMap(np.array([[1.01, 0.02, 1.0], [-0.01, 0.99, 2.0], [3e-5, -2e-5, 1.0]]))
    source = write_ramps(tmp_path / "ms.tif")
    got, valid = warped(source, placement, resampling="bilinear")
    at = truth(placement)
    assert valid[:, inside(at)].all()
    assert np.abs(np.moveaxis(got, 0, -1) - at)[inside(at)].max() < 0.0015


def test_gaps_stay_gaps_and_nothing_is_made_up_outside(tmp_path: Path) -> None:
    source, placement = write_ramps(tmp_path / "ms.tif"), field()
    with rasterio.open(source, "r+") as dataset:
        hole = np.full((15, 10), -9.0)
        dataset.write(hole, 1, window=rasterio.windows.Window(30, 20, 10, 15))
    _, valid = warped(source, placement, resampling="nearest")
    at = truth(placement)
    nearest = np.floor(at)
    hidden = (nearest >= (30, 20)).all(axis=-1) & (nearest < (40, 35)).all(axis=-1)
    edge = np.abs(at - np.rint(at)).min(axis=-1) < 0.002  # a thousandth decides there
    seen = inside(at, 0.0)
    assert (valid[0] == (seen & ~hidden))[~edge].all()
    assert (valid[1] == seen)[~edge].all()


@pytest.mark.parametrize("kind", ["mask", "alpha"])
def test_masks_and_alpha_say_what_is_covered(tmp_path: Path, kind: str) -> None:
    profile = {"dtype": "uint16", "nodata": None}
    if kind == "alpha":
        profile |= {"count": 3, "photometric": "MINISBLACK", "alpha": "unspecified"}
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    shown = np.where(columns < 50, 255, 0).astype(np.uint8)
    settings = {"driver": "GTiff", "height": HEIGHT, "width": WIDTH, "count": 2}
    settings |= {"crs": UTM18, "transform": HEADER} | profile
    with rasterio.open(tmp_path / "ms.tif", "w", **settings) as dataset:
        bands = [columns, rows] + ([shown] if kind == "alpha" else [])
        dataset.write(np.stack(bands).astype(np.uint16))
        if kind == "mask":
            dataset.write_mask(shown)
        else:
            dataset.colorinterp = [*dataset.colorinterp[:2], rasterio.enums.ColorInterp.alpha]
    placement = field()
    got, valid = warped(tmp_path / "ms.tif", placement, resampling="nearest")
    at = truth(placement)
    covered = inside(at, 0.0) & (np.floor(at[..., 0]) < 50)
    edge = np.abs(at - np.rint(at)).min(axis=-1) < 0.002
    seen = got[-1] > 0 if kind == "alpha" else valid[0]
    assert (seen == covered)[~edge].all()


def test_quality_bands_keep_their_values(tmp_path: Path) -> None:
    source = write_ramps(tmp_path / "ms.tif", dtype="uint16", nodata=None)
    flags = np.random.default_rng(0).choice([21824, 22280, 55052], (HEIGHT, WIDTH))
    with rasterio.open(source, "r+") as dataset:
        dataset.write(flags.astype(np.uint16), 2)
        dataset.descriptions = ("red", "QA_PIXEL")
    placement = field()
    got, valid = warped(source, placement, resampling="cubic")
    at = truth(placement)
    sure = inside(at, 1.0) & (np.abs(at - np.rint(at)).min(axis=-1) > 0.002)
    column, row = np.floor(at[sure]).astype(int).T
    assert valid[1][sure].all()
    assert (got[1][sure] == flags[row, column]).all()


def test_a_jump_is_cut_and_not_smeared(tmp_path: Path) -> None:
    placement = field(jumps=(30.0,))
    got, valid = warped(write_ramps(tmp_path / "ms.tif"), placement, resampling="cubic")
    rows, columns = np.mgrid[: FINE.shape[0], : FINE.shape[1]] + 0.5
    header_px = np.stack(~HEADER @ (FINE.transform @ (columns, rows)), axis=-1)
    above, below = (
        piece.inverse(header_px.reshape(-1, 2)).reshape(header_px.shape)
        for piece, _, _ in placement.pieces()
    )
    upper, lower = above[..., 1] < 30, below[..., 1] > 30
    gap = ~upper & ~lower & inside(above)
    assert gap.sum() > 150  # rows that were dropped lie nowhere
    near = (np.abs(above[..., 1] - 30) < 0.01) | (np.abs(below[..., 1] - 30) < 0.01)
    assert not valid[0][gap & ~near].any()
    value = np.moveaxis(got, 0, -1)
    for at, here in ((above, upper), (below, lower & ~upper)):
        # a kernel at the cut sees one side only, which bends a ramp within two pixels of it
        sure = here & inside(at) & (np.abs(at[..., 1] - 30) > 2.0)
        assert np.abs(value - at)[sure].max() < 0.0015
        close = here & inside(at) & ~near & (np.abs(at[..., 1] - 30) <= 2.0)
        assert np.abs(value - at)[close].max() < 0.6
