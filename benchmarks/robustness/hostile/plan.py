"""A hostile case: the files of it, and what geodelreg is asked to do."""

from __future__ import annotations

import random
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from benchmarks.robustness.seeds import UTM, Seed, make_seeds

PAN_SIDE = 80
COMMAND_SIDE = 192
"""Pixels of PAN where the command has to align: it writes nothing else."""

READING = ("check", "check", "write", "inplace")


@dataclass(frozen=True, slots=True)
class Plan:
    """What geodelreg is asked to do in the folder of a case; names are relative to that.

    Attributes
    ----------
    family, what : str
        For the table, and for whoever looks into a fault.
    action : str
        Key of `benchmarks.robustness.hostile.doing.DOING`.
    ms, pan, target, mask : str
    overwrite : bool
    outputs : tuple of str
        What may have changed afterwards: what the user named, and what belongs to it.
    must_work : bool
        The input is honest: an error is a fault.
    by_command : bool
        Through the command, in a process of its own; else through the Python API.
    """

    number: int
    family: str
    what: str
    action: str
    ms: str = "ms.tif"
    pan: str = "pan.tif"
    target: str = "out/out.tif"
    mask: str = ""
    overwrite: bool = False
    outputs: tuple[str, ...] = ()
    must_work: bool = False
    by_command: bool = False

    @property
    def name(self) -> str:
        """Family, what, action, in this order."""
        via = "command" if self.by_command else "API"
        return f"{self.family}, {self.what}, {self.action}, {via}"

    @property
    def is_about_crs(self) -> bool:
        """What is written must have the CRS of MS."""
        return self.family == "CRS" and self.action in ("write", "inplace")


@dataclass(frozen=True, slots=True)
class World:
    """The sandbox of a case and what hostile files can name in it.

    Attributes
    ----------
    root : Path
        Holds the folders ``case``, ``victims``, ``home`` and ``tmp``.
    address : str
        Of a server that counts who connects.
    side : int
        Pixels of PAN.
    """

    root: Path
    address: str
    rng: random.Random = field(default_factory=random.Random)
    side: int = PAN_SIDE

    @property
    def folder(self) -> Path:
        """Where the inputs of the case are."""
        return self.root / "case"

    def victim(self, name: str) -> str:
        """Absolute or relative name of something that no case may change or read."""
        place = "../victims" if self.rng.random() < 0.5 else str(self.root / "victims")
        return f"{place}/{name}"

    def put(self, files: Mapping[str, bytes]) -> None:
        """Write files of the case."""
        for name, data in files.items():
            path = self.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

    def put_pair(self, layout: str = "tiled-deflate") -> None:
        """Write a sound ``ms.tif``, with what belongs to it, and ``pan.tif``."""
        self.put(sound(layout, False, self.side).files)
        self.put({"pan.tif": sound("tiled-deflate", True, self.side).files["ms.tif"]})


def open_world(root: Path, address: str, rng: random.Random, side: int) -> World:
    """Make the folders of a sandbox anew."""
    world = World(root, address, rng, side)
    for name in ("case", "victims", "home", "tmp"):
        shutil.rmtree(root / name, ignore_errors=True)
        (root / name).mkdir(parents=True)
    (world.folder / "out").mkdir()
    (world.folder / "thesis.doc").write_bytes(b"years of work\n")
    (world.folder / "photos").mkdir()
    (world.folder / "photos" / "1.jpg").write_bytes(b"\xff\xd8\xff once in a lifetime")
    victims = root / "victims"
    (victims / "thesis.doc").write_bytes(b"years of work\n")
    (victims / "cache").mkdir()
    (victims / "secret.raw").write_bytes(bytes(range(1, 251)) * 300)
    (victims / "secret.h5").write_bytes(template("secret"))
    (victims / "ground.tif").write_bytes(sound("striped", True, PAN_SIDE).files["ms.tif"])
    return world


@cache
def _layouts(is_pan: bool, side: int) -> dict[str, Seed]:
    return {seed.name: seed for seed in make_seeds(is_pan, side)}


def sound(layout: str, is_pan: bool, side: int) -> Seed:
    """A sound raster, its file called ``ms.tif``."""
    return _layouts(is_pan, side)[layout]


@cache
def template(name: str) -> bytes:
    """HDF5 file that names another; see `payloads.hdf5`."""
    return (Path(__file__).parent / "templates" / f"{name}.h5").read_bytes()


@cache
def utm_wkt() -> str:
    """WKT of the CRS of the sound rasters."""
    from rasterio.crs import CRS

    return str(CRS.from_string(UTM).to_wkt())
