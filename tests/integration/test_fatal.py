"""TIFFs that GDAL dies of are refused before it reads them, and sound ones never are.

Without the check these tests end the process.
"""

from __future__ import annotations

import struct
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from rasterio.shutil import copy as gdal_copy

from benchmarks.robustness.mutations import parse
from benchmarks.robustness.seeds import make_seeds
from geodelreg.errors import RasterUnreadableError
from geodelreg.fatal import check_survivable
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.geotiff.inplace import edit_in_place
from geodelreg.options import WriteOptions
from geodelreg.product.warp import write_warped
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Grid, Window
from tests.integration.faults import contents
from tests.integration.raster_samples import (
    ENCODINGS,
    GCPS,
    TAGS,
    TRANSFORM,
    UTM18,
    correction_of,
    make_cog,
    make_tiff,
)

COMPRESSION, PHOTOMETRIC, SAMPLES = 259, 262, 277


def patch(path: Path, tag: int, value: int, directory: int = 0) -> None:
    """Give a tag of one directory another value."""
    data = bytearray(path.read_bytes())
    tiff = parse(bytes(data))
    assert tiff is not None
    slot = [slot for slot in tiff.slots if slot.tag == tag][directory]
    struct.pack_into(tiff.order + "H", data, slot.value_at, value)
    path.write_bytes(data)


def read(path: Path | str) -> None:
    with open_raster(path) as reader:
        height, width = reader.grid.shape
        reader.read([1], Window(0, 0, width, height))
        reader.read([1], Window(0, 0, width, height), (height // 4, width // 4))


@pytest.mark.parametrize("samples", [1, 2, 4])
@pytest.mark.parametrize("bigtiff", ["no", "yes"])
@pytest.mark.parametrize("order", ["little", "big"])
def test_jpeg_of_other_than_three_samples(
    tmp_path: Path, order: str, bigtiff: str, samples: int
) -> None:
    path = make_tiff(tmp_path / "ms.tif", "jpeg", endianness=order, bigtiff=bigtiff)
    read(path)
    correction = correction_of(path)
    patch(path, SAMPLES, samples)
    before, reference = contents(tmp_path), Grid(TRANSFORM, (80, 80), correction.crs_wkt)
    with pytest.raises(RasterUnreadableError, match=rf"ms\.tif contradicts.*have {samples}\. The"):
        read(path)
    plain, warped = WriteOptions(creation_options=("COMPRESS=LZW",)), WriteOptions(warp=True)
    with pytest.raises(RasterUnreadableError, match="contradicts itself"):
        write_corrected(path, tmp_path / "out.tif", correction, GCPS, TAGS, plain)
    with pytest.raises(RasterUnreadableError, match="contradicts itself"):
        write_warped(path, tmp_path / "out.tif", correction, reference, TAGS, warped)
    with pytest.raises(RasterUnreadableError, match="contradicts itself"):
        edit_in_place(path, correction, GCPS, TAGS)
    assert contents(tmp_path) == before


def test_many_bits_without_subsampling(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    data = np.random.default_rng(0).integers(0, 999, (48, 48, 4)).astype(np.uint16)
    layout: dict[str, Any] = {"tile": (16, 16), "compression": "zlib", "planarconfig": "contig"}
    tifffile.imwrite(path, data, photometric="ycbcr", subsampling=(1, 1), **layout)
    with pytest.raises(RasterUnreadableError, match="contradicts itself"):
        read(path)


@pytest.mark.parametrize("signed", [8, 9])
def test_numbers_may_be_signed(tmp_path: Path, signed: int) -> None:
    """libtiff takes them, so a sound file with them is sound, and a deadly one deadly."""
    path = make_tiff(tmp_path / "ms.tif", "jpeg")
    data = bytearray(path.read_bytes())
    tiff = parse(bytes(data))
    assert tiff is not None
    for slot in tiff.slots:
        if slot.tag in (PHOTOMETRIC, SAMPLES):
            struct.pack_into(tiff.order + "H", data, slot.at + 2, signed)
    path.write_bytes(data)
    check_survivable(path)
    patch(path, SAMPLES, 1)
    with pytest.raises(RasterUnreadableError, match="contradicts itself"):
        check_survivable(path)


def cut_off_after_entries(path: Path) -> None:
    """Move the main directory to the end of the file, without the offset that ends it."""
    data = bytearray(path.read_bytes())
    tiff = parse(bytes(data))
    assert tiff is not None
    struct.pack_into(tiff.pointer, data, tiff.links[0], len(data))
    path.write_bytes(data + data[tiff.offsets[0] : tiff.links[1]])


@pytest.mark.parametrize("bigtiff", ["no", "yes"])
def test_cut_off_after_the_last_entry(tmp_path: Path, bigtiff: str) -> None:
    """libtiff opens such a file, with a warning."""
    sound = make_tiff(tmp_path / "sound.tif", "jpeg", bigtiff=bigtiff)
    deadly = make_tiff(tmp_path / "deadly.tif", "jpeg", bigtiff=bigtiff)
    patch(deadly, SAMPLES, 1)
    cut_off_after_entries(sound)
    cut_off_after_entries(deadly)
    read(sound)
    with pytest.raises(RasterUnreadableError, match="contradicts itself"):
        read(deadly)


def test_overviews_beside_it(tmp_path: Path) -> None:
    layout: dict[str, Any] = {"count": 1, "dtype": "uint8", "overviews": "external"}
    path = make_tiff(tmp_path / "ms.tif", shape=(600, 600), **layout)
    read(path)
    for tag, value in ((COMPRESSION, 7), (PHOTOMETRIC, 6)):
        patch(tmp_path / "ms.tif.ovr", tag, value)
    with pytest.raises(RasterUnreadableError, match=r"ms\.tif\.ovr contradicts itself"):
        read(path)


def test_source_of_a_vrt(tmp_path: Path) -> None:
    path, vrt = make_tiff(tmp_path / "ms.tif", "jpeg"), tmp_path / "view.vrt"
    gdal_copy(path, vrt, driver="VRT")
    patch(path, SAMPLES, 1)
    with pytest.raises(RasterUnreadableError, match=r"ms\.tif contradicts itself"):
        read(vrt)


def test_overviews_that_gdal_passes_over_are_left_alone(tmp_path: Path) -> None:
    path = make_tiff(tmp_path / "ms.tif", "jpeg", overviews="internal", shape=(600, 600))
    patch(path, SAMPLES, 1, directory=1)
    with rasterio.open(path) as dataset:
        assert dataset.overviews(1) == [4]
    read(path)


def test_inside_an_archive(tmp_path: Path) -> None:
    path = make_tiff(tmp_path / "ms.tif", "jpeg")
    patch(path, SAMPLES, 1)
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(path, "ms.tif")
    with pytest.raises(RasterUnreadableError, match=r"ms\.tif contradicts itself"):
        read(f"/vsizip/{tmp_path}/a.zip/ms.tif")


def test_sound_files_pass(tmp_path: Path) -> None:
    for number, encoding in enumerate(ENCODINGS):
        for kind in ("internal", "external"):
            path = make_tiff(tmp_path / f"{number}{kind}.tif", encoding, mask=kind, overviews=kind)
            check_survivable(path)
    check_survivable(make_cog(tmp_path / "cog.tif"))
    for seed in [*make_seeds(False), *make_seeds(True)]:
        (tmp_path / seed.main).write_bytes(next(iter(seed.files.values())))
        check_survivable(tmp_path / seed.main)
    for data in (b"", b"II", b"II*\0", b"II*\0" + b"\xff" * 12, b"MM\0+" + b"\xff" * 400):
        (tmp_path / "odd").write_bytes(data)
        check_survivable(tmp_path / "odd")
    check_survivable(tmp_path / "none")
    check_survivable(tmp_path)


def test_any_damaged_header_can_be_looked_at(tmp_path: Path) -> None:
    path = make_tiff(tmp_path / "ms.tif", "jpeg", overviews="internal", shape=(70, 70))
    data, random = path.read_bytes(), np.random.default_rng(0)
    for _ in range(2000):
        broken = bytearray(data[: random.integers(8, len(data))])
        for at in random.integers(4, min(len(broken), 3000), 6):
            broken[at] = random.integers(256)
        path.write_bytes(broken)
        with suppress(RasterUnreadableError):
            check_survivable(path)


def test_a_circle_of_directories_ends(tmp_path: Path) -> None:
    path = make_tiff(tmp_path / "ms.tif")
    tiff = parse(path.read_bytes())
    assert tiff is not None
    data = bytearray(path.read_bytes())
    struct.pack_into(tiff.pointer, data, tiff.links[-1], tiff.offsets[0])
    path.write_bytes(data)
    check_survivable(path)
    with rasterio.open(path) as dataset:
        assert dataset.crs == UTM18
