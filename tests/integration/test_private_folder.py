"""A private folder that someone else made is refused, and nothing in it or beside it is touched."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from geodelreg.errors import OutputUnwritableError
from geodelreg.geotiff.atomic import staged, write_text_atomically
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.geotiff.inplace import edit_in_place
from geodelreg.options import WriteOptions
from tests.integration.faults import contents, names, run_killed
from tests.integration.raster_samples import GCPS, TAGS, correction_of, make_tiff
from tests.integration.special_files import bound_socket

ROOT = Path(__file__).parents[2]
PRIVATE = ".ms.tif.geodelreg"
Plant = Callable[[Path], None]


def everything(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """Mode, number of links and content of all below a folder, also of links and devices."""
    found = {}
    for path in sorted(folder.rglob("*")):
        status = path.lstat()
        data = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        if path.is_symlink():
            data = os.fsencode(path.readlink())
        found[path.relative_to(folder).as_posix()] = (status.st_mode, status.st_nlink, data)
    return found


def siblings_in_ready(private: Path) -> None:
    """As an earlier version understood it: the files beside the target that have to go."""
    (private / "files").mkdir()
    (private / "files" / "ms.tif").write_bytes(b"foreign raster")
    (private / "ready").write_text(json.dumps(["thesis.doc", "photos"]))


def siblings_in_plan(private: Path) -> None:
    siblings_in_ready(private)
    (private / "ready").unlink()
    (private / "commit").touch()
    plan = {"run": "x", "inode": private.stat().st_ino, "group": ["ms.tif"], "edits": 0}
    plan |= {"files": {"ms.tif": True}, "removed": ["thesis.doc", "photos"]}
    (private / "plan").write_text(json.dumps(plan))


def plan_from_elsewhere(private: Path) -> None:
    """Sound in itself, but of a folder that was copied or unpacked here."""
    siblings_in_plan(private)
    plan = json.loads((private / "plan").read_text())
    plan |= {"inode": 1, "removed": []}
    (private / "plan").write_text(json.dumps(plan))


def plan_that_is(text: str) -> Plant:
    def plant(private: Path) -> None:
        (private / "plan").write_text(text)

    return plant


def entry(name: str, make: Callable[[Path], object]) -> Plant:
    def plant(private: Path) -> None:
        (private / name).parent.mkdir(exist_ok=True)
        make(private / name)

    return plant


def link_to_victim(path: Path) -> None:
    path.symlink_to(path.parents[1] / "victim")


def hard_link_to_victim(path: Path) -> None:
    os.link(path.parents[1] / "victim", path)


def hard_link_from_inside(path: Path) -> None:
    os.link(path.parents[2] / "victim", path)


def device(path: Path) -> None:
    os.mknod(path, 0o600 | 0o020000, os.makedev(1, 3))


PLANTED: dict[str, Plant] = {
    "siblings in ready": siblings_in_ready,
    "siblings in plan": siblings_in_plan,
    "plan from elsewhere": plan_from_elsewhere,
    "plan is no JSON": plan_that_is("{"),
    "plan is a number": plan_that_is("7"),
    "plan of nothing": plan_that_is("{}"),
    "plan of nested lists": plan_that_is("[" * 100_000),
    "plan is not text": entry("plan", lambda path: path.write_bytes(b"\xff\xfe\x00")),
    "ready is no JSON": entry("ready", lambda path: path.write_text("{")),
    "foreign name": entry("files/thesis.doc", lambda path: path.write_text("mine")),
    "foreign folder": entry("photos/1.jpg", lambda path: path.write_text("mine")),
    "folder of files": entry("files/ms.tif.d", Path.mkdir),
    "lock is a link": entry("lock", link_to_victim),
    "lock is a dangling link": entry("lock", lambda path: path.symlink_to("../new")),
    "lock is a hard link": entry("lock", hard_link_to_victim),
    "lock is a pipe": entry("lock", os.mkfifo),
    "lock is a socket": entry("lock", bound_socket),
    "lock is a folder": entry("lock", Path.mkdir),
    "files is a link": entry("files", lambda path: path.symlink_to("../photos")),
    "file is a pipe": entry("files/ms.tif", os.mkfifo),
    "file is a hard link": entry("files/ms.tif", hard_link_from_inside),
    "file is a link": entry("files/ms.tif", lambda path: path.symlink_to("../../victim")),
    "plan is a link": entry("plan", link_to_victim),
    "commit is a pipe": entry("commit", os.mkfifo),
}
if hasattr(os, "geteuid") and os.geteuid() == 0:
    PLANTED |= {
        "lock is a device": entry("lock", device),
        "file is a device": entry("files/ms.tif", device),
    }


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Folder with a raster and other things that are nobody's business."""
    make_tiff(tmp_path / "ms.tif")
    (tmp_path / "thesis.doc").write_text("years of work")
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "victim").chmod(0o600)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "1.jpg").write_text("the children")
    return tmp_path


def writers(folder: Path) -> list[Callable[[], object]]:
    raster = folder / "ms.tif"
    return [
        lambda: write_text_atomically(raster, "text", overwrite=True),
        lambda: edit_in_place(raster, correction_of(raster), GCPS, TAGS),
    ]


@pytest.mark.parametrize("lock", [False, True], ids=["without lock", "with lock"])
@pytest.mark.parametrize("kind", PLANTED)
def test_planted_folder_is_refused_and_nothing_is_touched(
    home: Path, kind: str, lock: bool
) -> None:
    (home / PRIVATE).mkdir()
    PLANTED[kind](home / PRIVATE)
    if lock and not os.path.lexists(home / PRIVATE / "lock"):
        (home / PRIVATE / "lock").touch()
    before = everything(home)
    for work in writers(home):
        with pytest.raises(OutputUnwritableError, match=r"geodelreg.*[Rr]emove the folder"):
            work()
    assert everything(home) == before
    shutil.rmtree(home / PRIVATE)  # as the message says
    for work in reversed(writers(home)):
        work()
    assert (home / "ms.tif").read_text() == "text"
    assert (home / "thesis.doc").read_text() == "years of work"


def test_link_in_place_of_the_folder_is_refused(home: Path) -> None:
    (home / PRIVATE).symlink_to("photos")
    before = everything(home)
    for work in writers(home):
        with pytest.raises(OutputUnwritableError, match="is no folder"):
            work()
    assert everything(home) == before


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs another user")
def test_folder_of_another_user_is_refused_even_by_root(home: Path) -> None:
    """In a folder where all may write, such as /tmp, anybody can make it."""
    home.chmod(0o1777)
    (home / PRIVATE).mkdir()
    os.chown(home / PRIVATE, 65534, 65534)
    before = everything(home)
    for work in writers(home):
        with pytest.raises(OutputUnwritableError, match=r"belongs to another user \(65534\)"):
            work()
    assert everything(home) == before


KILLED = """
import os, signal, sys
from pathlib import Path
from geodelreg.geotiff.atomic import staged
real = os.replace
def replace(*args, **kwargs):
    real(*args, **kwargs)
    if Path(args[1]).name == "ms.tif.msk":
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = replace
with staged(Path(sys.argv[1]), overwrite=True) as work:
    work.write_bytes(b"new raster")
    work.with_name("ms.tif.msk").write_bytes(b"new mask")
"""


def killed_between_two_files(folder: Path) -> None:
    code = [sys.executable, "-c", KILLED, str(folder / "ms.tif")]
    assert subprocess.run(code, cwd=ROOT).returncode == -signal.SIGKILL
    assert (folder / "ms.tif.msk").read_bytes() == b"new mask"
    assert (folder / PRIVATE / "plan").exists()


def test_copy_of_what_a_killed_run_left_is_refused(home: Path, tmp_path: Path) -> None:
    """As in a backup or an archive; where the run was killed, the next one finishes."""
    killed_between_two_files(home)
    copied = tmp_path / "copied"
    copied.mkdir()
    for name in ("ms.tif", PRIVATE):
        source = home / name
        (shutil.copytree if source.is_dir() else shutil.copy2)(source, copied / name)
    before = everything(copied)
    with pytest.raises(OutputUnwritableError, match="comes from another folder"):
        write_text_atomically(copied / "ms.tif", "text", overwrite=True)
    assert everything(copied) == before
    with (
        pytest.raises(ZeroDivisionError),
        staged(home / "ms.tif", overwrite=True),
    ):
        raise ZeroDivisionError
    assert (home / "ms.tif").read_bytes() == b"new raster"
    assert not (home / PRIVATE).exists()


def test_private_folder_is_closed_to_others_and_what_it_holds_keeps_its_mode(home: Path) -> None:
    raster = home / "ms.tif"
    raster.chmod(0o600)
    with staged(raster, overwrite=True) as work:
        assert (home / PRIVATE).stat().st_mode & 0o777 == 0o700
        work.write_bytes(b"new")
        work.with_name("ms.tif.msk").write_bytes(b"new mask")
    assert raster.stat().st_mode & 0o777 == 0o600
    assert (home / "ms.tif.msk").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_undo_record_and_side_files_have_the_mode_of_the_raster(home: Path, mode: int) -> None:
    raster = home / "ms.tif"
    (home / "ms.tif.aux.xml").write_text(
        "<PAMDataset><SRS>EPSG:32617</SRS><GeoTransform>7,3,0,8,0,-3</GeoTransform>"
        '<Metadata><MDI key="NOTE">kept</MDI></Metadata></PAMDataset>'
    )
    (home / "ms.tif.aux.xml").chmod(0o660)
    raster.chmod(mode)
    for _ in range(2):
        edit_in_place(raster, correction_of(raster), GCPS, TAGS)
        record = home / "ms.tif.geodelreg-undo.json"
        assert record.stat().st_mode & 0o777 == mode
        assert raster.stat().st_mode & 0o777 == mode
        assert (home / "ms.tif.aux.xml").stat().st_mode & 0o777 == 0o660


@pytest.fixture
def disk_folder() -> Iterator[Path]:
    """Folder on a file system that has extended attributes, unlike some for temporary files."""
    for parent in (None, "/var/tmp", str(Path.home())):
        with tempfile.TemporaryDirectory(dir=parent) as name:
            try:
                os.setxattr(name, "user.probe", b"1")
            except OSError:
                continue
            yield Path(name)
            return
    pytest.fail("no file system with extended attributes")


def test_extended_attributes_and_acl_survive(disk_folder: Path) -> None:
    source = make_tiff(disk_folder / "ms.tif")
    out = disk_folder / "out.tif"
    out.write_bytes(b"old")
    os.setxattr(out, "user.licence", b"CC0")
    acl = bytes.fromhex(  # user::rw-, user:1234:r--, group::r--, mask::r--, other::---
        "0200000001000600ffffffff02000400d204000004000400ffffffff"
        "10000400ffffffff20000000ffffffff"
    )  # fmt: skip
    os.setxattr(out, "system.posix_acl_access", acl)
    write_corrected(source, out, correction_of(source), GCPS, TAGS, WriteOptions(overwrite=True))
    assert out.read_bytes() != b"old"
    assert os.getxattr(out, "user.licence") == b"CC0"
    assert os.getxattr(out, "system.posix_acl_access") == acl
    assert out.stat().st_mode & 0o777 == 0o640


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives away")
def test_owner_survives(home: Path) -> None:
    out = home / "out.txt"
    out.write_text("old")
    os.chown(out, 1234, 2345)
    write_text_atomically(out, "new", overwrite=True)
    assert (out.stat().st_uid, out.stat().st_gid) == (1234, 2345)


AS_NOBODY = """
import os, sys
from pathlib import Path
from geodelreg_cli.console import configure_logging
from geodelreg.geotiff.atomic import write_text_atomically
os.setgid(65534)
os.setuid(65534)
configure_logging(0, False, False)
write_text_atomically(Path(sys.argv[1]), "new", overwrite=True)
"""


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs two users")
def test_owner_that_cannot_be_kept_is_named_and_no_group_gains_by_it() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)
        out = folder / "out.txt"
        out.write_text("old")
        out.chmod(0o662)
        os.chown(out, 1234, 2345)
        code = [sys.executable, "-c", AS_NOBODY, str(out)]
        path = os.pathsep.join([str(ROOT), str(ROOT / "cli")])
        run = subprocess.run(
            code, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}
        )
        assert out.read_text() == "new", run.stderr
        assert "out.txt: lost, for want of permission: owner 1234, group 2345" in run.stderr
        assert (out.stat().st_uid, out.stat().st_mode & 0o777) == (65534, 0o622)


def write_with_side_files(folder: Path) -> None:
    with staged(folder / "x.bil", overwrite=True) as work:
        work.write_bytes(b"new")
        work.with_name("x.hdr").write_bytes(b"new header")
        work.with_name("x.bil.aux.xml").write_bytes(b"new statistics")


def test_kill_leaves_no_folder_that_a_later_run_refuses(tmp_path: Path) -> None:
    step = 1
    while run_killed(partial(write_with_side_files, tmp_path), step, partly=True):
        write_with_side_files(tmp_path)
        assert set(contents(tmp_path).values()) == {b"new", b"new header", b"new statistics"}
        assert names(tmp_path) == {"x.bil", "x.hdr", "x.bil.aux.xml"}
        step += 1
    assert step > 15
