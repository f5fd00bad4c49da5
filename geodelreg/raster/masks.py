"""The masks of one image: opened, asked together, and counted."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import PurePath

import numpy as np

from geodelreg.door.names import LOCAL, check_name
from geodelreg.door.vectors import is_vector
from geodelreg.errors import AccessNotAllowedError, GeodelregError, MaskError
from geodelreg.masking import MASK_KINDS, MaskSpec, MaskUse, parse_mask
from geodelreg.raster.inputs import AnyMask, Opened, mask_opened, opened
from geodelreg.raster.mask_raster import RasterMask
from geodelreg.raster.mask_vector import VectorMask
from geodelreg.values.raster import BoolArray, Grid

_WHOLE = 0.995


class Masks:
    """All masks of one image.

    Parameters
    ----------
    image : Grid
    image_name : str
        For messages.
    names : sequence of masks
        As the user named them, ``FILE`` or ``FILE=HIDE``, or arrays.
    bands : sequence of (Opened, int, str)
        Raster, number and kind of the quality bands that are part of the image.
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
        names: Sequence[AnyMask],
        bands: Sequence[tuple[Opened, int, str]],
        stack: ExitStack,
        allow: str = LOCAL,
    ) -> None:
        self._image_name = image_name
        self._masks: list[RasterMask | VectorMask] = []
        for raster, number, kind in bands:
            again = replace(raster, dataset=raster.again(stack)) if raster.is_file else raster
            self._masks.append(RasterMask(MaskSpec(raster.name, kind), image, again, number))
        for name in names:
            spec = parse_mask(name) if isinstance(name, str) else None
            if spec is None:
                array = mask_opened(name, image, stack, allow)
                spec = MaskSpec(array.name)
                self._masks.append(RasterMask(spec, image, array))
            elif is_vector(spec.path):
                check_name(spec.path, allow)
                self._masks.append(VectorMask(spec, image, allow))
            else:
                self._masks.append(RasterMask(spec, image, _opened(spec.path, stack, allow)))
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
                image, mask.path, mask.band, mask.kind, mask.hide,
                float(count / self._seen) if self._seen else float("nan"), mask.covered_share,
            )
            for mask, count in zip(self._masks, self._hidden, strict=False)
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


def _opened(path: str, stack: ExitStack, allow: str) -> Opened:
    """A mask that is a file."""
    check_name(path, allow)
    try:
        return opened(path, stack, allow)
    except AccessNotAllowedError:
        raise
    except GeodelregError as error:
        remedy = f"After = come values (3,8-10) or one of {', '.join(MASK_KINDS)}; else check it."
        raise MaskError(
            f"the mask {error.cause}", remedy if "=" in path else error.remedy
        ) from error
