"""The knobs of `geodelreg.options` as keywords of functions, for type checkers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict


class AlignKnobs(TypedDict, total=False):
    """Fields of `AlignOptions`."""

    method: str
    model: str
    north_up: bool
    band: int | None
    per_band: bool
    band_model: str
    agreeing_bands: tuple[int, ...]
    pan_band: int
    masks: tuple[str, ...]
    pan_masks: tuple[str, ...]
    search: str
    ms_nodata: float | None
    pan_nodata: float | None
    search_radius_px: float
    tolerance_px: float
    ratio: float
    max_keypoints: int
    max_shift_px: float | None
    max_rotation_deg: float | None
    max_scale: float | None
    max_uncertainty_px: float | None
    max_residual_px: float
    on_local: str
    threads: int
    allow: str


class WriteKnobs(TypedDict, total=False):
    """Fields of `WriteOptions`."""

    overwrite: bool
    driver: str | None
    creation_options: tuple[str, ...]
    georef: str
    strip_rpc: bool
    warp: bool
    warp_grid: str
    like: str | None
    resampling: str


class PansharpenKnobs(TypedDict, total=False):
    """Fields of `PansharpenOptions`."""

    overwrite: bool
    driver: str | None
    creation_options: tuple[str, ...]
    resampling: str
    weights: str | Sequence[float]
    bands: str | Sequence[int]
    extent: str
    nodata: float | None
    bit_depth: int | None
