"""Broken TIFFs end in an error of ours or in a good output, never in anything else."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import rasterio

from geodelreg.errors import GeodelregError, RasterUnreadableError
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.geotiff.inplace import edit_in_place, revert
from geodelreg.options import WriteOptions
from geodelreg.tiff import TiffFile
from geodelreg.values.result import Correction
from tests.integration.faults import names
from tests.integration.raster_samples import (
    GCPS,
    ROTATION,
    SHIFT,
    TAGS,
    TRANSFORM,
    UTM18,
    make_cog,
    make_tiff,
)

WKT = rasterio.crs.CRS.from_string(UTM18).to_wkt()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """Content of sound files of several layouts."""
    folder = tmp_path_factory.mktemp("sound")
    files = [
        make_tiff(folder / f"{encoding}.tif", encoding, shape=(40, 50), mask="internal")
        for encoding in ("striped", "tiled-deflate", "bigtiff", "big-endian")
    ]
    return [path.read_bytes() for path in (*files, make_cog(folder / "cog.tif"))]


def mutations(sound: list[bytes], seed: int, number: int) -> Iterator[bytes]:
    """Sound files with a few bytes changed or cut out, most of them in their directories."""
    rng = random.Random(seed)
    for _ in range(number):
        data = bytearray(rng.choice(sound))
        for _ in range(rng.choice([1, 1, 2, 4])):
            part = rng.choice([16, 3000, 3000, 3000, len(data)])
            place = rng.randrange(min(part, len(data)))
            kind = rng.randrange(3)
            if kind == 0:
                data[place] = rng.randrange(256)
            elif kind == 1:
                data[place : place + 4] = rng.choice([b"\xff" * 4, bytes(4), b"\x7f\xff\xff\xff"])
            else:
                del data[place : place + rng.randrange(1, 50)]
        yield bytes(data)


# rasterio drops messages of GDAL that are no UTF-8 in this way
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("seed", [1, 2])
def test_mutated_tiffs_are_refused_or_written(
    tmp_path: Path, sound: list[bytes], seed: int
) -> None:
    source, out = tmp_path / "ms.tif", tmp_path / "out.tif"
    refusals = []
    for number, data in enumerate(mutations(sound, seed, 60)):
        source.write_bytes(data)
        change = (SHIFT, ROTATION)[number % 2]
        correction = Correction("affine", WKT, TRANSFORM, TRANSFORM @ change)
        refusal = refusal_of(source, out, correction)
        refusals.append(refusal)
        if refusal is None:
            with rasterio.open(out) as dataset:
                assert dataset.transform.almost_equals(correction.corrected, precision=1e-6)
        else:
            assert "ms.tif" in refusal or "out.tif" in refusal
        assert source.read_bytes() == data
        with suppress(GeodelregError):
            edit_in_place(source, correction, GCPS, TAGS)
            revert(source)
        assert source.read_bytes() == data
        assert names(tmp_path) <= {"ms.tif", "out.tif"}
    assert 5 < refusals.count(None) < 55


def refusal_of(source: Path, out: Path, correction: Correction) -> str | None:
    try:
        write_corrected(source, out, correction, GCPS, TAGS, WriteOptions(overwrite=True))
    except GeodelregError as error:
        return error.cause
    return None


def test_directories_in_a_circle_and_endless_values_are_refused(tmp_path: Path) -> None:
    path = make_tiff(tmp_path / "ms.tif", "striped", shape=(20, 30))
    with path.open("rb") as file:
        tiff = TiffFile(path, file)
        main = tiff.first_directory()
        link = main.offset + main.byte_length(tiff.layout) - 4
    sound = path.read_bytes()
    circle = bytearray(sound)
    circle[link : link + 4] = struct.pack("<I", main.offset)
    path.write_bytes(circle)
    with path.open("rb") as file, pytest.raises(RasterUnreadableError, match=r"ms\.tif.*circle"):
        TiffFile(path, file).directories()
    endless = bytearray(sound)
    endless[main.offset + 2 + 4 : main.offset + 2 + 8] = b"\xff\xff\xff\xff"
    path.write_bytes(endless)
    with path.open("r+b") as file:
        file.truncate(2**36)
    with path.open("rb") as file, pytest.raises(RasterUnreadableError, match="impossibly long"):
        TiffFile(path, file).directories()
