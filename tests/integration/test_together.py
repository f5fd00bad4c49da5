"""Several files of one call: all change or none, whatever happens between them."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import rasterio
from affine import Affine
from pyproj import CRS

import geodelreg
from geodelreg import WriteOptions
from geodelreg.errors import (
    FileLockedError,
    GeodelregError,
    OutputExistsError,
    OutputIsInputError,
    OutputUnwritableError,
    UnsafeInPlaceError,
    UsageError,
)
from geodelreg.geotiff.atomic import staged, tidy, together, write_text_atomically
from geodelreg.geotiff.inplace import edit_in_place
from geodelreg.values.raster import Grid
from geodelreg.values.result import Alignment
from tests.integration.faults import contents, names, restore, run_killed, run_with_error
from tests.integration.raster_samples import (
    GCPS,
    SHIFT,
    TAGS,
    TRANSFORM,
    UTM18,
    correction_of,
    encoded_blocks,
    make_cog,
    make_tiff,
    transform_of,
)
from tests.unit.alignment_sample import alignment

ROOT = Path(__file__).parents[2]
BANDS = ("B1.tif", "B2.tif", "B3.tif")
UNDO = ".geodelreg-undo.json"
WKT = CRS.from_string(UTM18).to_wkt()


@pytest.fixture
def folder() -> Iterator[Path]:
    """Folder where flushing costs nothing, on systems that have one."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as name:
        yield Path(name)


def bands(folder: Path) -> list[Path]:
    return [make_tiff(folder / name, shape=(40, 50), count=1) for name in BANDS]


def found_for(paths: list[Path], corrected: Affine | None = None) -> Alignment:
    """An alignment that moves all of `paths`, as `geodelreg.align` would return it."""
    correction = correction_of(paths[0])
    grid = Grid(correction.original, (40, 50), WKT)
    return alignment(
        source=grid,
        reference=grid,
        source_paths=tuple(map(str, paths)),
        reference_path="pan.tif",
        corrected=corrected or correction.corrected,
    )


def everything(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


OLD = {
    "a.txt": b"old a",
    "a.txt.msk": b"old mask",
    "a.txt.ovr": b"stale",
    "c.txt": b"old c",
    "other": b"not ours",
}
NEW = {
    "a.txt": b"new a",
    "a.txt.msk": b"new mask",
    "b.txt": b"new b",
    "c.txt": b"new c",
    "c.txt.aux.xml": b"new statistics",
    "other": b"not ours",
}


def write_three(folder: Path) -> None:
    """Replace a file and its side file, add one, replace one that gets a side file."""
    with together():
        with staged(folder / "a.txt", overwrite=True, stale=[folder / "a.txt.ovr"]) as work:
            work.write_bytes(b"new a")
            work.with_name("a.txt.msk").write_bytes(b"new mask")
        with staged(folder / "b.txt", overwrite=True) as work:
            work.write_bytes(b"new b")
        with staged(folder / "c.txt", overwrite=True) as work:
            work.write_bytes(b"new c")
            work.with_name("c.txt.aux.xml").write_bytes(b"new statistics")


def touch_each(folder: Path, place: str) -> None:
    """A next run, on one of the targets, that itself fails."""
    with pytest.raises(ZeroDivisionError), staged(folder / place, overwrite=True):
        raise ZeroDivisionError


def test_three_files_appear_together(folder: Path) -> None:
    restore(folder, OLD)
    with together():
        write_three(folder)
        assert contents(folder) == OLD
    assert contents(folder) == NEW
    assert names(folder) == set(NEW)


@pytest.mark.parametrize("failure", [KeyboardInterrupt, ValueError, OutputExistsError("x")])
def test_failure_after_two_of_three_changes_nothing(folder: Path, failure: BaseException) -> None:
    restore(folder, OLD)

    def interrupted() -> None:
        with together():
            write_three(folder)
            raise failure

    with pytest.raises(type(failure) if isinstance(failure, BaseException) else failure):
        interrupted()
    assert contents(folder) == OLD
    assert names(folder) == set(OLD)


def write_half(path: Path) -> None:
    with staged(path, overwrite=False) as work:
        work.write_text("half")
        raise ZeroDivisionError


def test_a_failed_part_that_is_caught_is_left_out(folder: Path) -> None:
    with together():
        write_text_atomically(folder / "a.txt", "a", overwrite=False)
        with pytest.raises(ZeroDivisionError):
            write_half(folder / "b.txt")
    assert contents(folder) == {"a.txt": b"a"}
    assert names(folder) == {"a.txt"}


def write_twice(path: Path) -> None:
    with together():
        write_text_atomically(path, "one", overwrite=True)
        write_text_atomically(path, "two", overwrite=True)


def write_with_a_mask_of_its_own(path: Path) -> None:
    with together():
        write_text_atomically(path.with_name(path.name + ".msk"), "one", overwrite=True)
        with staged(path, overwrite=True) as work:
            work.write_text("two")
            work.with_name(path.name + ".msk").write_text("its mask")


def test_one_place_for_two_outputs_is_refused(folder: Path) -> None:
    with pytest.raises(FileLockedError, match=r"a\.txt"):
        write_twice(folder / "a.txt")
    with pytest.raises(OutputUnwritableError, match=r"a\.txt\.msk.*two outputs"):
        write_with_a_mask_of_its_own(folder / "a.txt")
    assert names(folder) == set()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_error_at_every_call_leaves_all_old_or_all_new(folder: Path, number: int) -> None:
    step, failed = 0, True
    while failed:
        restore(folder, OLD)
        step += 1
        failed = run_with_error(lambda: write_three(folder), step, number)
        assert contents(folder) in (OLD, NEW)
        write_three(folder)
        assert names(folder) == set(NEW)
    assert step > 40


@pytest.mark.parametrize("partly", [False, True], ids=["before", "within"])
@pytest.mark.parametrize("place", ["a.txt", "b.txt", "c.txt"])
def test_kill_at_every_call_is_settled_by_the_next_run_on_any_of_them(
    folder: Path, place: str, partly: bool
) -> None:
    step, seen = 1, set()
    restore(folder, OLD)
    while run_killed(partial(write_three, folder), step, partly):
        touch_each(folder, place)
        left = contents(folder)
        if any(name.startswith(".") for name in names(folder)):
            assert left in (OLD, NEW)  # others hold nothing but an empty or unpublished folder
            for other in ("a.txt", "b.txt", "c.txt"):
                touch_each(folder, other)
        assert contents(folder) == left
        assert left in (OLD, NEW)
        assert names(folder) == set(left)
        seen.add(left == NEW)
        restore(folder, OLD)
        step += 1
    assert contents(folder) == NEW
    assert seen == {False, True}
    assert step > 40


def test_kill_while_an_interrupted_run_is_settled(folder: Path) -> None:
    """Killed at some point, and then again at every point of what the next run does about it."""
    for first in range(20, 200, 7):
        second = 1
        while True:
            restore(folder, OLD)
            if not run_killed(partial(write_three, folder), first, True):
                return
            if not run_killed(partial(touch_each, folder, "b.txt"), second, True):
                break
            for other in ("c.txt", "b.txt", "a.txt"):
                touch_each(folder, other)
            assert contents(folder) in (OLD, NEW)
            assert names(folder) == set(contents(folder))
            second += 1
    pytest.fail("the run has more calls than expected")


def test_a_settled_run_is_named(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    step, told = 1, set()
    restore(folder, OLD)
    while run_killed(partial(write_three, folder), step, True):
        caplog.clear()
        touch_each(folder, "b.txt")
        for record in caplog.records:
            assert "b.txt" in record.getMessage()
            assert "(a.txt, b.txt, c.txt)" in record.getMessage()
            told |= {word for word in ("finishing", "taking back") if word in record.getMessage()}
        for other in ("a.txt", "c.txt"):
            touch_each(folder, other)
        restore(folder, OLD)
        step += 1
    assert told == {"finishing", "taking back"}


def write_into_several_folders(folder: Path) -> None:
    with together():
        for name in ("one/x", "two/y", "z"):
            write_text_atomically(folder / name, name, overwrite=True)


def test_files_in_several_folders(folder: Path) -> None:
    (folder / "one").mkdir()
    (folder / "two").mkdir()
    step = 1
    while run_killed(partial(write_into_several_folders, folder), step, True):
        tidy([folder / "two" / "y"])
        tidy([folder / "one" / "x", folder / "z"])
        assert set(everything(folder)) in (set(), {"one/x", "two/y", "z"})
        for name in everything(folder):
            (folder / name).unlink()
        step += 1
    assert set(everything(folder)) == {"one/x", "two/y", "z"}


def test_runs_with_common_targets_exclude_each_other(folder: Path) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "from geodelreg.errors import FileLockedError\n"
        "from geodelreg.geotiff.atomic import together, write_text_atomically\n"
        "paths = [Path(name) for name in sys.argv[2:]]\n"
        "done = 0\n"
        "while done < 40:\n"
        "    try:\n"
        "        with together(paths):\n"
        "            for path in paths:\n"
        "                write_text_atomically(path, sys.argv[1] * 5000, overwrite=True)\n"
        "        done += 1\n"
        "    except FileLockedError: pass\n"
    )
    paths = [folder / name for name in ("a", "b", "c")]
    orders = (paths, paths[::-1])
    processes = [
        subprocess.Popen([sys.executable, "-c", code, letter, *map(str, order)])
        for letter, order in zip("xy", orders, strict=True)
    ]
    assert [process.wait() for process in processes] == [0, 0]
    assert len({path.read_text() for path in paths}) == 1
    assert names(folder) == {"a", "b", "c"}


# --- in place ------------------------------------------------------------------------------------


def test_in_place_edits_of_three_files_come_and_go(folder: Path) -> None:
    paths = bands(folder)
    before = contents(folder)
    geodelreg.write_in_place(found_for(paths))
    assert [transform_of(path) for path in paths] == [TRANSFORM @ SHIFT] * 3
    assert names(folder) == {*BANDS, *(name + UNDO for name in BANDS)}
    geodelreg.revert(*paths)
    assert contents(folder) == before


def spoil_with_cog(path: Path) -> None:
    path.unlink()
    make_cog(path)


def spoil_with_text(path: Path) -> None:
    path.write_text("no raster")


def spoil_with_record(path: Path) -> None:
    path.with_name(path.name + UNDO).write_text("not json")


def spoil_by_cutting(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize(
    "spoil", [spoil_with_cog, spoil_with_text, spoil_with_record, spoil_by_cutting]
)
def test_one_file_that_cannot_be_edited_keeps_the_others_as_they_are(
    folder: Path, which: int, spoil: Callable[[Path], None]
) -> None:
    paths = bands(folder)
    result = found_for(paths)
    spoil(paths[which])
    before = contents(folder)
    with pytest.raises(GeodelregError, match=BANDS[which]):
        geodelreg.write_in_place(result)
    assert contents(folder) == before
    assert names(folder) == set(before)


def test_error_at_every_call_leaves_all_headers_or_none(folder: Path) -> None:
    paths = bands(folder)
    result, before, step, failed = found_for(paths), contents(folder), 0, True
    while failed:
        step += 1
        failed = run_with_error(lambda: geodelreg.write_in_place(result), step)
        moved = {transform_of(path) for path in paths}
        assert len(moved) == 1
        if moved == {TRANSFORM}:
            assert contents(folder) == before
        tidy(paths)
        assert {transform_of(path) for path in paths} == moved
        restore(folder, before)
    assert moved == {TRANSFORM @ SHIFT}
    assert step > 40


def test_kill_within_every_call_is_settled_by_the_next_run_on_any_file(folder: Path) -> None:
    paths = bands(folder)
    result, before = found_for(paths), contents(folder)
    blocks = [encoded_blocks(path) for path in paths]
    step, seen = 1, set()
    while run_killed(partial(geodelreg.write_in_place, result), step, partly=True):
        assert {transform_of(path) for path in paths} <= {TRANSFORM, TRANSFORM @ SHIFT}
        tidy([paths[step % 3]])
        moved = {transform_of(path) for path in paths}
        assert len(moved) == 1
        seen |= moved
        assert [encoded_blocks(path) for path in paths] == blocks
        tidy(paths)
        assert {transform_of(path) for path in paths} == moved
        if moved == {TRANSFORM}:
            assert contents(folder) == before
        else:
            geodelreg.revert(*paths)
            assert contents(folder) == before
        assert names(folder) == set(before)
        step += 1
    assert seen == {TRANSFORM, TRANSFORM @ SHIFT}
    assert step > 40


def test_kill_of_a_second_edit_takes_back_that_one_only(folder: Path) -> None:
    paths = bands(folder)[:2]
    (folder / BANDS[2]).unlink()
    geodelreg.write_in_place(found_for(paths))
    before = contents(folder)
    second = found_for(paths, TRANSFORM @ SHIFT @ SHIFT)
    step, seen = 1, set()
    while run_killed(partial(geodelreg.write_in_place, second), step, partly=True):
        tidy([paths[1]])
        tidy(paths)
        moved = {transform_of(path) for path in paths}
        assert len(moved) == 1
        seen |= moved
        if moved == {TRANSFORM @ SHIFT}:
            assert contents(folder) == before
        restore(folder, before)
        step += 1
    assert seen == {TRANSFORM @ SHIFT, TRANSFORM @ SHIFT @ SHIFT}


def test_a_raster_that_was_removed_after_the_kill_blocks_nobody(folder: Path) -> None:
    paths = bands(folder)
    result, before = found_for(paths), contents(folder)
    step = 1
    while run_killed(partial(geodelreg.write_in_place, result), step, partly=True):
        paths[1].unlink()
        tidy(paths)
        assert transform_of(paths[0]) == transform_of(paths[2])
        write_text_atomically(paths[1], "new", overwrite=False)
        assert not [name for name in names(folder) if name.startswith(".")]
        restore(folder, before)
        step += 5
    assert step > 40


def test_file_named_twice_is_edited_by_neither_name(folder: Path) -> None:
    path = make_tiff(folder / "B1.tif", shape=(40, 50))
    (folder / "link.tif").symlink_to(path)
    before = contents(folder)
    with pytest.raises(FileLockedError, match="twice"):
        geodelreg.write_in_place(found_for([path, folder / "link.tif"]))
    assert contents(folder) == before


def test_revert_of_several_files_decides_before_it_begins(folder: Path) -> None:
    paths = bands(folder)
    edit_in_place(paths[0], correction_of(paths[0]), GCPS, TAGS)
    before = contents(folder)
    with pytest.raises(UnsafeInPlaceError, match=r"B2\.tif has no record"):
        geodelreg.revert(*paths)
    assert contents(folder) == before


# --- a folder of outputs -------------------------------------------------------------------------


def test_copies_of_three_files_all_or_none(folder: Path) -> None:
    paths, out = bands(folder), folder / "out"
    result = found_for(paths)
    geodelreg.write(result, out)
    assert [transform_of(out / name) for name in BANDS] == [TRANSFORM @ SHIFT] * 3
    before = everything(folder)
    (out / "B1.tif").unlink()
    with pytest.raises(OutputExistsError, match=r"B2\.tif exists"):
        geodelreg.write(result, out)
    assert not (out / "B1.tif").exists()
    geodelreg.write(result, out, WriteOptions(overwrite=True))
    assert set(everything(folder)) == set(before)


def test_last_source_that_cannot_be_copied_leaves_no_output_and_no_folder(folder: Path) -> None:
    paths = bands(folder)
    result = found_for(paths)
    spoil_by_cutting(paths[2])
    before = everything(folder)
    with pytest.raises(GeodelregError, match=r"B3\.tif"):
        geodelreg.write(result, folder / "new" / "out")
    assert everything(folder) == before
    assert not (folder / "new").exists()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_error_at_every_call_leaves_all_copies_or_none(folder: Path, number: int) -> None:
    paths, out = bands(folder), folder / "out"
    result, step, failed = found_for(paths), 0, True
    options = WriteOptions(overwrite=True)
    while failed:
        step += 1
        failed = run_with_error(lambda: geodelreg.write(result, out, options), step, number)
        written = set(everything(out)) if out.exists() else set()
        if not written & set(BANDS):
            assert written == set()
        tidy(out / name for name in BANDS)
        written = set(everything(out)) if out.exists() else set()
        assert written in (set(), set(BANDS))
        for name in written:
            (out / name).unlink()
    assert step > 20


def test_kill_within_every_call_leaves_all_copies_or_none_to_the_next_run(folder: Path) -> None:
    paths, out = bands(folder), folder / "out"
    result, step, seen = found_for(paths), 1, set()
    while run_killed(partial(geodelreg.write, result, out), step, partly=True):
        tidy([out / "B2.tif"])
        left = {name for name in BANDS if (out / name).exists()}
        assert left in (set(), set(BANDS))
        for name in left:
            with rasterio.open(out / name) as dataset:
                assert dataset.transform == TRANSFORM @ SHIFT
        tidy(out / name for name in BANDS)
        if out.exists():
            assert names(out) == left
        for name in left:
            (out / name).unlink()
        seen.add(len(left))
        step += 1
    assert seen == {0, 3}


KILLED_BETWEEN = """
import os, signal, sys
from pathlib import Path

from affine import Affine
import geodelreg_cli.main
real, done = os.replace, []
def replace(*args, **kwargs):
    real(*args, **kwargs)
    if Path(args[1]).name in ("B1.tif", "B1.tif.geodelreg-undo.json"):
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = replace
geodelreg_cli.main.main()
"""


def run_cli(*args: object, cwd: Path, code: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(ROOT), str(ROOT / "cli")])
    return subprocess.run(
        [sys.executable, *code, *map(str, args)],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )


@pytest.mark.parametrize("way", [("-o", "out"), ("--in-place",)], ids=["copies", "in place"])
def test_next_command_finishes_what_a_killed_one_began(tmp_path: Path, way: tuple[str]) -> None:
    for name in BANDS:
        (tmp_path / name).write_bytes((ROOT / "sample_tiles" / "ms.tif").read_bytes())
    (tmp_path / "pan.tif").write_bytes((ROOT / "sample_tiles" / "pan.tif").read_bytes())
    (tmp_path / "out").mkdir()
    args = ("align", *BANDS, "pan.tif", "-j", "1", *way)
    killed = run_cli(*args, cwd=tmp_path, code=("-c", KILLED_BETWEEN))
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    place = tmp_path / "out" if "-o" in way else tmp_path
    again = run_cli(*args, cwd=tmp_path, code=("-m", "geodelreg_cli"))
    assert "finishing a write that was interrupted (B1.tif, B2.tif, B3.tif)" in again.stderr
    if "-o" in way:
        assert again.returncode == 1
        assert "exists" in again.stderr
    else:
        assert again.returncode == 0, again.stderr
    assert len({transform_of(place / name) for name in BANDS}) == 1
    assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".geodelreg")]


def test_inputs_of_an_alignment_are_no_outputs(folder: Path) -> None:
    paths = bands(folder)
    result = found_for(paths[:1])
    result = replace(result, reference=replace(result.reference, paths=(str(paths[1]),)))
    before = contents(folder)
    options = WriteOptions(overwrite=True)
    with pytest.raises(OutputIsInputError, match=r"B2\.tif"):
        geodelreg.write(result, paths[1], options)
    with pytest.raises(OutputIsInputError, match=r"B2\.tif"):
        geodelreg.export_gcps(result, paths[1], "geojson", overwrite=True)
    with pytest.raises(OutputIsInputError, match=r"part of an input"):
        geodelreg.export_gcps(result, folder / "B2.tif.aux.xml", "vrt")
    with pytest.raises(UsageError, match="standard output"):
        geodelreg.write(result, "-", options)
    assert contents(folder) == before
