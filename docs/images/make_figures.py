"""Draw the figures of the gallery and of refusals: ``python docs/images/make_figures.py``.

Needs ``pip install -e '.[report]'``.  All are of the sample pair.  For the refusals its MS is
changed in ways that no header can put right.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from PIL import Image

import geodelreg
from geodelreg.errors import AlignmentRefusedError
from geodelreg.report.figures import draw_figure

HERE = Path(__file__).parent
SAMPLES = HERE.parents[1] / "sample_tiles"
WIDTH = 900
"""Of the pictures, in pixels."""


def moved(ms: NDArray[np.uint16], right_px: NDArray[np.float32]) -> NDArray[np.uint16]:
    """MS whose content lies to the right by so many of its pixels, place by place."""
    rows, columns = np.mgrid[: ms.shape[1], : ms.shape[2]].astype(np.float32)
    bands = [
        cv2.remap(band.astype(np.float32), columns - right_px, rows, cv2.INTER_CUBIC,
                  borderMode=cv2.BORDER_REFLECT)
        for band in ms
    ]  # fmt: skip
    return np.clip(np.rint(bands), 1, 4095).astype(np.uint16)


def bent(ms: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """As by a sensor that swayed: a wave of 1.5 pixels of MS."""
    rows = np.arange(ms.shape[1], dtype=np.float32)[:, None]
    wave = 1.5 * np.sin(2 * np.pi * rows / ms.shape[1])
    return moved(ms, np.broadcast_to(wave, ms.shape[1:]).astype(np.float32))


def torn(ms: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """As by a mosaic: the lower right quarter lies 3 pixels of MS to the right."""
    shift = np.zeros(ms.shape[1:], dtype=np.float32)
    shift[ms.shape[1] // 2 :, ms.shape[2] // 2 :] = 3
    return moved(ms, shift)


def mirrored(ms: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Other ground: no place of PAN looks like it."""
    return np.ascontiguousarray(ms[:, :, ::-1])


def corner(ms: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Nothing but a corner shows anything."""
    noise = np.random.default_rng(0).normal(np.median(ms), 2.0, ms.shape)
    out = noise.astype(np.uint16)
    out[:, :40, :40] = ms[:, :40, :40]
    return out


def shaded(ms: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Bright slopes to one side, dark ones to the other, as light falls on relief."""
    slope = np.gradient(
        [cv2.GaussianBlur(band.astype(np.float32), (0, 0), 1.5) for band in ms], axis=2
    )
    return np.clip(1000 + 300 * slope / slope.std(), 1, 60_000).astype(np.uint16)


def apart(ms: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """The third band lies elsewhere than the others."""
    out = ms.copy()
    out[2] = np.roll(ms[2], (2, 3), axis=(0, 1))
    return out


def draw_colours(ms: NDArray[np.uint16], name: str) -> None:
    """Three bands as red, green and blue, a part of them enlarged."""
    part = ms[[2, 1, 0], 60:140, 40:160].astype(np.float32)
    low, high = np.percentile(part, (1, 99), axis=(1, 2), keepdims=True)
    picture = (255 * np.clip((part - low) / (high - low), 0, 1)).astype(np.uint8)
    Image.fromarray(np.ascontiguousarray(picture.transpose(1, 2, 0))).resize(
        (WIDTH, WIDTH * 2 // 3), Image.Resampling.NEAREST
    ).save(HERE / f"{name}.jpg", quality=80, optimize=True)


def draw(ms: Path, kind: str, name: str) -> None:
    """A figure of a pair with PAN, aligned or refused, at the size of a page."""
    try:
        alignment = geodelreg.align(ms, SAMPLES / "pan.tif")
    except AlignmentRefusedError as refusal:
        if refusal.alignment is None:
            raise
        alignment = refusal.alignment
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder, "figure.png")
        draw_figure(alignment, kind, drawn)
        picture = Image.open(drawn).convert("RGB")
    height = round(picture.height * WIDTH / picture.width)
    picture.resize((WIDTH, height), Image.Resampling.LANCZOS).save(
        HERE / f"{name}.jpg", quality=80, optimize=True
    )


def main() -> None:
    """Write all."""
    for kind in ("arrows", "mesh", "error", "matches"):
        draw(SAMPLES / "ms.tif", kind, f"figure_{kind}")
    with rasterio.open(SAMPLES / "ms.tif") as dataset, tempfile.TemporaryDirectory() as folder:
        draw_colours(apart(dataset.read()), "refusal_apart")
        harms = (
            (bent, "arrows"), (torn, "mesh"), (mirrored, "matches"), (corner, "mesh"),
            (shaded, "before-after"),
        )  # fmt: skip
        for harm, kind in harms:
            path = Path(folder, f"{harm.__name__}.tif")
            with rasterio.open(path, "w", **dataset.profile) as out:
                out.write(harm(dataset.read()))
            draw(path, kind, f"refusal_{harm.__name__}")


if __name__ == "__main__":
    main()
