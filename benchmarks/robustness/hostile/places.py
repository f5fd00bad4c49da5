"""Hostile places: planted private folders, special files, parts of inputs as outputs, names."""

from __future__ import annotations

import json
import os
import socket
import stat
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from benchmarks.robustness.hostile.formats import PAYLOADS
from benchmarks.robustness.hostile.inputs import POINTS, outputs_of, raster_parts, shape_of
from benchmarks.robustness.hostile.plan import COMMAND_SIDE, Plan, World, sound
from benchmarks.robustness.hostile.vrts import source, vrt

NOBODY = 65534
MALFORMED = (
    b"", b"null", b"{}", b"[1]", b'[["thesis.doc"]]', b'"thesis.doc"', b"\xff\xfe", b"[" * 100_000,
    b'["../victims/thesis.doc"]', b'["."]', b'[".."]', b'[""]', b'["a\\u0000b"]',
)  # fmt: skip
ODD_NAMES = (
    "http:x.tif", "s3:b.tif", "zip:x.tif", "file:x.tif", "HTTP:b.tif", "vrt:x.tif", "WMS:x.tif",
    "NETCDF:x.tif", "GTIFF_DIR:1:x.tif", "HDF5:x.tif", "a:1.tif", "x y.tif", "x,y.tif", "é.tif",
    "%s.tif", "$HOME.tif", "~.tif", "x?.tif", "*.tif", "x#1.tif", "a;b.tif", "COM1.tif", "x.tif.",
    "[x].tif", "{x}.tif", "x=1.tif", "@x.tif", "a&b.tif", "<x>.tif", "'x'.tif", '"x".tif',
)  # fmt: skip
CONTROL_NAMES = (
    "x\x1b[2J.tif",
    "x\n.tif",
    "x\r.tif",
    "x\x07.tif",
    "x\u202etif",
    os.fsdecode(b"x\xff.tif"),
)


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _device(path: Path) -> None:
    """The null device by another name, which only root can make; a pipe for others."""
    try:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    except PermissionError:
        os.mkfifo(path)


def _socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # the name of a socket has 108 bytes at most
    try:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(path.name)
    finally:
        os.chdir(here)


SPECIAL: dict[str, Callable[[Path], None]] = {
    "pipe": _fifo,
    "device": _device,
    "socket": _socket,
    "folder": lambda path: path.mkdir(),
    "dangling link": lambda path: path.symlink_to("gone"),
    "looping link": lambda path: path.symlink_to(path.name),
    "link to a victim": lambda path: path.symlink_to("../victims/thesis.doc"),
}

TARGETS = {
    "write": "out/out.tif", "inplace": "ms.tif", "revert": "ms.tif", "report": "report.json",
    "points": "points.geojson", "gcps": "points.geojson",
}  # fmt: skip


def _put_inputs(world: World, action: str, layout: str = "tiled-deflate") -> None:
    """Sound ones; some outputs are written only of rasters that are large enough to be aligned."""
    side = COMMAND_SIDE if action in ("points", "align") else world.side
    replace(world, side=side).put_pair(layout)
    if action == "gcps":
        world.put({"in.points": POINTS.encode()})


def folders(world: World, number: int) -> Plan:
    """A private folder beside the target that no run of ours has left."""
    rng = world.rng
    action = rng.choice(list(TARGETS))
    target = TARGETS[action]
    _put_inputs(world, action)
    place = world.folder / Path(target).parent
    (place / "thesis.doc").write_bytes(b"years of work\n")
    private = place / f".{Path(target).name}.geodelreg"
    kind = rng.choice(list(PLANTED))
    outputs = PLANTED[kind](world, private, Path(target).name) or ()
    pan = "in.points" if action == "gcps" else "pan.tif"
    return Plan(
        number, "planted folder", kind, action, "ms.tif", pan, target, overwrite=True,
        outputs=tuple(str(Path(target).parent / name) for name in outputs),
    )  # fmt: skip


def _complete(private: Path, name: str, ready: bytes) -> None:
    """As a killed run leaves it: all files there, about to be moved into place."""
    (private / "files").mkdir(parents=True)
    (private / "files" / name).write_bytes(b"foreign bytes")
    (private / "ready").write_bytes(ready)


def _siblings(world: World, private: Path, name: str) -> None:
    _complete(private, name, json.dumps(["thesis.doc", "photos"]).encode())


def _foreign_file(world: World, private: Path, name: str) -> None:
    _complete(private, name, b"[]")
    (private / "files" / "thesis.doc").write_bytes(b"foreign bytes")


def _malformed(world: World, private: Path, name: str) -> None:
    _complete(private, name, world.rng.choice(MALFORMED))


def _linked(world: World, private: Path, name: str) -> None:
    """One thing in the folder, or the folder itself, is a link out of it."""
    part = world.rng.choice(("", "files", "lock", "ready", "replaced", f"files/{name}", "new lock"))
    victims = world.root / "victims"
    if part == "":
        private.symlink_to(victims)
        return
    _complete(private, name, b"[]")
    path = private / part.removeprefix("new ")
    if part == "files":
        (path / name).unlink()
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
    is_folder = part in ("files", "replaced")
    aim = victims if is_folder else victims / ("new" if part == "new lock" else "thesis.doc")
    path.symlink_to(aim)


def _not_files(world: World, private: Path, name: str) -> None:
    """A pipe or the like where a file should be; whoever opens it may wait for ever."""
    part = world.rng.choice(("", "lock", "ready", "files", f"files/{name}"))
    make = SPECIAL[world.rng.choice(("pipe", "device", "socket"))]
    if part:
        private.mkdir()
        if part != "lock":
            (private / "lock").touch()
        if part not in ("lock", "files"):
            (private / "files").mkdir()
    if part.startswith("files/"):
        (private / "ready").write_bytes(b"[]")
    elif part == "ready":
        (private / "files" / name).write_bytes(b"foreign bytes")
    make(private / part if part else private)


def _others(world: World, private: Path, name: str) -> None:
    """It belongs to somebody else; only root can make one, for others it is a link."""
    _complete(private, name, b"[]")
    try:
        for path in (private, *private.rglob("*")):
            os.chown(path, NOBODY, NOBODY)
    except PermissionError:
        private.rename(world.root / "victims" / "private")
        private.symlink_to(world.root / "victims" / "private")


def _hard_link(world: World, private: Path, name: str) -> tuple[str, ...]:
    """May be taken for ours, but the file behind it is the victim's too."""
    _complete(private, name, b"[]")
    (private / "files" / name).unlink()
    (private / "files" / name).hardlink_to(world.root / "victims" / "thesis.doc")
    return (name, *(path.relative_to(private.parent).as_posix() for path in _all(private)))


def _all(folder: Path) -> list[Path]:
    return [folder, *folder.rglob("*")]


PLANTED: dict[str, Callable[[World, Path, str], tuple[str, ...] | None]] = {
    "names siblings": _siblings,
    "brings a sibling": _foreign_file,
    "malformed": _malformed,
    "linked": _linked,
    "no files": _not_files,
    "of somebody else": _others,
    "hard link": _hard_link,
}


def special(world: World, number: int) -> Plan:
    """Something else than a file in the place of an input, a side file or an output."""
    rng = world.rng
    kind = rng.choice(list(SPECIAL))
    role = rng.choice(
        ("ms.tif", "pan.tif", "mask", "ms.tif.aux.xml", "ms.tif.ovr", "ms.tif.msk", "ms.tfw",
         "ms.tif.geodelreg-undo.json", "out/out.tif.aux.xml", *["target"] * 4)
    )  # fmt: skip
    action = rng.choice(("check", "write", "inplace"))
    what, mask = f"{kind} as {role}", ""
    if role == "target":
        action = rng.choice(("write", "report", "points", "gcps"))
        target = TARGETS[action]
        pan = "in.points" if action == "gcps" else "pan.tif"
        _put_inputs(world, action)
        SPECIAL[kind](world.folder / target)
        # a link is followed: what it says is the target, and must not be there without --overwrite
        outputs = (target, str(Path(target).parent / "gone")) if kind == "dangling link" else ()
        overwrite = kind != "link to a victim"
        return Plan(
            number, "special file", what, action, "ms.tif", pan, target, "", overwrite, outputs
        )
    _put_inputs(world, action)
    if role == "mask":
        mask = rng.choice(("mask.tif", "mask.geojson", "mask.gpkg"))
    elif role.endswith("undo.json"):
        action = rng.choice(("inplace", "revert"))
    path = world.folder / (mask or role)
    path.unlink(missing_ok=True)
    SPECIAL[kind](path)
    if role.startswith("out/"):
        action = "write"
    return Plan(
        number, "special file", what, action, mask=mask, overwrite=True, outputs=outputs_of(action)
    )


def parts(world: World, number: int) -> Plan:
    """A file that belongs to an input is named as an output, and may be overwritten."""
    rng = world.rng
    layout = rng.choice(("external-mask", "external-overviews", "pam", "world-file", "VRT", "HFA"))
    action = rng.choice(("report", "points", "align", "gcps"))
    _put_inputs(world, action, layout if layout not in ("VRT", "HFA") else "striped")
    ms, pan, mask, beside = "ms.tif", "pan.tif", "", []
    if layout == "VRT":
        middle = vrt(shape_of(world, True), source("pan.tif", True))
        world.put({"middle.vrt": middle})
        world.put({"p.vrt": middle.replace(b"pan.tif", rng.choice((b"pan.tif", b"middle.vrt")))})
        pan, beside = "p.vrt", ["pan.tif"]
        if b"middle" in (world.folder / "p.vrt").read_bytes():
            beside.append("middle.vrt")
    elif layout == "HFA":
        world.put(PAYLOADS["HFA"](world, shape_of(world, False), "h.img"))
        ms, beside = "h.img", ["../victims/secret.ige"]
    else:
        names = sound(layout, False, world.side).files
        beside = [name for name in names if name != "ms.tif"]
    target = rng.choice(beside)
    if rng.random() < 0.3:
        spelt = rng.choice(("link", "other"))
        if spelt == "link":
            (world.folder / "link.json").symlink_to(target)
        target = "link.json" if spelt == "link" else f"photos/../{target}"
    if action == "gcps":
        ms, pan = (pan if layout == "VRT" else ms), "in.points"
    what = f"{layout} part"
    return Plan(number, "part of an input", what, action, ms, pan, target, mask, True)


def names(world: World, number: int) -> Plan:
    """Names that look like addresses, options, patterns or escapes."""
    rng = world.rng
    world.put_pair()
    is_plain = rng.random() < 0.7
    name = rng.choice(ODD_NAMES if is_plain else CONTROL_NAMES)
    action = rng.choice(("check", "inplace", "target"))
    what = name.encode("unicode_escape").decode("ascii", "replace")
    if action == "target":
        return Plan(
            number, "odd name", what, "write", target=f"out/{name}",
            outputs=raster_parts(f"out/{name}"), must_work=is_plain and name.endswith(".tif"),
        )  # fmt: skip
    path = world.folder / name
    (world.folder / "ms.tif").rename(path)
    outputs = (name, f"{name}.geodelreg-undo.json") if action == "inplace" else ()
    return Plan(number, "odd name", what, action, name, outputs=outputs, must_work=is_plain)
