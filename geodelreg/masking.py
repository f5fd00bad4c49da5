"""What a mask is called and what became of it; nothing here reads one or imports anything heavy."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

from geodelreg.errors import UsageError

AUTO, BINARY, LANDSAT_QA, SENTINEL2_SCL = MASK_KINDS = (
    "auto",
    "binary",
    "landsat-qa",
    "sentinel2-scl",
)
VECTOR, VALUES = "vector", "values"

_RANGE = re.compile(r"(-?\d+)(?:-(\d+))?")


def _word(pattern: str) -> re.Pattern[str]:
    return re.compile(rf"(?:^|[^A-Z0-9])(?:{pattern})(?:$|[^A-Z0-9])", re.IGNORECASE)


_NAMES = {LANDSAT_QA: _word("QA_PIXEL"), SENTINEL2_SCL: _word("SCL")}
_OLD_LANDSAT = _word("BQA|PIXEL_QA")
_OTHER_FLAGS = _word("QA_RADSAT|QA_AEROSOL|QA60")

Ranges = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class MaskSpec:
    """A mask as the user named it: ``FILE`` or ``FILE=HIDE``.

    Attributes
    ----------
    path : str
    kind : str
        One of `MASK_KINDS`, or ``values``.
    hide : tuple of (int, int)
        First and last value of each range that is hidden; empty unless `kind` is ``values``.
    """

    path: str
    kind: str = AUTO
    hide: Ranges = ()


def parse_mask(text: str) -> MaskSpec:
    """Take a mask's name apart.

    What follows the last ``=`` counts only when it is a kind or a list of values, so that other
    file names may hold one, too.

    Parameters
    ----------
    text : str
        ``clouds.tif``, ``qa.tif=landsat-qa``, ``classes.tif=3,8-10``.

    Returns
    -------
    MaskSpec

    Raises
    ------
    UsageError
        If a range of values runs backwards.
    """
    path, equals, hide = text.rpartition("=")
    if not (equals and path):
        return MaskSpec(text)
    if hide in MASK_KINDS:
        return MaskSpec(path, hide)
    ranges = []
    for part in hide.split(","):
        found = _RANGE.fullmatch(part)
        if found is None:
            return MaskSpec(text)
        first, last = int(found[1]), int(found[2] or found[1])
        if first > last:
            raise UsageError(f"mask {text!r} asks for the values {part}", "Put the smaller first.")
        ranges.append((first, last))
    return MaskSpec(path, VALUES, tuple(ranges))


@dataclass(frozen=True, slots=True)
class MaskUse:
    """A mask that was used, for the report.

    Attributes
    ----------
    image : str
        ``source`` (MS) or ``reference`` (PAN): whose pixels it hides.
    path : str
    band : int or None
        Number of the band that is the mask; None for vectors.
    kind : str
        ``vector``, ``binary``, ``values``, ``landsat-qa`` or ``sentinel2-scl``.
    hide : tuple of (int, int)
        Ranges of values that are hidden, for ``values``.
    hidden_share : float
        Share of the image's pixels, where the first search looked, that it hides, 0 to 1; NaN
        when none was read.
    covered_share : float
        Share of the image's area that the mask says anything about, 0 to 1.
    """

    image: str
    path: str
    band: int | None
    kind: str
    hide: Ranges = ()
    hidden_share: float = float("nan")
    covered_share: float = 1.0


def quality_kind(name: str) -> str | None:
    """Kind of quality band that a file name (without folders) or a band's description tells of."""
    return next((kind for kind, pattern in _NAMES.items() if pattern.search(name)), None)


def is_old_landsat(name: str) -> bool:
    """Whether a file or band name is that of a quality band before Collection 2."""
    return _OLD_LANDSAT.search(name) is not None


def quality_bands(path: str, descriptions: Sequence[str | None]) -> dict[int, str]:
    """Numbers (from 1) and kinds of the bands of a raster that are quality bands.

    A band's description says so, or the file's name when there is but one band.
    """
    kinds = {n: quality_kind(text or "") for n, text in enumerate(descriptions, start=1)}
    if len(descriptions) == 1 and kinds[1] is None:
        kinds[1] = quality_kind(PurePath(path).stem)
    return {number: kind for number, kind in kinds.items() if kind is not None}


def flag_bands(path: str, descriptions: Sequence[str | None]) -> tuple[int, ...]:
    """Numbers (from 1) of the bands whose values are classes or bits, which have no average.

    Quality bands, those of which geodelreg makes no masks included; known by the same names.
    """

    def is_one(name: str) -> bool:
        return bool(quality_kind(name) or is_old_landsat(name) or _OTHER_FLAGS.search(name))

    texts = [text or "" for text in descriptions]
    if len(texts) == 1 and not is_one(texts[0]):
        texts = [PurePath(path).stem]
    return tuple(number for number, text in enumerate(texts, start=1) if is_one(text))
