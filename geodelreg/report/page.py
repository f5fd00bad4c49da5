"""The page of one pair: an alignment, refused or not, to look at."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geodelreg.flags import as_typed
from geodelreg.options import AlignOptions
from geodelreg.product.check import Check
from geodelreg.product.report import short
from geodelreg.raster.reader import open_raster
from geodelreg.report import drawing, words
from geodelreg.report.drawing import Canvas
from geodelreg.report.frame import Frame, frame_of
from geodelreg.report.html import render
from geodelreg.report.pictures import Look, Pictures, data_uri, fitting_shape
from geodelreg.report.places import Place, part_of, places
from geodelreg.report.residuals import cells, error_map, sigma_map
from geodelreg.values.raster import FloatArray
from geodelreg.values.result import Alignment

_LONGEST_PX = 800
_ALPHA = 205
"""Of a map over its picture, of 255."""
_TITLES = {
    "worst": "Worst place",
    "typical": "Typical place",
    "best": "Best place",
    "middle": "Middle of the common ground",
    "unmatched": "Where nothing matched",
}
_SHAPES = ("cross", "triangle", "diamond", "plus", "ring", "dot")
_PLACE_MARKS = "1234"


def page(alignment: Alignment, check: Check | None = None) -> str:
    """The page as text: the same alignment of the same rasters gives the same text.

    Parameters
    ----------
    alignment : Alignment
        Its rasters are read again.
    check : Check, optional
        What was asked of the alignment, when that was whether MS lies where PAN says.

    Raises
    ------
    GeodelregError
        When a raster cannot be read again.
    """
    frame = frame_of(alignment)
    chosen = places(alignment.tie_points, frame)
    options = alignment.options
    with (
        open_raster(alignment.source.paths, allow=options.allow) as ms,
        open_raster(alignment.reference.paths[0], allow=options.allow) as pan,
    ):
        pictures = Pictures(ms, pan, alignment, frame)
        canvas = Canvas.of(frame.window, _LONGEST_PX)
        whole = pictures.look(frame.window, fitting_shape(frame.window, _LONGEST_PX))
        closely = [
            pictures.look(place.window, (place.window.height, place.window.width))
            for place in chosen
        ]
        bands = _bands(ms.band_names, alignment)
        shown = pictures.shown
    after = words.AFTER[alignment.verdict.outcome] if check is None else "as measured"
    return render(
        "report.html",
        ["base.css", "report.css"],
        ["report.js"],
        ms=words.names(alignment.source.paths),
        pan=words.names(alignment.reference.paths),
        outcome=(check or alignment.verdict).outcome.value,
        headline=words.headline(alignment, check),
        story=words.story(alignment, check),
        advice=words.advice(alignment, check),
        cards=list(_cards(alignment)),
        after=after,
        shown=shown,
        looks=[
            {"title": "The whole overlap", "told": "", **_look(whole), "whole": True},
            *(_closely(*pair) for pair in zip(chosen, closely, strict=True)),
        ],
        width=canvas.shape[1],
        height=canvas.shape[0],
        base=data_uri(whole.pan),
        boxes=[
            (mark, *canvas.box(place.window))
            for mark, place in zip(_PLACE_MARKS, chosen, strict=False)
            if place.name != "middle"
        ],
        arrows=_arrows(alignment, canvas),
        mesh=drawing.mesh_path(alignment.tie_points, canvas),
        kept=drawing.marks(_places_of(alignment, canvas, None), "dot"),
        kept_count=int(alignment.tie_points.kept.sum()),
        rejected=_rejected(alignment, canvas),
        points=len(alignment.tie_points),
        maps=list(_maps(alignment, frame)),
        bars=words.bars(alignment),
        bands=bands,
        checked=[] if check is None else check.bands or [],
        steps=_steps(alignment),
        warnings=[as_typed(warning) for warning in alignment.warnings],
        accuracy=_accuracy(alignment),
        masks=alignment.masks,
        inputs=list(_inputs(alignment)),
        command=words.command(alignment),
        options=_options(options),
        versions=dict(sorted(alignment.versions.items())),
        crs_operation=alignment.crs_operation,
        short=short,
    )


def _look(look: Look) -> dict[str, Any]:
    views = ("pan", "before", "after", "over_before", "over_after")
    height, width = look.pan.shape[:2]
    images = [(view, data_uri(getattr(look, view))) for view in views]
    return {"images": images, "width": width, "height": height}


def _closely(place: Place, look: Look) -> dict[str, Any]:
    told = f"In the {place.where}: no point tells what is left here."
    if math.isfinite(place.distance_px):
        told = (
            f"In the {place.where}: after the correction MS lies {short(place.distance_px)} PAN px "
            f"off ({words.direction(place.residual_px)}) in the median of the points there."
        )
    window = place.window
    columns = f"{window.column} to {window.column + window.width}"
    rows = f"{window.row} to {window.row + window.height}"
    return {
        "title": _TITLES[place.name],
        "told": f"{told} PAN columns {columns}, rows {rows}.",
        **_look(look),
        "whole": False,
    }


def _cards(alignment: Alignment) -> Iterator[tuple[str, str, str]]:
    """Label, number and what it means."""
    accuracy, points = alignment.accuracy, alignment.tie_points
    yield "Error before", _px(accuracy.before_rmse_px), "RMSE at the kept tie points, as delivered"
    yield "Uncertainty", _px(accuracy.uncertainty_px), "of the correction, 95 % at the worst corner"
    bend = accuracy.residual_rms_px
    told = "RMS of the ground's bend that is left" if math.isfinite(bend) else "not measured"
    yield "Residual misregistration", _px(bend), told
    yield "Patch scatter", _px(accuracy.check_rmse_px), "RMS, the noise of single matches"
    kept = int(points.kept.sum()) or accuracy.kept
    yield "Tie points", f"{kept}", f"kept of {len(points)} tried" if len(points) else "kept"
    if math.isfinite(accuracy.coverage):
        yield "Spread", f"{100 * accuracy.coverage:.0f} %", "of the overlap lies between them"


def _px(value: float) -> str:
    return f"{short(value)} px" if math.isfinite(value) else "unknown"


def _arrows(alignment: Alignment, canvas: Canvas) -> dict[str, Any]:
    found = drawing.arrows(alignment.tie_points, canvas)
    return {
        "kept": drawing.arrow_path(found.start[found.kept], found.end[found.kept]),
        "away": drawing.arrow_path(found.start[~found.kept], found.end[~found.kept]),
        "count": int(found.kept.sum()),
        "away_count": int((~found.kept).sum()),
        "key": f"{found.key_px:g} PAN px",
        "key_path": drawing.arrow_path(
            np.array([[0.0, 10.0]]), np.array([[found.key_length, 10.0]])
        ),
        "key_length": found.key_length,
        "magnified": short(found.magnified),
    }


def _places_of(alignment: Alignment, canvas: Canvas, index: NDArray[np.intp] | None) -> FloatArray:
    points = alignment.tie_points
    some = np.flatnonzero(points.kept) if index is None else index
    return canvas.at(points.reference_px[drawing.spread(points.reference_px, some, 3000)])


def _rejected(alignment: Alignment, canvas: Canvas) -> list[dict[str, Any]]:
    return [
        {
            "key": status.name.lower(),
            "words": words.STATUS[status],
            "count": len(index),
            "path": drawing.marks(_places_of(alignment, canvas, index), shape),
            "shape": drawing.marks(np.array([[8.0, 8.0]]), shape),
            "shown": words.is_telling(status),
        }
        for (status, index), shape in zip(
            drawing.by_reason(alignment.tie_points).items(), _SHAPES * 2, strict=False
        )
    ]


def _maps(alignment: Alignment, frame: Frame) -> Iterator[dict[str, Any]]:
    points, at = alignment.tie_points, cells(frame)
    limit = alignment.options.max_residual_px
    for title, told, values in (
        (
            "What is left",
            "Median residual of the points around each place, those that lie elsewhere included",
            error_map(points, frame),
        ),
        (
            "How sure it is",
            "Standard error if the model holds (blank where the points around do not support it)",
            sigma_map(points, frame),
        ),
    ):
        if not np.isfinite(values).any():
            continue
        worst = np.unravel_index(int(np.nanargmax(values)), values.shape)
        most = max(float(np.nanpercentile(values, 99)), limit)
        yield {
            "title": title,
            "told": f"{told}, PAN pixels. Median {short(float(np.nanmedian(values)))}; most, "
            f"{short(float(values[worst]))}, {part_of(at[worst], frame.window)}.",
            "uri": data_uri(_coloured(values / most), lossless=True),
            "legend": data_uri(_coloured(np.linspace(0.0, 1.0, 128)[None]), lossless=True),
            "most": short(most) + (" or more" if values[worst] > 1.005 * most else ""),
            "half": short(most / 2),
        }


def _coloured(share: FloatArray) -> NDArray[np.uint8]:
    """(H, W, 4) colours of 0 … 1, dark to bright also in grey; nothing where not known."""
    known = np.isfinite(share)
    level = np.round(255 * np.clip(np.where(known, share, 0.0), 0.0, 1.0)).astype(np.uint8)
    colour = cv2.applyColorMap(level, cv2.COLORMAP_CIVIDIS)[..., ::-1]
    return np.dstack([colour, np.where(known, _ALPHA, 0)]).astype(np.uint8)


def _bands(names: tuple[str, ...], alignment: Alignment) -> list[tuple[str, float | None]]:
    """Bands of MS with their weights; None of those that were not matched on."""
    weights = alignment.solution.band_weights
    return [(name, weights.get(name)) for name in names]


def _steps(alignment: Alignment) -> list[tuple[str, int, float]]:
    """Each step with the points that survive it, and their share of the most."""
    counts = alignment.solution.step_counts
    most = max(counts.values(), default=0) or 1
    return [(step, count, count / most) for step, count in counts.items()]


def _accuracy(alignment: Alignment) -> list[tuple[str, str]]:
    values = asdict(alignment.accuracy)
    texts = {
        name: str(value)
        if isinstance(value, int)
        else " to ".join(map(short, np.atleast_1d(value)))
        for name, value in values.items()
    }
    return [(name, text) for name, text in texts.items() if "unknown" not in text]


def _inputs(alignment: Alignment) -> Iterator[dict[str, Any]]:
    for role, given in (("MS", alignment.source), ("PAN", alignment.reference)):
        for path, digest in zip(given.paths, given.fingerprints, strict=True):
            height, width = given.grid.shape
            yield {
                "role": role, "path": path, "digest": digest or "none: not a local file",
                "size": f"{width} × {height}",
            }  # fmt: skip


def _options(options: AlignOptions) -> list[tuple[str, str]]:
    """Options that were not left as they are."""
    defaults = AlignOptions()
    return [
        (field.name, str(getattr(options, field.name)))
        for field in fields(AlignOptions)
        if field.name != "threads" and getattr(options, field.name) != getattr(defaults, field.name)
    ]
