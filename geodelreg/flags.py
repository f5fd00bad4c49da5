"""What the knobs of Python are called on the command line, alone and in messages.

The library speaks of arguments: "`max_shift_px=40`" in a message is what one passes to it.  The
command line shows that as "--max-shift 40", and so do pages, which tell of commands.
"""

from __future__ import annotations

import re
import shlex
from ast import literal_eval
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import fields

from geodelreg.options import AlignOptions, BatchOptions, WriteOptions
from geodelreg.sharpen_options import PansharpenOptions

UNITS = {"_px": "PX", "_deg": "DEG", "_s": "S", "_mb": "MB"}
FLAGS = {
    "band": ("-b", "--band"),
    "agreeing_bands": ("--bands",),
    "masks": ("--mask",),
    "pan_masks": ("--pan-mask",),
    "ms_nodata": ("--nodata",),
    "threads": ("-j", "--num-threads"),
    "workers": ("-j", "--workers"),
    "driver": ("--of",),
    "creation_options": ("--co",),
    "warp_grid": ("--grid",),
    "resampling": ("-r", "--resampling"),
    "write": ("-o",),
    "write_in_place": ("--in-place",),
    "export_gcps": ("--gcps",),
    "write_displacement": ("--displacement",),
    "write_report": ("--report",),
    "write_candidate": ("--keep-candidate",),
}
"""Flags that GDAL's users know by another name than the knob's, or that are functions in Python."""
_OPTIONS = (AlignOptions, WriteOptions, BatchOptions, PansharpenOptions)
_ARGUMENTS = {
    "force",
    "ledger",
    "mask",
    "out_root",
    "pan_mask",
    "points",
    "resume",
    "retry",
    "snap",
}
"""Of functions, with flags of the same name."""
NAMES = frozenset(
    {*FLAGS, *_ARGUMENTS, *(field.name for kind in _OPTIONS for field in fields(kind))}
)
"""Everything that a message may name."""
_NAMED = re.compile(r"`([a-z]\w*)(?:=([^`]*))?`")


def flags(knob: str) -> tuple[str, ...]:
    """Flags of a knob: ``("--search-radius",)`` for ``search_radius_px``."""
    bare = next((knob.removesuffix(unit) for unit in UNITS if knob.endswith(unit)), knob)
    return FLAGS.get(knob, ("--" + bare.replace("_", "-"),))


def arguments(knob: str, value: object) -> list[str]:
    """Arguments of the command line for the value of a knob; none for what is off."""
    flag = flags(knob)[-1]
    if isinstance(value, bool):
        return [flag] if value else []
    if knob == "pan_band" and value == 0:
        return [flag, "auto"]
    values: Iterable[object] = value if isinstance(value, list | tuple) else (value,)
    return [text for each in values for text in (flag, str(each))]


def as_typed(text: str) -> str:
    """A message of the library with flags in place of the arguments that it names."""
    return _NAMED.sub(_typed, text)


def _typed(found: re.Match[str]) -> str:
    knob, written = found.groups()
    if knob not in NAMES:
        return found.group()
    if written is None:
        return flags(knob)[-1]
    value: object = written
    with suppress(ValueError, SyntaxError):
        value = literal_eval(written)
    return shlex.join(arguments(knob, value))
