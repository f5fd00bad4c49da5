"""Figures of an alignment, as PNG, SVG or PDF by the extension of the path.

They are drawn on `matplotlib.figure.Figure` without pyplot, so no global state is touched, and
carry no dates: the same values give the same file.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.errors import MissingExtraError, UsageError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geotiff.atomic import write_bytes_atomically
from geodelreg.geotiff.targets import STDOUT
from geodelreg.values.raster import Band, FloatArray, Grid, IntArray
from geodelreg.values.result import Alignment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FORMATS = (".png", ".svg", ".pdf")
_KEPT = "#ffcf33"
_MESH = "#35d0ff"
_REJECTED = "#ff4d4d"
_INK = "#1f4e79"
_ACCENT = "#d1495b"
_LINES_AT_MOST = 40
_ARROWS_AT_MOST = 1200
_TILES = 6
_MIDDLE_GREY = 0.42
_STYLE: Any = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "geodelreg",
}


def _suffix(path: Path) -> str:
    return ".png" if path == STDOUT else path.suffix.lower()


def check_drawable(path: Path) -> None:
    """Refuse a figure that cannot be drawn, before there is anything to draw.

    Raises
    ------
    MissingExtraError, UsageError
    """
    if find_spec("matplotlib") is None:
        raise MissingExtraError(
            f"{path.name}: figures need matplotlib",
            "Install it: pip install matplotlib (in a clone: pip install '.[report]').",
        )
    suffix = _suffix(path)
    if suffix not in _FORMATS:
        raise UsageError(
            f"{path.name}: figures are not written as {suffix or 'files without extension'}",
            f"Use one of: {', '.join(_FORMATS)}.",
        )


@contextmanager
def figure_file(path: Path, size_in: tuple[float, float], overwrite: bool) -> Iterator[Figure]:
    """Figure that is written to `path`, whole or not at all, when the block ends; PNG to ``-``.

    Raises
    ------
    MissingExtraError, UsageError, OutputExistsError, OutputUnwritableError, FileLockedError
    """
    check_drawable(path)
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    suffix = _suffix(path)
    with rc_context(_STYLE):
        figure = Figure(figsize=size_in, layout="constrained")
        yield figure
        dates = {"Software": None} if suffix == ".png" else {"Date": None}
        if suffix == ".pdf":
            dates = {"CreationDate": None}
        drawn = BytesIO()
        figure.savefig(drawn, dpi=150, metadata=dates, format=suffix[1:])
        write_bytes_atomically(path, drawn.getvalue(), overwrite)


def draw_matches(
    ms_band: Band,
    pan_band: Band,
    alignment: Alignment,
    path: str | Path,
    *,
    triangles: IntArray | None = None,
    overwrite: bool = False,
) -> None:
    """Both images side by side, tie points joined, with the Delaunay mesh over each.

    After Zhang et al. 2013, Fig. 5.

    Parameters
    ----------
    ms_band, pan_band : Band
        What to show of each raster; windows and decimated reads are placed by their grids.
    alignment : Alignment
        Its tie points; kept ones are joined by lines (a spread of 40 of them), rejected ones faint.
    path : str or Path
    triangles : (T, 3) intp, optional
        Mesh, as indices into all tie points; Delaunay's of the kept ones when not given.
    overwrite : bool

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    points = alignment.tie_points
    sides = [
        (ms_band, _shown(points.source_px, alignment.source.grid, ms_band.grid)),
        (pan_band, _shown(points.reference_px, alignment.reference.grid, pan_band.grid)),
    ]
    # both panels are one unit high
    widths = [band.data.shape[1] / band.data.shape[0] for band, _ in sides]
    gap = 0.06 * sum(widths)
    total = sum(widths) + gap
    with figure_file(Path(path), (11.0, min(11.0 / total, 9.0) + 0.35), overwrite) as figure:
        axes = figure.add_subplot()
        if triangles is None:
            triangles = _delaunay(points.source_px, np.flatnonzero(points.kept))
        places = []
        for (band, xy), left in zip(sides, (0.0, widths[0] + gap), strict=True):
            height = band.data.shape[0]
            _show(axes, band, (left, left + band.data.shape[1] / height, 1.0, 0.0))
            places.append(xy / height + np.array([left, 0.0]))
            _draw_mesh(axes, places[-1], triangles, points.kept)
        _draw_joins(axes, places[0], places[1], points.kept)
        axes.set(xlim=(0.0, total), ylim=(1.0, 0.0), aspect="equal")
        axes.set_axis_off()
        kept = int(np.count_nonzero(points.kept))
        axes.set_title(
            f"{ms_band.name or 'MS'}  ↔  {pan_band.name or 'PAN'}:  "
            f"{kept} of {len(points)} tie points kept, {len(triangles)} triangles"
        )


def _shown(px: FloatArray, raster: Grid, shown: Grid) -> FloatArray:
    """Raster pixels to pixels of the window or the decimated read that is shown."""
    return apply_affine(~shown.transform @ raster.transform, px)


def _delaunay(xy: FloatArray, indices: IntArray) -> IntArray:
    from matplotlib.tri import Triangulation

    try:
        triangles = Triangulation(*xy[indices].T).triangles
    except (RuntimeError, ValueError):  # fewer than three points, or all on one line
        return np.empty((0, 3), dtype=np.intp)
    return np.asarray(indices[triangles], dtype=np.intp)


def _show(axes: Axes, band: Band, extent: tuple[float, float, float, float]) -> None:
    axes.imshow(_grey(band), extent=extent, cmap="gray", vmin=0.0, vmax=1.0, interpolation="none")


def _grey(band: Band) -> FloatArray:
    """Values stretched to 0…1, the median to a middle grey; NaN where not valid."""
    image: FloatArray = np.where(band.valid, band.data, np.nan).astype(np.float64)
    if not band.valid.any():
        return image
    low, middle, high = np.percentile(band.data[band.valid], (1.0, 50.0, 99.0))
    image = np.clip((image - low) / max(high - low, 1e-12), 0.0, 1.0)
    median = np.clip((middle - low) / max(high - low, 1e-12), 0.05, 0.7)
    stretched: FloatArray = image ** (np.log(_MIDDLE_GREY) / np.log(median))
    return stretched


def _draw_mesh(axes: Axes, xy: FloatArray, triangles: IntArray, kept: NDArray[np.bool_]) -> None:
    dense = len(triangles) > 600
    if len(triangles):
        axes.triplot(
            xy[:, 0], xy[:, 1], triangles, color=_MESH, lw=0.4 if dense else 0.7, alpha=0.65
        )
    size = 2.0 if dense else 9.0
    (x, y), (x_out, y_out) = xy[kept].T, xy[~kept].T
    axes.scatter(x_out, y_out, s=2 * size, marker="x", c=_REJECTED, lw=0.7, alpha=0.45, zorder=3)
    axes.scatter(x, y, s=size, c=_KEPT, ec="black", lw=0.3, zorder=4)


def _draw_joins(axes: Axes, left: FloatArray, right: FloatArray, kept: NDArray[np.bool_]) -> None:
    from matplotlib.collections import LineCollection

    for mask, colour, width, alpha, count in (
        (~kept, _REJECTED, 0.5, 0.25, _LINES_AT_MOST // 2),
        (kept, _KEPT, 0.8, 0.8, _LINES_AT_MOST),
    ):
        chosen = _spread(left, np.flatnonzero(mask), count)
        segments = np.stack([left[chosen], right[chosen]], axis=1)
        axes.add_collection(LineCollection(list(segments), colors=colour, lw=width, alpha=alpha))


def _spread(xy: FloatArray, indices: IntArray, count: int) -> IntArray:
    """At most `count` of the points, far from each other (farthest point first), deterministic."""
    if len(indices) <= count:
        return indices
    places = xy[indices]
    chosen = [int(np.argmin(places.sum(axis=1)))]
    distance = np.full(len(places), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.hypot(*(places - places[chosen[-1]]).T))
        chosen.append(int(np.argmax(distance)))
    return indices[chosen]


def draw_before_after(
    pan: Band,
    ms_before: Band,
    ms_after: Band,
    path: str | Path,
    *,
    after: str = "corrected",
    overwrite: bool = False,
) -> None:
    """PAN and MS woven into a checkerboard, under the original and under the corrected header.

    The second row zooms into the place with the strongest edges and lays PAN (orange) over MS
    (blue), colours that the colour-blind tell apart: what does not fit shows as coloured fringes.

    Parameters
    ----------
    pan, ms_before, ms_after : Band
        On one pixel grid: MS as it falls on PAN's pixels before and after the correction.
    path : str or Path
    after : str
        What MS is called after the correction.
    overwrite : bool

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    UsageError
        If the three shapes differ.
    """
    if not pan.data.shape == ms_before.data.shape == ms_after.data.shape:
        raise UsageError("before/after figures need three bands of one shape")
    height, width = pan.data.shape
    rows, columns = _busiest(ms_after, max(height // 4, 16), max(width // 4, 16))
    with figure_file(Path(path), (11.0, 11.0 * height / width + 0.8), overwrite) as figure:
        grid = figure.subplots(2, 2)
        for column, (title, ms) in enumerate((("as delivered", ms_before), (after, ms_after))):
            woven, zoom = grid[0, column], grid[1, column]
            woven.imshow(_checkerboard(pan, ms), interpolation="none")
            woven.set_title(f"{title}: PAN (grey) and MS (tinted) in turns")
            zoom.imshow(_fringes(pan, ms, rows, columns), interpolation="none")
            zoom.set_title(f"{title}: zoom, PAN orange over MS blue")
            _outline(woven, rows, columns)
            for axes in (woven, zoom):
                axes.set_axis_off()


def draw_tie_points(alignment: Alignment, axes: Axes | None = None) -> Axes:
    """Tie points where PAN shows them; arrows show how far off MS lay, colours what is left.

    Parameters
    ----------
    alignment : Alignment
    axes : matplotlib.axes.Axes, optional
        A new figure of pyplot when not given.

    Returns
    -------
    matplotlib.axes.Axes
        In map coordinates of PAN.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise MissingExtraError("plots need matplotlib", "Install it: pip install matplotlib.")
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(layout="constrained")[1]
    points, source, pan = alignment.tie_points, alignment.source.grid, alignment.reference.grid
    ground = apply_affine(pan.transform, points.reference_px)
    header = apply_affine(source.transform, points.source_px)
    off = map_points(header, source.crs_wkt, pan.crs_wkt) - ground
    kept = points.kept
    x, y = ground[~kept].T
    axes.scatter(x, y, s=8, marker="x", c=_REJECTED, lw=0.6, alpha=0.5)
    chosen = _spread(ground, np.flatnonzero(kept), _ARROWS_AT_MOST)
    left = np.hypot(*points.residual_px[chosen].T)
    x, y = ground[chosen].T
    axes.quiver(x, y, *-off[chosen].T, color=_INK, angles="xy", width=0.003)
    dots = axes.scatter(x, y, s=14, c=left, cmap="viridis", vmin=0.0, zorder=3)
    axes.figure.colorbar(dots, ax=axes, label="left after the correction, PAN px")
    longest = float(np.hypot(*off[kept].T).max()) if kept.any() else 0.0
    axes.set_title(
        f"{np.count_nonzero(kept)} tie points; MS moves by up to {longest:.3g} map units"
    )
    axes.set_aspect("equal")
    return axes


def _busiest(band: Band, height: int, width: int) -> tuple[slice, slice]:
    """Block of the given size with the largest mean gradient."""
    down, right = np.gradient(np.nan_to_num(_grey(band)))
    strength = np.where(band.valid, np.hypot(down, right), 0.0)
    total = np.pad(strength.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = (
        total[height:, width:]
        - total[:-height, width:]
        - total[height:, :-width]
        + total[:-height, :-width]
    )
    top, left = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)


def _like(band: Band, model: Band) -> FloatArray:
    """Values of a band stretched so that its mean and deviation are those of the model's grey."""
    grey, target = _grey(band), _grey(model)
    both = band.valid & model.valid
    if not both.any():
        return grey
    spread = max(float(grey[both].std()), 1e-6)
    matched = (grey - grey[both].mean()) * (target[both].std() / spread) + target[both].mean()
    clipped: FloatArray = np.clip(matched, 0.0, 1.0)
    return clipped


def _checkerboard(pan: Band, ms: Band) -> NDArray[Any]:
    height, width = pan.data.shape
    side = max(1, round(min(height, width) / _TILES))
    rows, columns = np.indices((height, width)) // side
    tint = np.array([1.0, 0.93, 0.72])
    grey, tinted = _grey(pan)[..., None] * np.ones(3), _like(ms, pan)[..., None] * tint
    image = np.where(((rows + columns) % 2 == 0)[..., None], grey, tinted)
    return np.nan_to_num(image, nan=1.0)


def _fringes(pan: Band, ms: Band, rows: slice, columns: slice) -> NDArray[Any]:
    one, other = _grey(pan)[rows, columns], _like(ms, pan)[rows, columns]
    return np.nan_to_num(np.stack([one, (one + other) / 2, other], axis=-1), nan=1.0)


def _outline(axes: Axes, rows: slice, columns: slice) -> None:
    from matplotlib.patches import Rectangle

    size = (columns.stop - columns.start, rows.stop - rows.start)
    axes.add_patch(
        Rectangle((columns.start - 0.5, rows.start - 0.5), *size, fill=False, ec=_ACCENT, lw=1.5)
    )
