"""Files that would end the process inside GDAL, recognised before GDAL sees them.

To decode tiles in several threads, GDAL describes each tile by a strip of a small file in memory
and opens that.  libtiff opens tiles, but not strips, of YCbCr pixels that have not three samples,
and GDAL goes on with the null pointer it gets (seen in 3.10).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from geodelreg.errors import RasterUnreadableError

_COMPRESSION, _PHOTOMETRIC, _SAMPLES, _PLANAR = 259, 262, 277, 284
_TILE_WIDTH, _TILE_LENGTH = 322, 323
_TAGS = (_COMPRESSION, _PHOTOMETRIC, _SAMPLES, _PLANAR, _TILE_WIDTH, _TILE_LENGTH)
_YCBCR, _UNCOMPRESSED, _CONTIGUOUS = 6, 1, 1
_CODES = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 16: "Q", 17: "q"}
_CLASSIC = ("H", "HHI4s", "I")
_BIG = ("Q", "HHQ8s", "Q")
"""How a directory's length, its entries and offsets are encoded."""

_DEFAULTS = {_COMPRESSION: _UNCOMPRESSED, _SAMPLES: 1, _PLANAR: _CONTIGUOUS}
_SIDE_FILES = (".ovr", ".msk", ".msk.ovr", ".ovr.msk")
_MOST_ENTRIES = 4096
"""Of a directory; libtiff refuses more."""


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
        if not name.is_file():
            continue
        try:
            with name.open("rb", buffering=0) as file:
                samples = _fatal_samples(file)
        except OSError:
            continue
        if samples is not None:
            raise contradiction(str(name), samples)


def contradiction(name: str, samples: int) -> RasterUnreadableError:
    """Error for a file whose YCbCr pixels have not three samples."""
    return RasterUnreadableError(
        f"the header of {name} contradicts itself: its colours are YCbCr, three samples to a "
        f"pixel, and its pixels have {samples}",
        "The file is damaged: copy or download it again.",
    )


def _fatal_samples(file: BinaryIO) -> int | None:
    """Samples per pixel of a main image that is deadly; None for any other."""
    tags = _main_directory(file)
    values = _DEFAULTS | tags
    is_fatal = (
        values.get(_PHOTOMETRIC) == _YCBCR
        and values[_SAMPLES] != 3
        and values[_PLANAR] == _CONTIGUOUS
        and values[_COMPRESSION] != _UNCOMPRESSED
        and (_TILE_WIDTH in tags or _TILE_LENGTH in tags)
    )
    return values[_SAMPLES] if is_fatal else None


def _main_directory(file: BinaryIO) -> dict[int, int]:
    """First number of each tag that matters; nothing when the file is no TIFF or is cut off."""
    head = _read(file, 0, 16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None or len(head) < 16:
        return {}
    (version,) = struct.unpack_from(order + "H", head, 2)
    if version not in (42, 43):
        return {}
    count_code, entry_code, pointer_code = _BIG if version == 43 else _CLASSIC
    (start,) = struct.unpack_from(order + pointer_code, head, 8 if version == 43 else 4)
    raw = _read(file, start, struct.calcsize(order + count_code))
    count = int.from_bytes(raw, "little" if order == "<" else "big")
    if not 0 < count <= _MOST_ENTRIES:
        return {}
    length = count * struct.calcsize(order + entry_code)
    body = _read(file, start + len(raw), length)
    if len(body) < length:
        return {}
    tags: dict[int, int] = {}
    for tag, kind, number, field in struct.iter_unpack(order + entry_code, body):
        if tag not in _TAGS or tag in tags or not number or kind not in _CODES:
            continue  # of repeated tags libtiff takes the first
        code, value = order + _CODES[kind], field
        if number * struct.calcsize(code) > len(field):
            value = _read(file, struct.unpack(order + pointer_code, field)[0], 8)
        if len(value) >= struct.calcsize(code):
            tags[tag] = struct.unpack_from(code, value)[0]
    return tags


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    """Bytes of a file, fewer where it ends."""
    if offset >= 1 << 63:
        return b""
    file.seek(offset)
    return file.read(length)
