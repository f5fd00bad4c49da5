"""Headers edited in place: old or new at any moment, and taken back bit by bit."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from affine import Affine

from geodelreg import write_in_place
from geodelreg.errors import (
    FileLockedError,
    OutputUnwritableError,
    RasterNotFoundError,
    UnsafeInPlaceError,
)
from geodelreg.geotiff.inplace import edit_in_place, revert
from geodelreg.values.result import Correction, Outcome, Verdict
from tests.integration.faults import (
    contents,
    names,
    restore,
    run_as_ordinary_user,
    run_killed,
    run_with_error,
)
from tests.integration.raster_samples import (
    ENCODINGS,
    GCPS,
    ROTATION,
    SHIFT,
    TAGS,
    TRANSFORM,
    UTM18,
    assert_same_pixels,
    correction_of,
    description,
    encoded_blocks,
    make_cog,
    make_tiff,
    transform_of,
)
from tests.unit.alignment_sample import alignment

UNDO = ".geodelreg-undo.json"


def edit(path: Path, change: Affine = SHIFT) -> None:
    assert edit_in_place(path, correction_of(path, change), GCPS, TAGS) == []


@pytest.mark.parametrize("change", [SHIFT, ROTATION], ids=["shift", "rotation"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_header_changes_and_comes_back(tmp_path: Path, encoding: str, change: Affine) -> None:
    raster = make_tiff(tmp_path / "ms.tif", encoding, mask="internal", overviews="internal")
    original, blocks, said = raster.read_bytes(), encoded_blocks(raster), description(raster)
    edit(raster, change)
    assert transform_of(raster).almost_equals(TRANSFORM @ change, precision=1e-9)
    assert encoded_blocks(raster) == blocks
    assert description(raster) == said
    with rasterio.open(raster) as dataset:
        assert TAGS.items() <= dataset.tags().items()
        assert len(json.loads(dataset.tags(ns="GEODELREG")["GCPS"])) == len(GCPS)
    changed = np.frombuffer(raster.read_bytes()[: len(original)], dtype=np.uint8)
    different = np.flatnonzero(changed != np.frombuffer(original, dtype=np.uint8))
    assert set(different.tolist()) <= set(range(4, 16))  # the pointer in the header alone
    revert(raster)
    assert raster.read_bytes() == original
    assert names(tmp_path) == {"ms.tif"}


def test_several_edits_are_taken_back_together(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    original = raster.read_bytes()
    edit(raster)
    edit(raster, ROTATION)
    assert transform_of(raster).almost_equals(TRANSFORM @ SHIFT @ ROTATION, precision=1e-9)
    revert(raster)
    assert raster.read_bytes() == original
    assert names(tmp_path) == {"ms.tif"}


def test_pixels_of_a_file_of_odd_length_stay(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    with raster.open("ab") as file:
        file.write(b"x" * (1 + raster.stat().st_size % 2))
    original = raster.read_bytes()
    assert len(original) % 2
    edit(raster)
    with tifffile.TiffFile(raster) as tiff:
        assert tiff.pages[0].offset % 2 == 0
    revert(raster)
    assert raster.read_bytes() == original


def test_stale_pam_and_world_file_follow(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    pam, world = tmp_path / "ms.tif.aux.xml", tmp_path / "ms.tfw"
    pam.write_text(
        "<PAMDataset><SRS>EPSG:32617</SRS><GeoTransform>7,3,0,8,0,-3</GeoTransform>"
        '<Metadata><MDI key="NOTE">kept</MDI></Metadata></PAMDataset>'
    )
    world.write_text("3\n0\n0\n-3\n8.5\n6.5\n")
    before = contents(tmp_path)
    assert transform_of(raster) == Affine(3, 0, 7, 0, -3, 8)
    edit(raster)
    wanted = Affine(3, 0, 7, 0, -3, 8) @ SHIFT
    with rasterio.open(raster) as dataset:
        assert dataset.transform == wanted
        assert dataset.crs == "EPSG:32617"
        assert dataset.tags()["NOTE"] == "kept"
    with rasterio.open(raster, GEOREF_SOURCES="WORLDFILE") as dataset:
        assert dataset.transform.almost_equals(wanted, precision=1e-9)
    revert(raster)
    assert contents(tmp_path) == before


def test_raster_placed_by_its_world_file_alone(tmp_path: Path) -> None:
    raster = tmp_path / "ms.tif"
    tifffile.imwrite(raster, np.arange(600, dtype=np.uint16).reshape(20, 30))
    (tmp_path / "ms.tfw").write_text("2\n0\n0\n-2\n101\n199\n")
    (tmp_path / "ms.tif.aux.xml").write_text(f"<PAMDataset><SRS>{UTM18}</SRS></PAMDataset>")
    before = contents(tmp_path)
    edit(raster, ROTATION)
    assert not (tmp_path / "ms.tif.aux.xml").exists()
    with rasterio.open(raster, GEOREF_SOURCES="INTERNAL") as dataset:
        assert dataset.crs == UTM18
        wanted = Affine(2, 0, 100, 0, -2, 200) @ ROTATION
        assert dataset.transform.almost_equals(wanted, precision=1e-9)
    revert(raster)
    assert contents(tmp_path) == before


def test_link_is_followed(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    link = tmp_path / "link.tif"
    link.symlink_to(raster)
    edit(link)
    assert link.is_symlink()
    assert transform_of(raster) == TRANSFORM @ SHIFT
    revert(link)
    assert transform_of(raster) == TRANSFORM


def test_rpcs_are_warned_about(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    add_rpcs(raster)
    warnings = edit_in_place(raster, correction_of(raster), GCPS, TAGS)
    assert len(warnings) == 1
    assert "RPC" in warnings[0]


def add_rpcs(raster: Path) -> None:
    coefficients = " ".join(["1"] * 20)
    names_ = ("LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF")
    scales = ("LINE_SCALE", "SAMP_SCALE", "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE")
    series = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")
    rpc = dict.fromkeys((*names_, *scales), "1") | dict.fromkeys(series, coefficients)
    with rasterio.open(raster, "r+") as dataset:
        dataset.update_tags(ns="RPC", **rpc)


def test_cogs_are_refused(tmp_path: Path) -> None:
    raster = make_cog(tmp_path / "ms.tif")
    before = contents(tmp_path)
    with pytest.raises(UnsafeInPlaceError, match=r"ms\.tif is a cloud optimised.*another file"):
        edit_in_place(raster, correction_of(raster), GCPS, TAGS)
    assert contents(tmp_path) == before


def test_classic_tiff_at_its_limit_is_refused(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    with raster.open("r+b") as file:
        file.truncate(2**32 - 100)
    with pytest.raises(UnsafeInPlaceError, match=r"ms\.tif.*4 GB.*another file"):
        edit_in_place(raster, correction_of(raster), GCPS, TAGS)
    assert names(tmp_path) == {"ms.tif"}
    assert raster.stat().st_size == 2**32 - 100


def test_sparse_raster_of_20_gb(tmp_path: Path) -> None:
    raster = tmp_path / "ms.tif"
    profile = {"driver": "GTiff", "width": 50_000, "height": 50_000, "count": 4, "dtype": "uint16"}
    profile |= {"bigtiff": "yes", "tiled": True, "crs": UTM18, "transform": TRANSFORM}
    with rasterio.open(raster, "w", sparse_ok=True, **profile):
        pass
    with raster.open("r+b") as file:
        file.truncate(20 * 10**9)
    edit(raster)
    assert transform_of(raster) == TRANSFORM @ SHIFT
    assert raster.stat().st_blocks * 512 < 100_000_000
    revert(raster)
    assert raster.stat().st_size == 20 * 10**9
    assert transform_of(raster) == TRANSFORM


def test_other_formats_are_refused(tmp_path: Path) -> None:
    raster = tmp_path / "ms.png"
    profile = {"driver": "PNG", "width": 9, "height": 9, "count": 1, "dtype": "uint8"}
    with rasterio.open(raster, "w", **profile, transform=TRANSFORM, crs=UTM18) as dataset:
        dataset.write(np.ones((1, 9, 9), dtype=np.uint8))
    with pytest.raises(UnsafeInPlaceError, match=r"ms\.png is no TIFF"):
        edit_in_place(raster, correction_of(raster), GCPS, TAGS)
    with pytest.raises(RasterNotFoundError, match=r"no\.tif"):
        revert(tmp_path / "no.tif")


def test_unreadable_pam_is_refused(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    correction = correction_of(raster)
    (tmp_path / "ms.tif.aux.xml").write_text("<PAMDataset><SRS>")
    before = contents(tmp_path)
    with pytest.raises(UnsafeInPlaceError, match=r"aux\.xml"):
        edit_in_place(raster, correction, GCPS, TAGS)
    assert contents(tmp_path) == before


def test_revert_refuses_without_a_record_and_after_foreign_changes(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    with pytest.raises(UnsafeInPlaceError, match="no record"):
        revert(raster)
    edit(raster)
    with rasterio.open(raster, "r+") as dataset:
        dataset.update_tags(EDITED="elsewhere")
    before = contents(tmp_path)
    with pytest.raises(UnsafeInPlaceError, match="changed by another program"):
        revert(raster)
    assert contents(tmp_path) == before
    warnings = edit_in_place(raster, correction_of(raster), GCPS, TAGS)
    assert "changed by another program" in warnings[0]
    revert(raster)
    assert raster.read_bytes() == before["ms.tif"]


def test_revert_decides_before_it_takes_anything_back(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    size = raster.stat().st_size
    edit(raster)
    edit(raster, ROTATION)
    edit(raster)
    content = bytearray(raster.read_bytes())
    content[size + 20] ^= 1  # within what the first edit has appended
    raster.write_bytes(content)
    before = contents(tmp_path)
    with pytest.raises(UnsafeInPlaceError, match="changed by another program"):
        revert(raster)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("done", ["recorded", "begun", "appended", "complete"])
def test_revert_takes_back_an_edit_that_was_interrupted_after_others(
    tmp_path: Path, done: str
) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    original = raster.read_bytes()
    edit(raster)
    between = raster.read_bytes()
    edit(raster, ROTATION)
    after = raster.read_bytes()
    appended = between + after[len(between) :]
    stages = {"recorded": between, "begun": appended[: len(between) + 7], "appended": appended}
    raster.write_bytes(stages.get(done, after))
    revert(raster)
    assert raster.read_bytes() == original
    assert names(tmp_path) == {"ms.tif"}


@pytest.mark.parametrize(
    "damage",
    [
        "not json",
        '{"version": 99, "edits": []}',
        '{"version": 1}',
        '{"version": 1, "edits": [{"size": 0}]}',
        "[]",
    ],
)
def test_damaged_record_is_refused(tmp_path: Path, damage: str) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    (tmp_path / f"ms.tif{UNDO}").write_text(damage)
    before = contents(tmp_path)
    for work in (revert, edit):
        with pytest.raises(UnsafeInPlaceError, match=r"geodelreg-undo\.json"):
            work(raster)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("size", 8),
        ("size", float("inf")),
        ("tail", base64.b64encode(zlib.compress(b"")).decode()),
        ("tail", base64.b64encode(zlib.compress(bytes(1 << 29))).decode()),
        ("old_pointer", "00000000"),
    ],
    ids=["short", "infinite", "nothing appended", "bomb", "pointer"],
)
def test_altered_record_never_reaches_the_raster(tmp_path: Path, key: str, value: object) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    edit(raster)
    record = tmp_path / f"ms.tif{UNDO}"
    document = json.loads(record.read_text())
    document["edits"][0][key] = value
    record.write_text(json.dumps(document))
    before = contents(tmp_path)
    with pytest.raises(UnsafeInPlaceError, match=r"geodelreg-undo\.json"):
        revert(raster)
    assert contents(tmp_path) == before


def test_record_cannot_name_files_elsewhere(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    raster, victim = make_tiff(folder / "ms.tif"), tmp_path / "victim"
    victim.write_text("precious")
    edit(raster)
    record = folder / f"ms.tif{UNDO}"
    document = json.loads(record.read_text())
    document["edits"][0]["sidecars"] = [{"name": "../victim", "before": None, "after": None}]
    record.write_text(json.dumps(document))
    with pytest.raises(UnsafeInPlaceError, match="does not belong"):
        revert(raster)
    assert victim.read_text() == "precious"


def test_second_process_is_locked_out(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    folder = tmp_path / ".ms.tif.geodelreg"
    folder.mkdir()
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for work in (edit, revert):
            with pytest.raises(FileLockedError, match=r"ms\.tif"):
                work(raster)
    edit(raster)
    assert names(tmp_path) == {"ms.tif", f"ms.tif{UNDO}"}


@pytest.fixture
def memory_folder() -> Iterator[Path]:
    """Folder where flushing costs nothing, on systems that have one."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as name:
        yield Path(name)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """Folder that other users may read, which pytest's own are not."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


def test_read_only_file_and_folder_are_refused(open_folder: Path) -> None:
    raster = make_tiff(open_folder / "ms.tif")
    correction = correction_of(raster)
    before = contents(open_folder)

    def attempt() -> None:
        with pytest.raises(OutputUnwritableError, match=r"ms\.tif"):
            edit_in_place(raster, correction, GCPS, TAGS)

    raster.chmod(0o444)
    assert run_as_ordinary_user(attempt)
    raster.chmod(0o666)
    open_folder.chmod(0o555)
    assert run_as_ordinary_user(attempt)
    open_folder.chmod(0o755)
    assert contents(open_folder) == before


def georeferencing_of(raster: Path) -> tuple[Affine, str]:
    with rasterio.open(raster) as dataset:
        return dataset.transform, dataset.crs.to_string()


def fragile_raster(folder: Path) -> Path:
    """TIFF whose georeferencing is in all three places."""
    raster = make_tiff(folder / "ms.tif", "tiled-deflate", shape=(40, 50), mask="internal")
    (folder / "ms.tif.aux.xml").write_text(
        "<PAMDataset><SRS>EPSG:32617</SRS><GeoTransform>7,3,0,8,0,-3</GeoTransform></PAMDataset>"
    )
    (folder / "ms.tfw").write_text("3\n0\n0\n-3\n8.5\n6.5\n")
    return raster


def test_error_at_every_call_leaves_the_old_file(memory_folder: Path) -> None:
    raster = fragile_raster(memory_folder)
    correction, before = correction_of(raster), contents(memory_folder)
    step, failed = 0, True
    while failed:
        step += 1
        failed = run_with_error(lambda: edit_in_place(raster, correction, GCPS, TAGS), step)
        if failed and contents(memory_folder) != before:
            # the fault hit the last clean-up; then the edit is whole
            assert georeferencing_of(raster)[0] == correction.corrected
            revert(raster)
        restore(memory_folder, before)
    assert step > 15


@pytest.mark.parametrize("kind", ["plain", "fragile"])
def test_kill_within_every_call_leaves_old_or_new(memory_folder: Path, kind: str) -> None:
    raster = (
        fragile_raster(memory_folder) if kind == "fragile" else make_tiff(memory_folder / "ms.tif")
    )
    correction, before = correction_of(raster), contents(memory_folder)
    old, blocks = georeferencing_of(raster), encoded_blocks(raster)
    edit_in_place(raster, correction, GCPS, TAGS)
    new, edited = georeferencing_of(raster), contents(memory_folder)
    restore(memory_folder, before)

    step, seen = 1, set()
    while run_killed(partial(edit_in_place, raster, correction, GCPS, TAGS), step, partly=True):
        seen.add(georeferencing_of(raster))
        assert encoded_blocks(raster) == blocks
        edit_in_place(raster, correction, GCPS, TAGS)
        assert georeferencing_of(raster) == new
        revert(raster)
        assert contents(memory_folder) == before
        assert names(memory_folder) == set(before)
        step += 1
    assert seen == {old, new}

    restore(memory_folder, edited)
    step, seen = 1, set()
    while run_killed(partial(revert, raster), step, partly=True):
        seen.add(georeferencing_of(raster))
        assert encoded_blocks(raster) == blocks
        if (memory_folder / f"ms.tif{UNDO}").exists():
            revert(raster)
        assert contents(memory_folder) == before
        restore(memory_folder, edited)
        step += 1
    assert seen == {old, new}


LOOP = """
import sys
from pathlib import Path
from affine import Affine
from geodelreg.geotiff.inplace import edit_in_place, revert
from tests.integration.raster_samples import GCPS, TAGS, correction_of
raster = Path(sys.argv[1])
print("ready", flush=True)
while True:
    edit_in_place(raster, correction_of(raster), GCPS, TAGS)
    revert(raster)
"""


def test_kill_9_at_random_times(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    original, blocks = raster.read_bytes(), encoded_blocks(raster)
    delays = random.Random(5)
    root = Path(__file__).parents[2]
    for _ in range(5):
        with subprocess.Popen(
            [sys.executable, "-c", LOOP, str(raster)], stdout=subprocess.PIPE, cwd=root
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            time.sleep(delays.uniform(0.05, 0.3))
            process.send_signal(signal.SIGKILL)
        assert transform_of(raster) in (TRANSFORM, TRANSFORM @ SHIFT)
        assert encoded_blocks(raster) == blocks
        edit(raster)
        revert(raster)
        assert raster.read_bytes() == original
        assert names(tmp_path) == {"ms.tif"}


def test_pixels_are_read_alike_before_and_after(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif", mask="external", overviews="external")
    copy = tmp_path / "copy.tif"
    for suffix in ("", ".msk", ".ovr", ".msk.ovr"):
        copy.with_name(copy.name + suffix).write_bytes(
            raster.with_name(raster.name + suffix).read_bytes()
        )
    edit(raster)
    for level in (None, 0, 1):
        assert_same_pixels(raster, copy, level)


def test_degenerate_correction_never_reaches_the_file(tmp_path: Path) -> None:
    raster = make_tiff(tmp_path / "ms.tif")
    before = contents(tmp_path)
    nowhere = Correction("affine", UTM18, TRANSFORM, Affine(float("nan"), 0, 0, 0, -2, 0))
    with pytest.raises(OutputUnwritableError, match="georeferencing"):
        edit_in_place(raster, nowhere, GCPS, TAGS)
    assert contents(tmp_path) == before


def test_what_a_killed_run_left_goes_even_when_there_is_nothing_to_edit(tmp_path: Path) -> None:
    """Killed after its last step, a run leaves its lock; the next one finds the file aligned."""
    path = make_tiff(tmp_path / "ms.tif")
    before, private = contents(tmp_path), tmp_path / ".ms.tif.geodelreg"
    private.mkdir()
    (private / "lock").touch()
    verdict = Verdict(Outcome.ALREADY_ALIGNED)
    assert write_in_place(alignment(source_paths=(str(path),), verdict=verdict)) == []
    assert contents(tmp_path) == before
    assert not private.exists()
