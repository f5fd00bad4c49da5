"""The command in a process of its own, small rasters, and folders whose every byte is watched."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

from tests.cli import forked

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "sample_tiles"
SIDE = {"ms.tif": 100, "pan.tif": 400}
"""Pixels across the corner of the sample pair, which is aligned in half the time of the whole."""

COMMAND = (sys.executable, "-m", "geodelreg_cli")
Command = Callable[..., subprocess.CompletedProcess[str]]


@cache
def command_server() -> str:
    """Address of the process that `forked.ask` has the command run by, while the tests run."""
    folder = tempfile.mkdtemp()
    address = f"{folder}/socket"
    server = subprocess.Popen(
        [sys.executable, forked.__file__, address], stdin=subprocess.PIPE, start_new_session=True
    )

    def stop() -> None:
        os.killpg(server.pid, signal.SIGKILL)
        server.communicate()
        shutil.rmtree(folder)

    atexit.register(stop)
    while not Path(address).exists():
        assert server.poll() is None
    return address


def run_command(*args: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """``geodelreg ARGS`` with its output captured."""
    words = list(map(str, args))
    with tempfile.TemporaryFile("w+") as stdout, tempfile.TemporaryFile("w+") as stderr:
        streams = [0, stdout.fileno(), stderr.fileno()]
        folder, env = str(cwd or Path.cwd()), os.environ | {"COLUMNS": "100"}
        code = forked.ask(command_server(), words, folder, env, streams)
        texts = [stream.seek(0) or stream.read() for stream in (stdout, stderr)]
    return subprocess.CompletedProcess(words, code, *texts)


def run_fresh_command(*args: object, cwd: Path) -> None:
    """``geodelreg ARGS`` in a new interpreter, which orders its sets in another way."""
    subprocess.run([*COMMAND, *map(str, args)], cwd=cwd, check=True, capture_output=True)


def copy_samples(folder: Path) -> Path:
    for name in ("ms.tif", "pan.tif"):
        shutil.copy(SAMPLES / name, folder / name)
    return folder


def copy_corner(folder: Path) -> Path:
    """The upper left corner of either sample."""
    for name, side in SIDE.items():
        with rasterio.open(SAMPLES / name) as dataset:
            bands = dataset.read(window=Window(0, 0, side, side))
            profile = dataset.profile | {"height": side, "width": side}
        with rasterio.open(folder / name, "w", **profile) as dataset:
            dataset.write(bands)
    return folder


def write_noise(path: Path, like: Path, seed: int) -> Path:
    """A raster on the grid of another that shows nothing but noise."""
    with rasterio.open(like) as dataset:
        profile = dataset.profile
    values = np.random.default_rng(seed).integers(
        1, 4000, (profile["count"], profile["height"], profile["width"])
    )
    with rasterio.open(path, "w", **profile) as dataset:
        dataset.write(values.astype(profile["dtype"]))
    return path


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its content."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
