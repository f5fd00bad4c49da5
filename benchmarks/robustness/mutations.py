"""Ways to break a file: knowing what a TIFF, a VRT or a JSON is, and blindly.

A mutation takes the content and a random generator and returns the broken content.
"""

from __future__ import annotations

import random
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass

Mutation = Callable[[bytes, random.Random], bytes]

INTEGERS = (0, 1, 2, 3, 7, 255, 256, 32767, 65535, 65536, 10**6, 2**31 - 1, 2**31, 2**32 - 1)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e-30, 1e30, 1e308, float("inf"), float("nan"))
SIZE_TAGS = (256, 257, 277, 278, 322, 323)
CODE_TAGS = (258, 259, 262, 266, 274, 284, 317, 338, 339, 330, 254, 347, 530)
BLOCK_TAGS = (273, 279, 324, 325)
GEO_TAGS = (33550, 33922, 34264, 34736)
NODATA_TAG, KEYS_TAG, XML_TAG = 42113, 34735, 42112
NODATA = (
    b"nan",
    b"inf",
    b"-1e400",
    b"1e999",
    b"",
    b"abc",
    b"0",
    b"65535",
    b"0x10",
    b"127",
    b"9" * 300,
)


@dataclass(frozen=True, slots=True)
class Slot:
    """An entry of a TIFF directory: where it lies, and where its value lies."""

    at: int
    tag: int
    type: int
    count: int
    value_at: int
    value_bytes: int


@dataclass(frozen=True, slots=True)
class Tiff:
    """Directories of a sound TIFF, read without the library under test."""

    order: str
    big: bool
    slots: list[Slot]
    links: list[int]
    offsets: list[int]

    @property
    def pointer(self) -> str:
        """Code of an offset."""
        return self.order + ("Q" if self.big else "I")


_WIDTHS = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 16: 8}


def parse(data: bytes) -> Tiff | None:
    """Directories of a TIFF; None when there is none or it is too broken already."""
    if data[:2] not in (b"II", b"MM"):
        return None
    order = "<" if data[:2] == b"II" else ">"
    try:
        big = struct.unpack_from(order + "H", data, 2)[0] == 43
        tiff = Tiff(order, big, [], [8 if big else 4], [])
        while len(tiff.offsets) < 20:
            (offset,) = struct.unpack_from(tiff.pointer, data, tiff.links[-1])
            if not offset or offset in tiff.offsets:
                break
            tiff.offsets.append(offset)
            _parse_directory(data, tiff, offset)
    except (struct.error, OverflowError):
        return None
    return tiff if tiff.slots else None


def _parse_directory(data: bytes, tiff: Tiff, offset: int) -> None:
    (count,) = struct.unpack_from(tiff.order + ("Q" if tiff.big else "H"), data, offset)
    at, width, inline = (
        offset + (8 if tiff.big else 2),
        (20, 12)[not tiff.big],
        (8, 4)[not tiff.big],
    )
    for _ in range(min(count, 200)):
        tag, kind, number = struct.unpack_from(
            tiff.order + ("HHQ" if tiff.big else "HHI"), data, at
        )
        size = _WIDTHS.get(kind, 1) * number
        value_at = at + width - inline
        if size > inline:
            (value_at,) = struct.unpack_from(tiff.pointer, data, value_at)
        tiff.slots.append(Slot(at, tag, kind, number, value_at, size))
        at += width
    tiff.links.append(at)


def _put(data: bytes, at: int, code: str, value: float) -> bytes:
    size = struct.calcsize(code)
    if at < 0 or at + size > len(data):  # where an earlier mutation points
        return data
    if code[-1] not in "df":
        value = int(value) & ((1 << 8 * size) - 1)
    return data[:at] + struct.pack(code, value) + data[at + size :]


def _number(rng: random.Random, near: int = 0) -> int:
    if rng.random() < 0.3:
        return max(near + rng.choice((-2, -1, 1, 2, near, 7 * near)), 0)
    return rng.choice(INTEGERS) if rng.random() < 0.8 else rng.randrange(2**32)


def _value(data: bytes, tiff: Tiff, slot: Slot, index: int, rng: random.Random) -> bytes:
    """Replace one number of an entry's value."""
    code = {3: "H", 4: "I", 12: "d", 16: "Q", 1: "B"}.get(slot.type)
    if code is None:
        return data
    at = slot.value_at + index * struct.calcsize(code)
    if at + 8 > len(data):
        return data
    if code == "d":
        return _put(data, at, tiff.order + code, rng.choice(FLOATS))
    (near,) = struct.unpack_from(tiff.order + code, data, at)
    return _put(data, at, tiff.order + code, _number(rng, near))


def _values_of(tags: tuple[int, ...], most: int = 2) -> Mutation:
    """Mutation that changes numbers under some tags."""

    def mutate(data: bytes, rng: random.Random) -> bytes:
        tiff = parse(data)
        slots = [slot for slot in tiff.slots if slot.tag in tags] if tiff else []
        for _ in range(rng.randint(1, most)):
            if tiff and slots:
                slot = rng.choice(slots)
                data = _value(data, tiff, slot, rng.randrange(max(min(slot.count, 4096), 1)), rng)
        return data

    return mutate


def entry_field(data: bytes, rng: random.Random) -> bytes:
    """Change tag, type, count or offset of an entry."""
    tiff = parse(data)
    if not tiff:
        return data
    slot, wide = rng.choice(tiff.slots), "Q" if tiff.big else "I"
    field = rng.randrange(4)
    if field == 0:
        return _put(data, slot.at, tiff.order + "H", rng.choice([s.tag for s in tiff.slots] + [0]))
    if field == 1:
        return _put(data, slot.at + 2, tiff.order + "H", rng.randrange(20))
    at = slot.at + 4 if field == 2 else slot.at + (12 if tiff.big else 8)
    return _put(
        data, at, tiff.order + wide, _number(rng, slot.count if field == 2 else slot.value_at)
    )


def drop_entry(data: bytes, rng: random.Random) -> bytes:
    """Make the tag of an entry one that nobody knows."""
    tiff = parse(data)
    return _put(data, rng.choice(tiff.slots).at, tiff.order + "H", 65000) if tiff else data


def cycle(data: bytes, rng: random.Random) -> bytes:
    """Point the link to the next directory somewhere else, also back."""
    tiff = parse(data)
    if not tiff:
        return data
    aims = [*tiff.offsets, 0, 1, len(data) - 1, len(data), 2**32 - 1]
    return _put(data, rng.choice(tiff.links), tiff.pointer, rng.choice(aims))


def nodata(data: bytes, rng: random.Random) -> bytes:
    """Give the raster another no-data string, under the tag of another entry if need be."""
    tiff = parse(data)
    if not tiff:
        return data
    slots = [slot for slot in tiff.slots if slot.tag in (NODATA_TAG, XML_TAG, 305, 34737)]
    slot = rng.choice(slots or tiff.slots)
    text = rng.choice(NODATA) + b"\0"
    data = _put(data, slot.at, tiff.order + "H", NODATA_TAG)
    data = _put(data, slot.at + 2, tiff.order + "H", 2)
    data = _put(data, slot.at + 4, tiff.order + ("Q" if tiff.big else "I"), len(text))
    data = _put(data, slot.at + (12 if tiff.big else 8), tiff.pointer, len(data))
    return data + text


def ascii_value(data: bytes, rng: random.Random) -> bytes:
    """Damage a text: GDAL's metadata, names of the CRS."""
    tiff = parse(data)
    slots = [s for s in tiff.slots if s.type == 2 and s.value_bytes > 4] if tiff else []
    if not slots:
        return data
    slot = rng.choice(slots)
    start, end = slot.value_at, slot.value_at + slot.value_bytes
    text = blind(data[start:end], rng)
    return data[:start] + text[: end - start].ljust(end - start, b"\xff") + data[end:]


def pixel_bits(data: bytes, rng: random.Random) -> bytes:
    """Flip bits in encoded blocks."""
    tiff = parse(data)
    slots = [slot for slot in tiff.slots if slot.tag in (273, 324)] if tiff else []
    if not tiff or not slots:
        return data
    slot, content = rng.choice(slots), bytearray(data)
    code = {3: "H", 4: "I", 16: "Q"}.get(slot.type, "I")
    place = slot.value_at + rng.randrange(max(slot.count, 1)) * struct.calcsize(code)
    if place + 8 > len(data):
        return data
    (start,) = struct.unpack_from(tiff.order + code, data, place)
    for _ in range(rng.choice((1, 4, 40))):
        at = start + rng.randrange(64)
        if at < len(content):
            content[at] ^= 1 << rng.randrange(8)
    return bytes(content)


def bomb(data: bytes, rng: random.Random) -> bytes:
    """A small file that unpacks to hundreds of megabytes in one block."""
    side = rng.choice((5000, 12_000, 20_000))
    block = _zeros(side * side)
    transform = struct.pack("<3d6d", 1, 1, 0, 0, 0, 0, 5e5, 4e6, 0)
    keys = struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32618)
    at = 8 + 2 + 13 * 12 + 4
    entries = [
        (256, 4, 1, side), (257, 4, 1, side), (258, 3, 1, 8), (259, 3, 1, 8), (262, 3, 1, 1),
        (273, 4, 1, at + 104), (277, 3, 1, 1), (278, 4, 1, side), (279, 4, 1, len(block)),
        (33550, 12, 3, at), (33922, 12, 6, at + 24), (34735, 3, 16, at + 72), (65000, 4, 1, 0),
    ]  # fmt: skip
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0\x08\0\0\0" + struct.pack("<H", 13) + body + bytes(4) + transform + keys + block


_packed: dict[int, bytes] = {}


def _zeros(length: int) -> bytes:
    if length not in _packed:
        packer = zlib.compressobj(9)
        parts = [
            packer.compress(bytes(min(1 << 20, length - i))) for i in range(0, length, 1 << 20)
        ]
        _packed[length] = b"".join(parts) + packer.flush()
    return _packed[length]


def truncate(data: bytes, rng: random.Random) -> bytes:
    """Cut the end off."""
    return data[: rng.randrange(len(data) + 1)]


def blind(data: bytes, rng: random.Random) -> bytes:
    """Change, insert, remove, double bytes anywhere."""
    content = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        at = rng.randrange(min(len(content), rng.choice((16, 400, 1 << 20))) or 1)
        kind = rng.randrange(6)
        if kind == 0 and content:
            content[at] = rng.randrange(256)
        elif kind == 1 and content:
            content[at] ^= 1 << rng.randrange(8)
        elif kind == 2:
            content[at : at + 4] = struct.pack(rng.choice("<>") + "I", rng.choice(INTEGERS))
        elif kind == 3:
            del content[at : at + rng.randrange(1, 50)]
        elif kind == 4:
            content[at:at] = rng.randbytes(rng.randrange(1, 30))
        else:
            content[at:at] = content[at : at + rng.randrange(1, 200)]
    return bytes(content)


_TEXTS = (
    "", "-1", "0", "1e308", "nan", "inf", "-inf", "99999999999999999999", "2147483648", "1e-320",
    "65536", "a", "\x00", "\ud7ff", "é", "../../etc/passwd", "/dev/zero", "null", "[]", "{}",
    "true", "<", "&amp;", "&bogus;", "EPSG:0", "EPSG:999999", "LOCAL_CS[\"x\"]", "1,2,3", "0x7f",
    "1_000", "１２", "9" * 5000,
)  # fmt: skip


def text_token(data: bytes, rng: random.Random) -> bytes:
    """Replace numbers and words of a text by unexpected ones."""
    text = data.decode("utf-8", "surrogateescape")
    for _ in range(rng.choice((1, 1, 2, 5))):
        tokens = list(re.finditer(r'[^\s<>",:;={}\[\]]+', text))
        if tokens:
            token = rng.choice(tokens)
            text = text[: token.start()] + rng.choice(_TEXTS) + text[token.end() :]
    return text.encode("utf-8", "surrogateescape")


def text_lines(data: bytes, rng: random.Random) -> bytes:
    """Drop, double, swap or nest lines of a text."""
    lines = data.splitlines(keepends=True) or [b""]
    at = rng.randrange(len(lines))
    kind = rng.randrange(5)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines[at:at] = [lines[at]] * rng.choice((1, 2, 2000))
    elif kind == 2:
        rng.shuffle(lines)
    elif kind == 3:
        lines[at] = lines[at][: rng.randrange(len(lines[at]) + 1)]
    else:
        opening, closing = rng.choice(((b"[", b"]"), (b"<a>", b"</a>"), (b'{"a":', b"}")))
        depth = rng.choice((10, 3000, 100_000))
        lines[at] = opening * depth + lines[at] + closing * depth
    return b"".join(lines)


def vrt_source(data: bytes, rng: random.Random) -> bytes:
    """Let a VRT name another source: itself, a missing file, an address, a device."""
    name = rng.choice(
        (
            "ms.vrt", "gone.tif", "/etc/passwd", "/dev/zero", "", ".", "ms.tif.aux.xml",
            "/vsicurl/http://127.0.0.1:9/a.tif", "http://127.0.0.1:9/a.tif", "WMS:x", "MEM:::",
            "/vsistdin/", "vrt://ms.vrt?bands=1", "&lt;VRTDataset/&gt;", "NETCDF:x.nc:v",
        )
    )  # fmt: skip
    return re.sub(rb"(<SourceFilename[^>]*>)[^<]*", rb"\1" + name.encode(), data)


def vrt_size(data: bytes, rng: random.Random) -> bytes:
    """Let a VRT claim another size."""
    side = str(rng.choice((0, -1, 1, 2, 1000, 70_000, 10**6, 10**8, 2**31 - 1, 10**12))).encode()
    return re.sub(rb'(raster[XY]Size=")\d+', rb"\g<1>" + side, data, count=rng.randint(1, 2))


TIFF_MUTATIONS: tuple[Mutation, ...] = (
    _values_of(SIZE_TAGS), _values_of(CODE_TAGS), _values_of(BLOCK_TAGS, 6),
    _values_of(GEO_TAGS, 3), _values_of((KEYS_TAG,), 3), entry_field, entry_field,
    drop_entry, cycle, nodata, ascii_value, pixel_bits, truncate, blind, blind,
)  # fmt: skip
XML_MUTATIONS: tuple[Mutation, ...] = (text_token, text_token, text_lines, blind, truncate)
VRT_MUTATIONS: tuple[Mutation, ...] = (*XML_MUTATIONS, vrt_source, vrt_source, vrt_size)


def mutations_for(data: bytes) -> tuple[Mutation, ...]:
    """Mutations that fit a content."""
    if parse(data):
        return TIFF_MUTATIONS
    if b"<VRTDataset" in data[:200]:
        return VRT_MUTATIONS
    return XML_MUTATIONS if data.isascii() else (blind, blind, truncate)


def mutate(data: bytes, rng: random.Random) -> tuple[bytes, list[str]]:
    """Break a content in one to three ways.

    Returns
    -------
    bytes
    list of str
        Names of the ways.
    """
    if rng.random() < 0.002:
        return bomb(data, rng), ["bomb"]
    names = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        chosen = rng.choice(mutations_for(data))
        data = chosen(data, rng)
        names.append(chosen.__qualname__.split(".")[0].strip("_"))
    return data, names
