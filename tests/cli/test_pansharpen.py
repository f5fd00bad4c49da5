"""``geodelreg pansharpen`` as it is typed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from tests.cli.helpers import Command, snapshot, write_noise

PANSHARPEN = ("pansharpen", "ms.tif", "pan.tif", "-o")


def test_aligned_first_or_taken_as_it_is(geodelreg: Command, pair: Path) -> None:
    for args in (("sharp.tif",), ("raw.tif", "--no-align")):
        done = geodelreg(*PANSHARPEN, *args, cwd=pair)
        assert (done.returncode, done.stdout) == (0, "")
        said = done.stderr.splitlines()
        assert not [line for line in said if line.startswith("Next")]  # it is sharpened
        assert said[-1:] == ([f"Written: {args[0]}"] if len(args) == 1 else [])
    assert geodelreg("align", "ms.tif", "pan.tif", "-o", "al.tif", cwd=pair).returncode == 0
    done = geodelreg("pansharpen", "al.tif", "pan.tif", "-o", "two.tif", "--no-align", cwd=pair)
    assert done.returncode == 0
    images = {}
    for name in ("sharp", "raw", "two"):
        with rasterio.open(pair / f"{name}.tif") as dataset:
            images[name] = dataset.read().astype(float)
            assert dataset.shape == (400, 400)
    with rasterio.open(pair / "sharp.tif") as dataset:
        assert dataset.tags()["GEODELREG_VERDICT"] == "aligned"
    assert np.abs(images["sharp"] - images["two"]).max() <= 1
    assert np.abs(images["sharp"] - images["raw"]).max() > 100


def test_what_is_not_supported_is_refused(geodelreg: Command, pair: Path) -> None:
    write_noise(pair / "ms.tif", pair / "ms.tif", 5)
    before = snapshot(pair)
    done = geodelreg(*PANSHARPEN, "sharp.tif", cwd=pair)
    assert done.returncode == 3
    assert snapshot(pair) == before


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--weights", "many"), "--weights many are no weights"),
        (("--bands", "0"), "--bands 0 are no bands"),
        (("--bit-depth", "99"), "--bit-depth 99"),
        (("--extent", "moon"), "'moon' is not one of"),
        (("--weights", "1,2"), "--weights 1,2 are 2, and 4 bands"),
        (("--bands", "9"), "--bands 9 are not all among the 4 bands"),
        (("--of", "PNG"), "--of PNG is no format"),
        (("--pan-band", "2"), "has no band 2"),
    ],
)
def test_wrong_usage(geodelreg: Command, pair: Path, args: tuple[str, ...], message: str) -> None:
    write_noise(pair / "ms.tif", pair / "ms.tif", 5)  # to be refused if it came to that
    before = snapshot(pair)
    done = geodelreg(*PANSHARPEN, "sharp.tif", *args, cwd=pair)
    assert done.returncode == 2
    assert message in done.stderr
    assert snapshot(pair) == before


def test_an_output_that_exists_stays(geodelreg: Command, pair: Path) -> None:
    (pair / "sharp.tif").write_bytes(b"mine")
    before = snapshot(pair)
    done = geodelreg(*PANSHARPEN, "sharp.tif", cwd=pair)
    assert done.returncode == 1
    assert "--overwrite" in done.stderr
    assert snapshot(pair) == before
