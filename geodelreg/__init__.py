"""Aligns a multispectral raster to a panchromatic one by correcting its georeferencing.

The public names are loaded when first used, so importing this package costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from geodelreg.version import __version__

if TYPE_CHECKING:
    from geodelreg import errors
    from geodelreg.alignment import Alignment
    from geodelreg.api import align, check, refit
    from geodelreg.applying import apply
    from geodelreg.geotiff.inplace import revert
    from geodelreg.options import AlignOptions, WriteOptions
    from geodelreg.product.check import Check
    from geodelreg.report.candidate import write_candidate
    from geodelreg.report.output import write_report
    from geodelreg.sharpen import pansharpen
    from geodelreg.sharpen_options import PansharpenOptions
    from geodelreg.values.raster import Grid
    from geodelreg.writing import export_gcps, write, write_displacement, write_in_place


__all__ = [
    "AlignOptions",
    "Alignment",
    "Check",
    "Grid",
    "PansharpenOptions",
    "WriteOptions",
    "__version__",
    "align",
    "apply",
    "check",
    "errors",
    "export_gcps",
    "pansharpen",
    "refit",
    "revert",
    "write",
    "write_candidate",
    "write_displacement",
    "write_in_place",
    "write_report",
]

_HOMES = {
    "AlignOptions": "geodelreg.options",
    "Alignment": "geodelreg.alignment",
    "Check": "geodelreg.product.check",
    "Grid": "geodelreg.values.raster",
    "PansharpenOptions": "geodelreg.sharpen_options",
    "WriteOptions": "geodelreg.options",
    "align": "geodelreg.api",
    "apply": "geodelreg.applying",
    "check": "geodelreg.api",
    "export_gcps": "geodelreg.writing",
    "pansharpen": "geodelreg.sharpen",
    "refit": "geodelreg.api",
    "revert": "geodelreg.geotiff.inplace",
    "write": "geodelreg.writing",
    "write_candidate": "geodelreg.report.candidate",
    "write_displacement": "geodelreg.writing",
    "write_in_place": "geodelreg.writing",
    "write_report": "geodelreg.report.output",
}


def __getattr__(name: str) -> Any:
    """Load a public name on first use (PEP 562)."""
    if name == "errors":
        return import_module("geodelreg.errors")
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
