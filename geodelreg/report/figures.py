"""Figures of a result, for papers and tickets: drawn by matplotlib as PNG, SVG or PDF."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geodelreg.product.figures import check_drawable, draw_before_after, draw_matches, figure_file
from geodelreg.raster.reader import RasterReader, open_raster
from geodelreg.report import drawing, words
from geodelreg.report.drawing import Canvas
from geodelreg.report.frame import frame_of
from geodelreg.report.pictures import Pictures, fitting_shape, heaviest_band
from geodelreg.report.residuals import error_map, sigma_map
from geodelreg.values.raster import Band, FloatArray, Window
from geodelreg.values.result import Alignment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LONGEST_PX = 1000
_WIDTH_IN = 7.5
_KEPT, _AWAY, _FAINT = "#0b5cad", "#c23b00", "#6b7278"
_MARKS = ("x", "^", "D", "+", "s", ".")


def draw_figure(alignment: Alignment, kind: str, path: Path, overwrite: bool = False) -> None:
    """Draw a figure of an alignment, refused or not.

    Parameters
    ----------
    alignment : Alignment
        Its rasters are read again.
    kind : str
        One of `FIGURES`.
    path : Path
        Its extension is the format; ``-`` is PNG on standard output.
    overwrite : bool

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    OutputExistsError, OutputUnwritableError, FileLockedError
    GeodelregError
        Its other kinds, when a raster cannot be read again.
    """
    check_drawable(path)
    options = alignment.options
    with (
        open_raster(alignment.source.paths, allow=options.allow) as ms,
        open_raster(alignment.reference.paths[0], allow=options.allow) as pan,
    ):
        if kind == "matches":
            bands = _overview(ms, heaviest_band(ms, alignment)), _overview(pan, options.pan_band)
            draw_matches(*bands, alignment, path, overwrite=overwrite)
            return
        frame = frame_of(alignment)
        canvas = Canvas(frame.window, fitting_shape(frame.window, _LONGEST_PX))
        if kind == "before-after":
            pictures = Pictures(ms, pan, alignment, frame)
            after = words.AFTER[alignment.verdict.outcome]
            three = pictures.bands(frame.window, canvas.shape)
            draw_before_after(*three, path, after=after, overwrite=overwrite)
            return
        image = _stretched(pan.read([options.pan_band], frame.window, canvas.shape)[0])
    width, height = _size(canvas)
    size = (1.5 * width, 0.75 * height + 0.4) if kind == "error" else (width, height)
    with figure_file(path, size, overwrite) as figure:
        _DRAW[kind](figure, alignment, canvas, image)


def _draw_arrows(figure: Figure, alignment: Alignment, canvas: Canvas, image: FloatArray) -> None:
    axes = _over(figure.add_subplot(), image)
    found = drawing.arrows(alignment.tie_points, canvas)
    step = found.end - found.start
    for mask, colour, label in (
        (~found.kept, _AWAY, "matched elsewhere"),
        (found.kept, _KEPT, "kept"),
    ):
        quiver = axes.quiver(
            *found.start[mask].T, *step[mask].T, color=colour, angles="xy", scale_units="xy",
            scale=1.0, width=0.0025, label=f"{int(mask.sum())} {label}",
        )  # fmt: skip
    axes.quiverkey(quiver, 0.84, 1.02, found.key_length, f"{found.key_px:g} PAN px", labelpos="E")
    axes.set_title("What the correction leaves", loc="left")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.01), ncols=2, fontsize=8)


def _draw_mesh(figure: Figure, alignment: Alignment, canvas: Canvas, image: FloatArray) -> None:
    axes = _over(figure.add_subplot(), image)
    points = alignment.tie_points
    at, triangles = canvas.at(points.reference_px), drawing.mesh(points)
    if len(triangles):
        axes.triplot(*at.T, triangles, color=_KEPT, lw=0.6)
    axes.plot(*at[points.kept].T, "o", c=_KEPT, ms=2.5, label=f"{points.kept.sum()} kept")
    reasons = drawing.by_reason(points).items()
    for (status, index), mark in zip(reasons, _MARKS * 2, strict=False):
        colour = _AWAY if words.is_telling(status) else _FAINT
        label = f"{len(index)} {words.STATUS[status]}"
        axes.plot(*at[index].T, mark, c=colour, ms=4, mfc="none", label=label)
    axes.set_title("Mesh of the tie points", loc="left")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.01), ncols=2, fontsize=8)


def _draw_error(figure: Figure, alignment: Alignment, canvas: Canvas, image: FloatArray) -> None:
    frame = frame_of(alignment)
    maps = {
        "What is left (PAN px)": error_map(alignment.tie_points, frame),
        "Standard error of the correction (PAN px)": sigma_map(alignment.tie_points, frame),
    }
    height, width = canvas.shape
    for axes, (title, values) in zip(figure.subplots(1, 2), maps.items(), strict=True):
        _over(axes, image).set_title(title, loc="left")
        if not np.isfinite(values).any():
            axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center")
            continue
        shown = axes.imshow(
            values, extent=(-0.5, width - 0.5, height - 0.5, -0.5), cmap="cividis", alpha=0.8,
            vmin=0.0, vmax=max(float(np.nanmax(values)), 1e-3),
        )  # fmt: skip
        figure.colorbar(shown, ax=axes, shrink=0.8)


def _overview(reader: RasterReader, number: int) -> Band:
    height, width = reader.grid.shape
    window = Window(0, 0, width, height)
    return reader.read([number], window, fitting_shape(window, _LONGEST_PX))[0]


def _stretched(band: Band) -> FloatArray:
    """Values as 0 … 1; NaN where not valid."""
    low, high = np.percentile(band.data[band.valid], (1, 99)) if band.valid.any() else (0.0, 1.0)
    image = np.clip((band.data - low) / max(high - low, 1e-12), 0.0, 1.0)
    return np.where(band.valid, image, np.nan)


def _over(axes: Axes, image: FloatArray) -> Axes:
    """Axes over a pale picture of PAN."""
    axes.imshow(image, cmap="gray", vmin=-0.6, vmax=1.0, alpha=0.6)
    axes.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    axes.set_axis_off()
    return axes


def _size(canvas: Canvas) -> tuple[float, float]:
    height, width = canvas.shape
    return _WIDTH_IN, min(_WIDTH_IN * height / width, 2 * _WIDTH_IN) + 0.8


_DRAW: dict[str, Callable[[Figure, Alignment, Canvas, FloatArray], None]] = {
    "arrows": _draw_arrows,
    "mesh": _draw_mesh,
    "error": _draw_error,
}
