"""Rules of the method: how each is switched off, and where it can be seen to decide something.

What stands here are names of the package that no one else may use: a rule that goes, goes here too.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pkgutil import walk_packages
from typing import Any
from unittest import mock

import numpy as np

import geodelreg
from geodelreg.fine.looks import PLAIN, SHARPER
from geodelreg.fine.tuning import DEFAULT_SIGMA
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.values.points import Guess, Status

Off = Callable[[Any], Any]
"""What stands in the place of something."""
Seen = Callable[[Any, tuple[Any, ...]], Any]
"""Of a function's result and arguments: whether the rule decided something."""


@dataclass(frozen=True, eq=False)
class Rule:
    """One rule.

    Attributes
    ----------
    name : str
        What it does.
    off : dict of str to callable
        Names in the package, and what stands in their place.
    seen : dict of str to callable
        Functions in which it can be seen to decide; of none it is taken to decide everywhere.
    """

    name: str
    off: dict[str, Off]
    seen: dict[str, Seen]


def _is(value: Any) -> Off:
    """A constant, or another function."""
    return lambda original: value


def _says(value: Any) -> Off:
    """A function that returns a value, whatever it is asked."""
    return lambda original: lambda *args, **options: value


def _returns(number: int) -> Off:
    """A function that returns one of its arguments."""
    return lambda original: lambda *args: args[number]


def _first_of(original: Any) -> Any:
    return lambda *args: [next(iter(original(*args)))]


def _scopes(keep: Callable[[Any], bool]) -> Off:
    def off(original: Any) -> Any:
        return lambda pair: (s for n, s in enumerate(original(pair)) if n == 0 or keep(s))

    return off


def _no_guess(pair: Any, images: Any) -> Guess:
    """One that is passed over."""
    return Guess(AffineMap.of(np.zeros((2, 3))), np.nan, {}, images)


def _by_gdal(self: Any, numbers: Any, window: Any, shape: Any, overview: int | None) -> Any:
    """`read_decimated` as GDAL averages."""
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    got = self.dataset.read(
        list(numbers), window=Window(*window), out_shape=(len(numbers), *shape),
        resampling=Resampling.average, masked=True, out_dtype="float32",
    )  # fmt: skip
    valid = ~np.ma.getmaskarray(got) & np.isfinite(got.data)
    return np.where(valid, got.data, 0).astype(np.float32), valid


def _plain_tone(original: Any) -> Any:
    from geodelreg.fine import tone

    def plain(bands: Any, target: Any) -> Any:
        x, y = bands.astype(np.float64), target.astype(np.float64)
        return tone._reweighted(x, y, np.ones(y.shape))[:2]

    return plain


def _called(r: Any, a: Any) -> bool:
    return True


def _some(r: Any, a: Any) -> bool:
    return r is not None


def _yes(r: Any, a: Any) -> bool:
    return bool(r)


def _other(number: int) -> Seen:
    """Another result than one of the arguments."""
    return lambda r, a: r is not a[number] and r != a[number]


_G, _F = "geodelreg.coarse.guesses.", "geodelreg.fine."
_P, _T, _J = _F + "passes.", "geodelreg.fit.", "geodelreg.judge."
_SCOPES = "geodelreg.coarse.scopes.scopes"


def _rule(name: str, place: str, off: Off, seen: Seen) -> Rule:
    return Rule(name, {place: off}, {place: seen})


# fmt: off
RULES = (
    _rule("header first", _G + "proven_guess", _says(None), _some),
    _rule("bright objects", _G + "bright_mask", _says(None), _some),
    _rule("calm keypoints: all areas do", _G + "is_calm_guess", _says(False), _yes),
    _rule("keypoints off bright objects first", _G + "in_doubt",
          _is(lambda g, e, px: [one for one in (e, g) if one is not None][:1]),
          lambda r, a: a[0] is not None and any(one is a[0] for one in r)),
    Rule("other bands for keypoints", {_G + "band_looks": _first_of},
         {_G + "_detect_both": lambda r, a: a[2].name.count(",") != 2}),
    Rule("the same, closer", {_SCOPES: _scopes(lambda s: not s.is_closer)},
         {_G + "_likely": _called}),
    Rule("both rasters whole", {_SCOPES: _scopes(lambda s: not s.is_whole)},
         {_G + "read_overview": lambda r, a: a[1].is_whole}),
    _rule("a shift by edges in the end", _G + "edge_guess", _is(_no_guess), _called),
    _rule("bands that show too little left out", _G + "_with_content",
          _is(lambda pair, images: (pair, images)), lambda r, a: r[0] is not a[0]),
    _rule("mesh of keypoints", _G + "filter_matches",
          _is(lambda s, r, f: np.where(f.inliers, Status.KEPT, Status.CONSENSUS)),
          lambda r, a: ((r == Status.KEPT) != a[2].inliers).any()),
    _rule("a pass over the decimated pair", _P + "_coarse_refinement",
          _is(lambda part, guess: guess.map), lambda r, a: r is not a[1].map),
    Rule("haze", {_F + "looks.HAZE": _is(PLAIN)},
         {_P + "_passes": lambda r, a: a[4][0].high_pass > 0}),
    Rule("edges with a tone of each patch", {_F + "looks.SHARPER": _is(())},
         {_F + "looks.sharpest": lambda r, a: r[0].local_tone,
          _P + "_approach": lambda r, a: a[4].local_tone and r is not None}),
    Rule("edges closer still", {_F + "looks.SHARPER": _is(SHARPER[:1])},
         {_F + "looks.sharpest": lambda r, a: r[0].local_tone and r[0].high_pass == 1.0}),
    _rule("ground from the header, too", _P + "_is_near_header", _says(False), _yes),
    _rule("nothing moves: no cloud", _P + "nothing_moves", _says(False), _yes),
    _rule("few patches off bright objects say nothing", _P + "is_telling", _says(True),
          lambda r, a: not r),
    Rule("relief: the same place but for the scatter", {_F + "layers._RELIEF_SIGMAS": _is(0.0)},
         {_P + "same_place": _yes}),
    _rule("tone where patches agree, when few do", _P + "_few_agreed", _says(None), _some),
    _rule("smaller patches where few agree", _P + "_smaller", _returns(1), _other(1)),
    _rule("smaller patches where much is hidden", _P + "_size_for", _returns(1), _other(1)),
    Rule("larger pixels where MS is blurred", {_P + "Refinement.is_blurred": _is(False)},
         {_F + "tiles.largest_step": lambda r, a: a[0].step < r}),
    _rule("rigid core", _F + "layers.rigid_core",
          _is(lambda points, unit: np.ones(len(points), dtype=np.bool_)),
          lambda r, a: not r.all()),
    _rule("curvature of the tone", _F + "tone._curved", _says(None), _some),
    _rule("curvature where held-out samples gain", _F + "tone._is_worthwhile", _says(True),
          lambda r, a: not r),
    _rule("curvature no further than it rises", _F + "tone._rising",
          _is(lambda c, w, dark, bright: (dark, bright)),
          lambda r, a: not all(map(np.array_equal, r, a[2:]))),
    Rule("tone of unremarkable pixels", {_F + "tone.robust_band_weights": _plain_tone},
         {_F + "tone.robust_band_weights":
          lambda r, a: not np.array_equal(_plain_tone(None)(*a)[0], r[0])}),
    Rule("point spread", {_F + "tuning.fit_sigma": _says(DEFAULT_SIGMA)}, {}),
    Rule("softer point spreads", {_F + "tuning._SOFTER": _is(())},
         {_F + "tuning.fit_sigma": lambda r, a: r > 0.7}),
    _rule("30 % of a patch among stripes", _F + "least_squares.least_valid", _says(0.6),
          lambda r, a: r < 0.6),
    Rule("the proof stands for the first passes", {_P + "_MANY_PATCHES": _is(10**9)},
         {_P + "refine_proven": _some}),
    Rule("Student weights", {_T + "estimate.student_weight": _is(np.ones_like),
                             _T + "estimate._response": _says(1.0)}, {}),
    Rule("response of the weights", {_T + "estimate._response": _says(1.0)}, {}),
    Rule("each point left out (HC3)", {_T + "estimate._MOST_LEVERAGE": _is(0.0)}, {}),
    Rule("rotation only where it moves a corner", {_T + "choice._TILT_PX": _is(0.0)},
         {_T + "choice.select_model": lambda r, a: r.neglected_px > 0}),
    _rule("bands sought by their edges", _J + "bands._start", _says(None), _some),
    _rule("band offsets from PAN, too", _J + "bands._by_pan",
          _is(lambda found, pair: np.zeros((len(pair.source_bands), 2))), _called),
    _rule("rivals block by block", _J + "rival._rival_blocks",
          _is(lambda one, other: lambda dy, dx: np.nan), _called),
    _rule("refusal by the best affine of the whole", _J + "whole.Whole.at_best", _returns(0),
          lambda r, a: r is not a[0]),
    _rule("height parallax", _J + "whole._height", _says(None),
          lambda r, a: r is not None and r.explains),
    Rule("no survey where nearly all agree", {_J + "whole._CALM_SHARE": _is(2.0)}, {}),
    _rule("once more without what is drawn", "geodelreg.raster.reader.RasterReader.leave_out_drawn",
          _says(""), _yes),
    _rule("once more as slopes", "geodelreg.second_look.as_slopes", _says(None), _some),
    Rule("own averages (off: GDAL's)",
         {"geodelreg.raster.raster_file.RasterFile.read_decimated": _is(_by_gdal)}, {}),
)
REASONS = (
    ("log_nfa",), ("log_chance",), ("log_together",), ("coverage",), ("sigma_px",),
    ("disagreement_px",), ("rival",), ("shading",), ("rival_motion",), ("support",),
    ("bands_apart",), ("bands",), ("keypoints_apart",), ("repeated",), ("two_motions",), ("local",),
    ("rival_motion", "support", "keypoints_apart", "disagreement_px"),
)
"""Of the gate, and some together."""
# fmt: on


def _unasked(names: tuple[str, ...]) -> Off:
    return lambda original: lambda *args: tuple(r for r in original(*args) if r.name not in names)


GATE = {
    Rule("gate: " + ", ".join(names), {_J + "verdict.judge": _unasked(names)}, {}): frozenset(names)
    for names in REASONS
}


@contextmanager
def switched_off(rule: Rule) -> Iterator[None]:
    """Run without a rule."""
    with ExitStack() as stack:
        for place, off in rule.off.items():
            _replace(stack, place, off)
        yield


@contextmanager
def watched(found: set[str]) -> Iterator[None]:
    """Put the names of the rules that decide something into a set."""
    found |= {rule.name for rule in RULES if not rule.seen}
    with ExitStack() as stack:
        for rule in RULES:
            for place, seen in rule.seen.items():
                _replace(stack, place, _watching(rule.name, seen, found))
        yield


def _watching(name: str, seen: Seen, found: set[str]) -> Off:
    def of(original: Any) -> Any:
        def watch(*args: Any, **options: Any) -> Any:
            result = original(*args, **options)
            if seen(result, args):
                found.add(name)
            return result

        return watch

    return of


@cache
def _load_all() -> None:
    for info in walk_packages(geodelreg.__path__, "geodelreg."):
        if not info.name.endswith("__main__"):
            import_module(info.name)


def _replace(stack: ExitStack, place: str, off: Off) -> None:
    """Replace what a name stands for in all modules of the package that have it."""
    _load_all()
    holder, name = place.rsplit(".", 1)
    if holder not in sys.modules:
        module, owner = holder.rsplit(".", 1)
        of = getattr(sys.modules[module], owner)
        stack.enter_context(mock.patch.object(of, name, off(getattr(of, name))))
        return
    original = getattr(sys.modules[holder], name)
    new = off(original)
    for known, module_of in list(sys.modules.items()):
        if known.startswith("geodelreg") and vars(module_of).get(name) is original:
            stack.enter_context(mock.patch.object(module_of, name, new))
