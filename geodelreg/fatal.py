"""Files that would end the process inside GDAL, recognised before GDAL sees them.

To decode tiles in several threads, GDAL describes each tile by a strip of a small file in memory
and opens that.  libtiff opens tiles, but not strips, of YCbCr pixels that have not three samples,
and GDAL goes on with the null pointer it gets (seen in 3.10).
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from geodelreg.errors import RasterUnreadableError
from geodelreg.tiff import TiffFile

_COMPRESSION, _PHOTOMETRIC, _SAMPLES, _PLANAR = 259, 262, 277, 284
_TILE_WIDTH, _TILE_LENGTH = 322, 323
_TAGS = (_COMPRESSION, _PHOTOMETRIC, _SAMPLES, _PLANAR, _TILE_WIDTH, _TILE_LENGTH)
_YCBCR, _UNCOMPRESSED, _CONTIGUOUS = 6, 1, 1
_DEFAULTS = {_COMPRESSION: _UNCOMPRESSED, _SAMPLES: 1, _PLANAR: _CONTIGUOUS}
_SIDE_FILES = (".ovr", ".msk", ".msk.ovr", ".ovr.msk")


def check_survivable(path: Path) -> None:
    """Refuse a TIFF that GDAL dies of, or that has overviews or masks beside it that are such.

    Only the main image of a file is decoded in threads.  Whatever else is wrong is left to GDAL.

    Parameters
    ----------
    path : Path
        Local file of any format; it need not exist.

    Raises
    ------
    RasterUnreadableError
    """
    for suffix in ("", *_SIDE_FILES):
        name = Path(f"{path}{suffix}")
        samples = None
        if name.is_file():
            with suppress(OSError, RasterUnreadableError):
                samples = _fatal_samples(name)
        if samples is not None:
            raise contradiction(str(name), samples)


def contradiction(name: str, samples: int) -> RasterUnreadableError:
    """Error for a file whose YCbCr pixels have not three samples."""
    return RasterUnreadableError(
        f"the header of {name} contradicts itself: its colours are YCbCr, three samples to a "
        f"pixel, and its pixels have {samples}",
        "The file is damaged: copy or download it again.",
    )


def _fatal_samples(path: Path) -> int | None:
    """Samples per pixel of a main image that is deadly; None for any other."""
    tags = _main_tags(path)
    values = _DEFAULTS | tags
    is_fatal = (
        values.get(_PHOTOMETRIC) == _YCBCR
        and values[_SAMPLES] != 3
        and values[_PLANAR] == _CONTIGUOUS
        and values[_COMPRESSION] != _UNCOMPRESSED
        and (_TILE_WIDTH in tags or _TILE_LENGTH in tags)
    )
    return values[_SAMPLES] if is_fatal else None


def _main_tags(path: Path) -> dict[int, int]:
    """First number of each tag that matters, of those that have one."""
    with path.open("rb", buffering=0) as file:
        tiff = TiffFile(path, file)
        entries = tiff.entries(tiff.first_offset)
        # of repeated tags libtiff takes the first
        found = {entry.tag: entry for entry in reversed(entries)}
        numbers = {tag: tiff.first_integer(found.get(tag)) for tag in _TAGS}
    return {tag: number for tag, number in numbers.items() if number is not None}
