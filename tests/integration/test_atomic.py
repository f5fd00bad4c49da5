"""Outputs appear whole or not at all, whatever happens."""

from __future__ import annotations

import errno
import fcntl
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from geodelreg.errors import (
    FileLockedError,
    OutputExistsError,
    OutputIsInputError,
    OutputUnwritableError,
)
from geodelreg.geotiff.atomic import staged, write_text_atomically
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.geotiff.targets import check_not_input
from geodelreg.options import WriteOptions
from tests.integration.faults import (
    contents,
    names,
    restore,
    run_as_ordinary_user,
    run_killed,
    run_with_error,
)
from tests.integration.raster_samples import (
    GCPS,
    SHIFT,
    TAGS,
    TRANSFORM,
    correction_of,
    make_tiff,
    transform_of,
)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """Folder that other users may read, which pytest's own are not."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


def write_three(folder: Path) -> None:
    """Replace out.tif and one side file, add another, drop a stale one."""
    stale = [folder / "out.tif.aux.xml", folder / "out.tif.ovr"]
    with staged(folder / "out.tif", overwrite=True, stale=stale) as work:
        work.write_bytes(b"new raster")
        work.with_name("out.tif.msk").write_bytes(b"new mask")
        work.with_name("out.tif.ovr").write_bytes(b"new overviews")


OLD = {
    "out.tif": b"old raster",
    "out.tif.aux.xml": b"old statistics",
    "out.tif.ovr": b"old overviews",
    "other.tif": b"not ours",
}
NEW = {
    "out.tif": b"new raster",
    "out.tif.msk": b"new mask",
    "out.tif.ovr": b"new overviews",
    "other.tif": b"not ours",
}


def test_text_appears(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_text_atomically(path, "é\n", overwrite=False)
    assert path.read_bytes() == "é\n".encode()
    with pytest.raises(OutputExistsError, match=r"report\.json exists.*`overwrite=True`"):
        write_text_atomically(path, "new", overwrite=False)
    write_text_atomically(path, "new", overwrite=True)
    assert contents(tmp_path) == {"report.json": b"new"}
    assert names(tmp_path) == {"report.json"}


def test_all_files_go_into_place_together(tmp_path: Path) -> None:
    restore(tmp_path, OLD)
    write_three(tmp_path)
    assert contents(tmp_path) == NEW
    assert names(tmp_path) == set(NEW)


@pytest.mark.parametrize("failure", [KeyboardInterrupt, ValueError, SystemExit])
def test_exception_in_the_body_changes_nothing(
    tmp_path: Path, failure: type[BaseException]
) -> None:
    restore(tmp_path, OLD)

    def interrupted() -> None:
        with staged(tmp_path / "out.tif", overwrite=True) as work:
            work.write_bytes(b"half")
            work.with_name("out.tif.msk").write_bytes(b"half")
            raise failure

    with pytest.raises(failure):
        interrupted()
    assert contents(tmp_path) == OLD
    assert names(tmp_path) == set(OLD)


def test_existing_files_are_kept_without_overwrite(tmp_path: Path) -> None:
    restore(tmp_path, {"out.tif.aux.xml": b"left over"})
    stale = [tmp_path / "out.tif.aux.xml"]
    with (
        pytest.raises(OutputExistsError, match=r"aux\.xml exists.*`overwrite=True`"),
        staged(tmp_path / "out.tif", overwrite=False, stale=stale),
    ):
        pytest.fail("the body must not run")
    restore(tmp_path, {"out.hdr": b"somebody's"})

    def write_two() -> None:
        with staged(tmp_path / "out.bin", overwrite=False) as work:
            work.write_bytes(b"raster")
            work.with_name("out.hdr").write_bytes(b"header")

    with pytest.raises(OutputExistsError, match=r"out\.hdr"):
        write_two()
    assert contents(tmp_path) == {"out.hdr": b"somebody's"}


def test_permissions_of_a_replaced_file_stay(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("old")
    path.chmod(0o640)
    write_text_atomically(path, "new", overwrite=True)
    assert path.stat().st_mode & 0o777 == 0o640


def test_link_as_target_is_followed(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    link = tmp_path / "out.txt"
    link.symlink_to(folder / "real.txt")
    write_text_atomically(link, "text", overwrite=False)
    assert link.is_symlink()
    assert contents(folder) == {"real.txt": b"text"}


def test_very_long_names_work(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 250 + ".json")
    write_text_atomically(path, "text", overwrite=False)
    assert names(tmp_path) == {path.name}


@pytest.mark.parametrize("link", ["same", "symbolic", "hard", "dotted"])
def test_input_is_never_the_output(tmp_path: Path, link: str) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    target = tmp_path / "out.tif"
    if link == "same":
        target = source
    elif link == "symbolic":
        target.symlink_to(source)
    elif link == "hard":
        target.hardlink_to(source)
    else:
        (tmp_path / "sub").mkdir()
        target = tmp_path / "sub" / ".." / "ms.tif"
    before = source.read_bytes()
    with pytest.raises(OutputIsInputError, match="`write_in_place`"):
        write_corrected(
            source, target, correction_of(source), GCPS, TAGS, WriteOptions(overwrite=True)
        )
    assert source.read_bytes() == before
    check_not_input(tmp_path / "new.tif", [source])


def test_missing_folder_and_folder_as_target(tmp_path: Path) -> None:
    with pytest.raises(OutputUnwritableError, match=r"out\.txt.*folder does not exist.*Create"):
        write_text_atomically(tmp_path / "no" / "out.txt", "text", overwrite=True)
    with pytest.raises(OutputUnwritableError, match=r"folder.*Name a file"):
        write_text_atomically(tmp_path, "text", overwrite=True)
    assert names(tmp_path) == set()


def test_read_only_places_are_refused(open_folder: Path) -> None:
    path = open_folder / "out.txt"
    path.write_text("old")
    path.chmod(0o444)

    def attempt() -> None:
        with pytest.raises(OutputUnwritableError, match=r"out\.txt cannot be written"):
            write_text_atomically(path, "new", overwrite=True)

    open_folder.chmod(0o777)
    assert run_as_ordinary_user(attempt)
    path.chmod(0o666)
    open_folder.chmod(0o555)
    assert run_as_ordinary_user(attempt)
    assert contents(open_folder) == {"out.txt": b"old"}


def test_second_writer_of_one_target_is_refused(tmp_path: Path) -> None:
    with staged(tmp_path / "out.txt", overwrite=True) as work:
        with pytest.raises(FileLockedError, match=r"out\.txt is being written"):
            write_text_atomically(tmp_path / "out.txt", "second", overwrite=True)
        write_text_atomically(tmp_path / "other.txt", "elsewhere", overwrite=True)
        work.write_text("first")
    assert contents(tmp_path) == {"out.txt": b"first", "other.txt": b"elsewhere"}


def test_leavings_of_a_living_process_are_not_touched(tmp_path: Path) -> None:
    folder = tmp_path / ".out.txt.geodelreg"
    (folder / "files").mkdir(parents=True)
    (folder / "files" / "out.txt").write_text("in the making")
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(FileLockedError):
            write_text_atomically(tmp_path / "out.txt", "second", overwrite=True)
        assert (folder / "files" / "out.txt").read_text() == "in the making"
    write_text_atomically(tmp_path / "out.txt", "after its death", overwrite=True)
    assert contents(tmp_path) == {"out.txt": b"after its death"}
    assert names(tmp_path) == {"out.txt"}


def test_many_processes_write_one_target(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "from geodelreg.errors import FileLockedError\n"
        "from geodelreg.geotiff.atomic import write_text_atomically\n"
        "for n in range(150):\n"
        "    try: write_text_atomically(Path(sys.argv[1]), sys.argv[2] * 5000, overwrite=True)\n"
        "    except FileLockedError: pass\n"
    )
    path = tmp_path / "out.txt"
    processes = [
        subprocess.Popen([sys.executable, "-c", code, str(path), letter]) for letter in "abc"
    ]
    while any(process.poll() is None for process in processes):
        if path.exists():
            assert path.read_text() in {letter * 5000 for letter in "abc"}
    assert [process.wait() for process in processes] == [0, 0, 0]
    assert names(tmp_path) == {"out.txt"}


def test_a_private_folder_that_vanishes_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its owner may remove it between the refusal to create it and a look at it."""
    real, calls = os.mkdir, []

    def mkdir(path: Path, mode: int = 0o777) -> None:
        calls.append(path)
        if len(calls) == 1:
            raise FileExistsError(errno.EEXIST, "File exists", str(path))
        real(path, mode)

    monkeypatch.setattr(os, "mkdir", mkdir)
    write_text_atomically(tmp_path / "out.txt", "text", overwrite=False)
    assert (tmp_path / "out.txt").read_text() == "text"
    assert names(tmp_path) == {"out.txt"}


def test_a_file_in_the_place_of_the_private_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / ".out.txt.geodelreg").write_text("mine")
    with pytest.raises(OutputUnwritableError):
        write_text_atomically(tmp_path / "out.txt", "text", overwrite=False)
    assert (tmp_path / ".out.txt.geodelreg").read_text() == "mine"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_error_at_every_call_leaves_old_or_new(tmp_path: Path, number: int) -> None:
    step, failed = 0, True
    while failed:
        restore(tmp_path, OLD)
        step += 1
        failed = run_with_error(lambda: write_three(tmp_path), step, number)
        assert contents(tmp_path) in (OLD, NEW)
        write_three(tmp_path)
        assert names(tmp_path) == set(NEW)
    assert step > 15


@pytest.mark.parametrize("partly", [False, True], ids=["before", "within"])
def test_kill_at_every_call_is_finished_or_undone_by_the_next_run(
    tmp_path: Path, partly: bool
) -> None:
    step = 1
    restore(tmp_path, OLD)
    while run_killed(partial(write_three, tmp_path), step, partly):
        left = contents(tmp_path)
        assert left["out.tif"] in (OLD["out.tif"], NEW["out.tif"])
        if left["out.tif"] == NEW["out.tif"]:
            assert left == NEW  # the target comes last
        with (  # the next run finds the leavings before it meets its own failure
            pytest.raises(ZeroDivisionError),
            staged(tmp_path / "out.tif", overwrite=True),
        ):
            raise ZeroDivisionError
        assert contents(tmp_path) in (OLD, NEW)
        assert names(tmp_path) == set(contents(tmp_path))
        restore(tmp_path, OLD)
        step += 1
    assert contents(tmp_path) == NEW
    assert step > 15


def test_kill_at_every_call_of_a_raster_copy(tmp_path: Path) -> None:
    source, out = make_tiff(tmp_path / "ms.tif"), tmp_path / "out.tif"
    correction = correction_of(source)

    work = partial(
        write_corrected, source, out, correction, GCPS, TAGS, WriteOptions(overwrite=True)
    )
    step = 1
    while run_killed(work, step, partly=True):
        if out.exists():
            assert transform_of(out) == TRANSFORM @ SHIFT
        step += 1
    assert step > 8
    assert names(tmp_path) == {"ms.tif", "out.tif"}


DISK_LIMIT = """
import resource, signal, sys
from pathlib import Path
from geodelreg.errors import OutputUnwritableError
from geodelreg.options import WriteOptions
from geodelreg.geotiff.corrected import write_corrected
from tests.integration.raster_samples import GCPS, TAGS, correction_of
source, target, limit = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
correction = correction_of(source)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
for creation in ((), ("COMPRESS=NONE",)):
    try:
        options = WriteOptions(creation_options=creation)
        write_corrected(source, target, correction, GCPS, TAGS, options)
    except OutputUnwritableError as error:
        print(error)
"""


def test_disk_limit_leaves_nothing(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", "striped")
    limit = str(source.stat().st_size // 2)
    # not in a fork: GDAL's threads would be missing there
    run = subprocess.run(
        [sys.executable, "-c", DISK_LIMIT, str(source), str(tmp_path / "out.tif"), limit],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    assert run.stdout.count("out.tif cannot be written") == 2
    assert names(tmp_path) == {"ms.tif"}


LOOP = """
import sys
from pathlib import Path
from geodelreg.options import WriteOptions
from geodelreg.geotiff.corrected import write_corrected
from tests.integration.raster_samples import GCPS, TAGS, correction_of
source, target = map(Path, sys.argv[1:])
print("ready", flush=True)
while True:
    options = WriteOptions(overwrite=True)
    write_corrected(source, target, correction_of(source), GCPS, TAGS, options)
"""


def test_kill_9_at_random_times(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", mask="external", overviews="external")
    out, delays = tmp_path / "out.tif", random.Random(3)
    for _ in range(4):
        with subprocess.Popen(
            [sys.executable, "-c", LOOP, str(source), str(out)],
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[2],
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            time.sleep(delays.uniform(0.05, 0.3))
            process.send_signal(signal.SIGKILL)
        if out.exists():
            assert transform_of(out) == TRANSFORM @ SHIFT
    write_corrected(source, out, correction_of(source), GCPS, TAGS, WriteOptions(overwrite=True))
    suffixes = ("", ".msk", ".ovr", ".msk.ovr")
    assert names(tmp_path) == {
        name + suffix for name in ("ms.tif", "out.tif") for suffix in suffixes
    }
