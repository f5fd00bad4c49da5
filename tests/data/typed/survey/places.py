"""Where MS really lies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from affine import Affine
from numpy.typing import NDArray

import geodelreg
from geodelreg import Alignment, AlignOptions, Grid
from geodelreg.errors import AlignmentRefusedError, GeodelregError


@dataclass(frozen=True)
class Found:
    """What a survey keeps of an alignment."""

    right_px: float
    down_px: float
    rmse_px: float
    lines: list[str]


def place(ms: Path, pan: Path, out: Path, clouds: NDArray[np.bool_] | None = None) -> Found | str:
    """Align files and write the result; say in words what went wrong."""

    def told(fraction: float, step: str) -> None:
        lines.append(f"{fraction:.0%} {step}")

    lines: list[str] = []
    options = AlignOptions(threads=1)
    try:
        alignment = geodelreg.align(
            ms, pan, options, model="scale", mask=clouds, search_radius_px=64.0, progress=told
        )
        lines += geodelreg.write(alignment, out, overwrite=True, creation_options=("TILED=YES",))
    except AlignmentRefusedError as refusal:
        return refusal.remedy
    except GeodelregError as error:
        return error.cause
    right, down = alignment.shift_px
    return Found(right, down, alignment.accuracy.check_rmse_px, lines)


def place_array(
    ms: xr.DataArray, pixels: NDArray[np.uint16], transform: Affine, crs: str
) -> xr.DataArray:
    """Put a DataArray where an array with a geotransform says."""
    height, width = pixels.shape
    alignment: Alignment = geodelreg.align(ms, (pixels, Grid(transform, (height, width), crs)))
    report: dict[str, Any] = alignment.to_dict()
    assert report["verdict"]["accepted"]
    return alignment.apply(ms)


def sharpen(ms: Path | xr.DataArray, pan: Path, out: Path) -> None:
    """Sharpen MS where it lies."""
    weights = (0.3, 0.4, 0.2, 0.1)
    geodelreg.pansharpen(ms, pan, out, alignment=geodelreg.align(ms, pan), weights=weights)
