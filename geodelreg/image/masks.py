"""The masks of one image: opened, asked together, and counted."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import PurePath

import numpy as np

from geodelreg.door.names import LOCAL, check_name
from geodelreg.door.vectors import is_vector
from geodelreg.image.mask_raster import RasterMask
from geodelreg.image.mask_vector import VectorMask
from geodelreg.masking import MaskSpec, MaskUse, Ranges, parse_mask
from geodelreg.values.raster import BoolArray, Grid

_WHOLE = 0.995


class Masks:
    """All masks of one image.

    Parameters
    ----------
    image : Grid
    image_name : str
        For messages.
    names : sequence of str
        Masks as the user named them, ``FILE`` or ``FILE=HIDE``.
    bands : sequence of (str, int, str)
        Path, number and kind of the quality bands that are part of the image.
    stack : ExitStack
        Closes the files.
    allow : str
        What may be opened, `AlignOptions.allow`.

    Raises
    ------
    MaskError
        If a mask cannot be used.
    MissingExtraError
        If a vector format needs a library that is not installed.
    """

    def __init__(
        self,
        image: Grid,
        image_name: str,
        names: Sequence[str],
        bands: Sequence[tuple[str, int, str]],
        stack: ExitStack,
        allow: str = LOCAL,
    ) -> None:
        self._image_name = image_name
        self._masks: list[RasterMask | VectorMask] = []
        self._hide: list[Ranges] = []
        for path, number, kind in bands:
            self._masks.append(RasterMask(MaskSpec(path, kind), image, stack, number, allow))
            self._hide.append(())
        for spec in map(parse_mask, names):
            check_name(spec.path, allow)
            vector = is_vector(spec.path)
            self._masks.append(
                VectorMask(spec, image, allow)
                if vector
                else RasterMask(spec, image, stack, allow=allow)
            )
            self._hide.append(spec.hide)
        self._hidden = np.zeros(len(self._masks) + 1, dtype=np.int64)
        self._seen = 0
        self._counts = True

    def hides(self, grid: Grid) -> BoolArray:
        """(H, W) bool, True for the pixels of `grid`, a part of the image, that any mask hides.

        Raises
        ------
        MaskError
            If a mask cannot be decoded.
        """
        together = np.zeros(grid.shape, dtype=np.bool_)
        hidden = []
        for mask in self._masks:
            mine = mask.hides(grid)
            hidden.append(np.count_nonzero(mine))
            together |= mine
        if self._counts:
            self._hidden += [*hidden, np.count_nonzero(together)]
            self._seen += together.size
        return together

    def stop_counting(self) -> None:
        """Let the shares be those of what was read until now: later reads overlap each other."""
        self._counts = False

    @property
    def hidden_share(self) -> float:
        """Share of the pixels that all masks together hide; NaN when none was read."""
        return float(self._hidden[-1] / self._seen) if self._seen else float("nan")

    def uses(self, image: str) -> tuple[MaskUse, ...]:
        """What was used and how much it hides, for the report; `image` as in `MaskUse`."""
        return tuple(
            MaskUse(
                image, mask.path, mask.band, mask.kind, hide,
                float(count / self._seen) if self._seen else float("nan"), mask.covered_share,
            )
            for mask, hide, count in zip(self._masks, self._hide, self._hidden, strict=False)
        )  # fmt: skip

    def warnings(self) -> tuple[str, ...]:
        """What about the masks may not be what the user wants."""
        notes = []
        for mask in self._masks:
            name = PurePath(mask.path).name
            if mask.covered_share < _WHOLE:
                notes.append(
                    f"the mask {name} covers {100 * mask.covered_share:.0f} % of "
                    f"{self._image_name}; beyond it nothing is hidden"
                )
            if isinstance(mask, VectorMask) and mask.is_elsewhere:
                notes.append(f"nothing in the mask {name} touches {self._image_name}")
        return tuple(notes)
