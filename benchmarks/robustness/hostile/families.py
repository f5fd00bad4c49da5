"""Which numbers are hostile cases, and of which family."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from pathlib import Path

from benchmarks.robustness.hostile import inputs, places
from benchmarks.robustness.hostile.plan import (
    COMMAND_SIDE,
    PAN_SIDE,
    Plan,
    World,
    open_world,
)

_ONE_IN = 4
_COMMANDS_ONE_IN = 40
FAMILIES: tuple[Callable[[World, int], Plan], ...] = (
    inputs.sidecars, inputs.sidecars, inputs.drivers, inputs.drivers, inputs.vectors, inputs.crs,
    places.folders, places.special, places.parts, places.names,
)  # fmt: skip


def is_hostile(number: int) -> bool:
    """Every fourth number is a hostile case; the others are mutations."""
    return number % _ONE_IN == _ONE_IN - 1


def prepare(number: int, root: Path, address: str) -> Plan:
    """Make the sandbox of a hostile case anew and say what is to be done in it.

    Parameters
    ----------
    number : int
    root : Path
        Of the sandbox; what was there is removed.
    address : str
        Of the server that counts connections.
    """
    rng = random.Random(f"hostile {number}")
    count = number // _ONE_IN
    by_command = count % _COMMANDS_ONE_IN == 0
    side = COMMAND_SIDE if by_command else PAN_SIDE
    # a path of its own, for GDAL remembers what it could not fetch
    world = open_world(root, f"{address}/{number}", rng, side)
    # numbers that follow each other go through the families, commands do so too
    chosen = (count // _COMMANDS_ONE_IN if by_command else count) % len(FAMILIES)
    plan = FAMILIES[chosen](world, number)
    return dataclasses.replace(plan, by_command=by_command)
