"""The command in a process of its own, small rasters, and folders whose every byte is watched."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rasterio

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "sample_tiles"

COMMAND = (sys.executable, "-m", "geodelreg_cli")
Command = Callable[..., subprocess.CompletedProcess[str]]


def run_command(*args: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """``geodelreg ARGS`` with its output captured."""
    command = [*COMMAND, *map(str, args)]
    env = os.environ | {"COLUMNS": "100"}
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=env, timeout=120)


def copy_samples(folder: Path) -> Path:
    for name in ("ms.tif", "pan.tif"):
        shutil.copy(SAMPLES / name, folder / name)
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
