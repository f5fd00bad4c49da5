"""Where to look, and how finely: the header overlap, the same finer, both rasters whole."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from geodelreg.geo.footprint import overlap_windows
from geodelreg.pair import Pair
from geodelreg.values.points import Overview, Scope
from geodelreg.values.raster import Window

_FIRST_BUDGET_PX = 250_000  # 500²; by hand: ½ to 2 × alike
_FINER_BUDGET_PX = 1_000_000  # 1000²: twice as fine
SECOND_BUDGET_PX = 1_600_000  # 1265²; by hand: ½ to 2 × alike
_FIRST_KEYPOINTS = 1500  # of each image, a quarter of what is asked for; by hand: ½ to 2 × alike
_FINER = 1.01  # times finer; less is rounding to whole pixels


def scopes(pair: Pair) -> Iterator[Scope]:
    """The header overlap grown by the search radius, the same finer, then both rasters whole."""
    source, reference = pair.source.grid, pair.reference.grid
    most = pair.options.max_keypoints
    few = max(min(most, _FIRST_KEYPOINTS), most // 4)
    windows = overlap_windows(source, reference, pair.options.search_radius_px)
    whole = tuple(Window(0, 0, grid.shape[1], grid.shape[0]) for grid in (source, reference))
    if windows is not None:
        first = Scope(*windows, _FIRST_BUDGET_PX, few, "header overlap")
        yield first
        if working_gsd_m(pair, first) > _FINER * max(*pair.source_gsd_m, *pair.reference_gsd_m):
            yield Scope(*windows, _FINER_BUDGET_PX, most, "header overlap, finer", is_closer=True)
    if windows != whole:
        name = "both rasters whole"
        yield Scope(whole[0], whole[1], SECOND_BUDGET_PX, most, name, is_whole=True)


def working_gsd_m(pair: Pair, scope: Scope) -> float:
    """Ground sampling distance at which both images of a scope fit its budget."""
    areas = [
        window.width * window.height * gsd[0] * gsd[1]
        for window, gsd in (
            (scope.source, pair.source_gsd_m),
            (scope.reference, pair.reference_gsd_m),
        )
    ]
    least = float(np.sqrt(max(areas) / scope.budget_px))
    return max(*pair.source_gsd_m, *pair.reference_gsd_m, least)


def overview_shapes(pair: Pair, scope: Scope) -> tuple[tuple[int, int], tuple[int, int]]:
    """(height, width) of both images of a scope at one ground sampling distance."""
    gsd_m = working_gsd_m(pair, scope)
    return (
        _shape(scope.source, pair.source_gsd_m, gsd_m),
        _shape(scope.reference, pair.reference_gsd_m, gsd_m),
    )


def read_overview(pair: Pair, scope: Scope) -> Overview:
    """Read both images of a scope at one ground sampling distance.

    Matching at the coarser of two resolutions costs a fraction of matching at the finer one, and
    finds more.
    """
    shapes = overview_shapes(pair, scope)
    with pair.timings("read"), ThreadPoolExecutor(1) as aside:
        source = aside.submit(pair.source.read, pair.source_bands, scope.source, shapes[0])
        reference = pair.reference.read([pair.options.pan_band], scope.reference, shapes[1])
        return Overview(source.result(), reference[0], scope)


def _shape(window: Window, gsd_m: tuple[float, float], target_m: float) -> tuple[int, int]:
    height = round(window.height * gsd_m[1] / target_m)
    width = round(window.width * gsd_m[0] / target_m)
    return min(max(height, 1), window.height), min(max(width, 1), window.width)
