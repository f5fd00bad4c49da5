"""Options of pansharpening; it imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from geodelreg.errors import UsageError
from geodelreg.option_checks import (
    RESAMPLINGS,
    band_numbers,
    check_choice,
    check_creation,
    check_number,
    check_range,
    keep_list,
    knob,
    listed,
)

EXTENTS = ("pan", "intersection")


@dataclass(frozen=True, slots=True)
class PansharpenOptions:
    """How the sharpened raster is made and written."""

    overwrite: bool = knob(False, "Replace existing outputs; without it they are an error.")
    driver: str | None = knob(
        None,
        "GTiff, COG (with overviews) or VRT, which is lazy and names its sources; by the extension "
        "of OUT when not given.",
    )
    creation_options: tuple[str, ...] = knob(
        (), "Creation option of the format, KEY=VALUE, as in GDAL; may be repeated."
    )
    resampling: str = knob("cubic", "Resampling of MS onto the grid of PAN.", RESAMPLINGS)
    weights: str | Sequence[float] = knob(
        "auto",
        "Weights of the sharpened bands in the image that PAN is divided by: auto fits them so "
        "that together the bands look like PAN; equal; or numbers, W1,W2,...",
    )
    bands: str | Sequence[int] = knob(
        "all", "Bands of MS to sharpen, from 1, as N,N,...; all but alpha otherwise."
    )
    extent: str = knob(
        "pan", "pan: all of PAN's grid; intersection: its window that MS covers.", EXTENTS
    )
    nodata: float | None = knob(
        None, "No-data value of OUT; that of MS when not given, or a mask where MS has none."
    )
    bit_depth: int | None = knob(
        None, "Significant bits of the values (12 clips at 4095), for types with more of them."
    )

    def __post_init__(self) -> None:
        check_choice(self, "resampling")
        check_choice(self, "extent")
        check_range(self, "bit_depth", 1, 32)
        check_number(self, "nodata")
        keep_list(self, "weights")
        keep_list(self, "bands")
        check_creation(self, "creation_options")
        if self.weights not in ("auto", "equal"):
            self.given_weights()
        self.given_bands()

    def given_weights(self) -> tuple[float, ...]:
        """The weights as numbers.

        Raises
        ------
        UsageError
            They are none, or sum up to nothing.
        """
        try:
            values = tuple(float(each) for each in listed(self.weights))
        except (TypeError, ValueError):
            values = ()
        if not values or not all(0 <= value < float("inf") for value in values) or not sum(values):
            raise UsageError(
                f"`weights={self.weights!r}` are no weights",
                "Use auto, equal, or numbers of at least 0 such as 0.3,0.5,0.2.",
            )
        return values

    def given_bands(self) -> tuple[int, ...]:
        """Numbers of the bands, from 1; none when all are meant.

        Raises
        ------
        UsageError
        """
        return () if self.bands == "all" else band_numbers("bands", self.bands)
