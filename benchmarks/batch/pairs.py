"""Small pairs, all different: windows of the sample pair."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from rasterio.windows import Window

SAMPLE = Path(__file__).resolve().parents[2] / "sample_tiles"
PAN_SIDE, MS_SIDE = 440, 110


def write_pairs(folder: Path, count: int, seed: int = 0) -> Path:
    """Write ``ms_N.tif``, ``pan_N.tif`` and the manifest ``pairs.csv`` of all.

    Parameters
    ----------
    folder : Path
        Made when missing.
    count : int
    seed : int
        Of the places of the windows.

    Returns
    -------
    Path
        The manifest; outputs go to ``out/N.tif``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    rows = []
    with rasterio.open(SAMPLE / "ms.tif") as ms, rasterio.open(SAMPLE / "pan.tif") as pan:
        ratio = ms.transform.a / pan.transform.a
        for number in range(1, count + 1):
            column, row = (int(n) for n in rng.integers(0, pan.width - PAN_SIDE + 1, 2))
            names = f"ms_{number}.tif", f"pan_{number}.tif"
            crop(pan, folder / names[1], (column, row), PAN_SIDE)
            start = (min(int(column / ratio), ms.width - MS_SIDE),
                     min(int(row / ratio), ms.height - MS_SIDE))  # fmt: skip
            crop(ms, folder / names[0], start, MS_SIDE)
            rows.append((*names, f"out/{number}.tif"))
    manifest = folder / "pairs.csv"
    with manifest.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([("ms", "pan", "out"), *rows])
    return manifest


def crop(raster: rasterio.DatasetReader, path: Path, start: tuple[int, int], side: int) -> None:
    """Write a square window of a raster, where it lies."""
    window = Window(*start, side, side)
    profile = {**raster.profile, "width": side, "height": side, "tiled": False,
               "transform": raster.transform @ Affine.translation(*start)}  # fmt: skip
    profile = {k: v for k, v in profile.items() if not k.startswith("block")}
    with rasterio.open(path, "w", **profile) as out:
        out.write(raster.read(window=window))
