"""Figures: what they show is where it should be, and writing them has no side effects."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from affine import Affine
from matplotlib.image import imread
from numpy.typing import NDArray

from geodelreg.errors import MissingExtraError, OutputExistsError, UsageError
from geodelreg.product.figures import draw_before_after, draw_matches
from geodelreg.values.points import TiePoints
from geodelreg.values.raster import Band, Grid
from tests.unit.alignment_sample import MS_HEADER, PAN_HEADER, UTM16, alignment

KEPT = np.array([255, 207, 51])


def band(shape: tuple[int, int], transform: Affine, name: str = "") -> Band:
    """A black band on a grid."""
    black = np.zeros(shape, dtype=np.float32)
    return Band(black, np.ones(shape, dtype=bool), Grid(transform, shape, UTM16), name)


def texture(shape: tuple[int, int], seed: int = 0) -> NDArray[np.float32]:
    """Smooth random values: a coarse grid, interpolated."""
    rng = np.random.default_rng(seed)
    coarse = rng.normal(size=(shape[0] // 8 + 3, shape[1] // 8 + 3))
    rows = np.linspace(0, coarse.shape[0] - 1.001, shape[0])
    columns = np.linspace(0, coarse.shape[1] - 1.001, shape[1])
    top, left = rows.astype(int), columns.astype(int)
    down, right = (rows - top)[:, None], (columns - left)[None, :]
    upper = coarse[top][:, left] * (1 - right) + coarse[top][:, left + 1] * right
    lower = coarse[top + 1][:, left] * (1 - right) + coarse[top + 1][:, left + 1] * right
    return (upper * (1 - down) + lower * down).astype(np.float32)


def pixels(path: Path) -> NDArray[np.float64]:
    """(H, W, 3) values from 0 to 255."""
    return np.asarray(imread(path), dtype=np.float64)[..., :3] * 255.0


def only(points: TiePoints, *indices: int) -> TiePoints:
    chosen = list(indices)
    return TiePoints(
        points.source_px[chosen],
        points.reference_px[chosen],
        points.covariance_px2[chosen],
        points.score[chosen],
        points.status[chosen],
        points.residual_px[chosen],
    )


# --- matches -------------------------------------------------------------------------------------


def test_a_tie_point_stands_on_its_pixel_in_both_images(tmp_path: Path) -> None:
    """MS is shown as a window read at half size, PAN whole: one point, found by its colour."""
    made = alignment()
    point = only(made.tie_points, 0)  # MS (90.5, 70.25), PAN (365, 282.5)
    ms = band((30, 40), MS_HEADER @ Affine.translation(20, 20) @ Affine.scale(2.0))
    pan = band((320, 400), PAN_HEADER)
    path = tmp_path / "matches.png"
    draw_matches(ms, pan, replace(made, solution=replace(made.solution, tie_points=point)), path)
    image = pixels(path)

    dark = image.max(axis=2) < 60
    columns = np.flatnonzero(dark.mean(axis=0) > 0.5)
    gap = int(np.argmax(np.diff(columns)))
    panels = [(columns[0], columns[gap]), (columns[gap + 1], columns[-1])]
    rows = np.flatnonzero(dark[:, columns].mean(axis=1) > 0.5)
    yellow = np.abs(image - KEPT).max(axis=2) < 40
    marks = np.flatnonzero(yellow.any(axis=0))
    left, right = marks[0], marks[-1]  # the ends of the line that joins them
    expected = [((90.5 - 20) / 80, (70.25 - 20) / 60), (365 / 400, 282.5 / 320)]
    for at, (start, end), (across, down) in zip((left, right), panels, expected, strict=True):
        assert (at - start) / (end - start) == pytest.approx(across, abs=0.02)
        row = np.flatnonzero(yellow[:, at]).mean()
        assert (row - rows[0]) / (rows[-1] - rows[0]) == pytest.approx(down, abs=0.02)


def test_mesh_is_drawn_over_both_images(tmp_path: Path) -> None:
    made = alignment()
    ms, pan = band((80, 100), MS_HEADER), band((320, 400), PAN_HEADER)
    with_mesh, without = tmp_path / "mesh.png", tmp_path / "bare.png"
    draw_matches(ms, pan, made, with_mesh)
    draw_matches(ms, pan, made, without, triangles=np.empty((0, 3), dtype=np.intp))
    blue = [
        (image[..., 2] > image[..., 0] + 60).astype(float)
        for image in (pixels(with_mesh), pixels(without))
    ]
    middle = blue[0].shape[1] // 2
    assert blue[0][:, :middle].sum() > 500
    assert blue[0][:, middle:].sum() > 500
    assert blue[1].sum() == 0


def test_given_triangles_index_all_tie_points(tmp_path: Path) -> None:
    made = alignment()
    ms, pan = band((80, 100), MS_HEADER), band((320, 400), PAN_HEADER)
    draw_matches(ms, pan, made, tmp_path / "own.png", triangles=np.array([[0, 1, 2], [1, 2, 3]]))
    draw_matches(ms, pan, made, tmp_path / "one.png", triangles=np.array([[0, 1, 2]]))
    assert (tmp_path / "own.png").read_bytes() != (tmp_path / "one.png").read_bytes()


@pytest.mark.parametrize("kept", [(), (0,), (1, 2)])
def test_too_few_points_for_a_mesh(tmp_path: Path, kept: tuple[int, ...]) -> None:
    made = alignment()
    few = replace(made, solution=replace(made.solution, tie_points=only(made.tie_points, *kept)))
    ms, pan = band((80, 100), MS_HEADER), band((320, 400), PAN_HEADER)
    draw_matches(ms, pan, few, tmp_path / "few.png")
    assert (pixels(tmp_path / "few.png") < 60).any()


def test_points_on_one_line_have_no_mesh(tmp_path: Path) -> None:
    made = alignment()
    line = replace(
        only(made.tie_points, 0, 1, 2), source_px=np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    )
    draw_matches(
        band((80, 100), MS_HEADER),
        band((320, 400), PAN_HEADER),
        replace(made, solution=replace(made.solution, tie_points=line)),
        tmp_path / "line.png",
    )
    assert (tmp_path / "line.png").exists()


def test_many_points_are_thinned_to_a_spread_of_lines(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform((0, 0), (100, 80), (5000, 2))
    many = TiePoints(
        xy,
        xy * 4,
        np.tile(np.eye(2), (5000, 1, 1)),
        np.ones(5000),
        (rng.random(5000) < 0.3).astype(np.uint8),
        rng.normal(0, 0.1, (5000, 2)),
    )
    made = alignment(tie_points=many)
    draw_matches(
        band((80, 100), MS_HEADER), band((320, 400), PAN_HEADER), made, tmp_path / "many.png"
    )
    image = pixels(tmp_path / "many.png")
    middle = image[:, image.shape[1] // 2]
    lines = np.abs(middle - KEPT).max(axis=1) < 80
    assert 5 < np.count_nonzero(np.diff(lines.astype(int)) == 1) <= 40


# --- before and after ----------------------------------------------------------------------------


def colourfulness(image: NDArray[np.float64]) -> float:
    return float((image.max(axis=2) - image.min(axis=2)).mean())


def test_fringes_vanish_where_the_images_fit(tmp_path: Path) -> None:
    shape = (120, 160)
    scene = texture((160, 200))
    bands = [
        replace(band(shape, PAN_HEADER), data=scene[top : top + 120, left : left + 160])
        for top, left in ((10, 10), (16, 17), (10, 10))
    ]
    path = tmp_path / "before_after.png"
    draw_before_after(*bands, path)
    image = pixels(path)
    height, width = image.shape[:2]
    zooms = image[int(height * 0.6) : int(height * 0.95)]
    before = colourfulness(zooms[:, int(width * 0.05) : int(width * 0.45)])
    after = colourfulness(zooms[:, int(width * 0.55) : int(width * 0.95)])
    assert after < 2.0
    assert before > 20.0


def test_zoom_shows_the_place_with_the_edges(tmp_path: Path) -> None:
    """All edges lie in one corner; the red frame is there."""
    shape = (120, 160)
    data = np.zeros(shape, dtype=np.float32)
    data[85:115, 115:155] = texture((30, 40)) * 100
    ms = replace(band(shape, PAN_HEADER), data=data)
    path = tmp_path / "corner.png"
    draw_before_after(ms, ms, ms, path)
    image = pixels(path)
    half = image[: image.shape[0] // 2, : image.shape[1] // 2]
    frame = np.argwhere(np.abs(half - [209, 73, 91]).max(axis=2) < 12)
    assert (frame.min(axis=0) / half.shape[:2] > (0.5, 0.6)).all()


def test_bands_of_different_shapes_are_refused(tmp_path: Path) -> None:
    one, other = band((20, 20), PAN_HEADER), band((20, 21), PAN_HEADER)
    with pytest.raises(UsageError, match="one shape"):
        draw_before_after(one, other, other, tmp_path / "x.png")


def test_bands_without_a_valid_pixel_are_white(tmp_path: Path) -> None:
    empty = replace(band((40, 40), PAN_HEADER), valid=np.zeros((40, 40), dtype=bool))
    draw_before_after(empty, empty, empty, tmp_path / "empty.png")
    assert pixels(tmp_path / "empty.png").mean() > 240


def draw_sample(path: str | Path, **options: bool) -> None:
    """The tie points of the sample on plain bands."""
    bands = band((80, 100), MS_HEADER), band((320, 400), PAN_HEADER)
    draw_matches(*bands, alignment(), path, **options)


# --- files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_same_values_give_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    for name in ("one", "other"):
        draw_sample(tmp_path / f"{name}{suffix}")
    assert (tmp_path / f"one{suffix}").read_bytes() == (tmp_path / f"other{suffix}").read_bytes()


def test_existing_figure_stays_without_overwrite(tmp_path: Path) -> None:
    path = tmp_path / "matches.png"
    path.write_text("mine")
    with pytest.raises(OutputExistsError):
        draw_sample(path)
    assert path.read_text() == "mine"
    draw_sample(path, overwrite=True)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_unknown_extension_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"Use one of: \.png, \.svg, \.pdf"):
        draw_sample(tmp_path / "matches.bmp")
    assert not list(tmp_path.iterdir())


def test_missing_matplotlib_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[report\]'"):
        draw_sample(tmp_path / "matches.png")


def test_drawing_leaves_no_global_state(tmp_path: Path) -> None:
    code = """
import sys
import matplotlib
from tests.unit.test_figures import draw_sample

names = [name for name in matplotlib.rcParams if name != "backend"]
before = [matplotlib.rcParams[name] for name in names]
draw_sample(sys.argv[1])
assert [matplotlib.rcParams[name] for name in names] == before
assert "matplotlib.pyplot" not in sys.modules
"""
    root = Path(__file__).parents[2]
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "r.png")], cwd=root, check=True)
