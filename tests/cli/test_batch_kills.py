"""Drivers and children that are killed: every pair has one final outcome, nothing is left over."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.batch.pairs import write_pairs
from tests.cli.batch_helpers import (
    children_for_pairs,
    debris,
    descendants,
    kill,
    query,
    read_table,
    start,
    wait_until,
)
from tests.cli.helpers import COMMAND, Command

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
COUNT = 6


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_pairs(tmp_path / "data", COUNT)
    return tmp_path / "data"


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Outputs of a run that nobody disturbs."""
    folder = tmp_path_factory.mktemp("calm")
    manifest = write_pairs(folder, COUNT)
    assert start("batch", manifest, "-q", cwd=folder).wait(120) == 0
    return {path.name: path.read_bytes() for path in (folder / "out").iterdir()}


def check_finished(folder: Path, expected: dict[str, bytes]) -> list[dict[str, str]]:
    """All pairs have one outcome, the outputs of a calm run are there, and nothing else."""
    numbers = [row[0] for row in query(folder / "pairs.ledger", "SELECT number FROM outcomes")]
    assert Counter(numbers) == Counter(range(1, COUNT + 1))
    written = {path.name: path.read_bytes() for path in (folder / "out").iterdir()}
    assert written == expected
    assert debris(folder) == []
    rows = read_table(folder / "pairs.results.csv")
    assert [row["outcome"] for row in rows] == ["aligned"] * COUNT
    return rows


def finished(folder: Path) -> int:
    ledger = folder / "pairs.ledger"
    return query(ledger, "SELECT count(*) FROM outcomes")[0][0] if ledger.exists() else 0


@pytest.mark.parametrize("done", [0, 1, 3])
def test_a_driver_killed_in_mid_work_loses_and_repeats_nothing(
    folder: Path, geodelreg: Command, expected: dict[str, bytes], done: int
) -> None:
    driver = start("batch", "pairs.csv", "-j", "2", cwd=folder)
    wait_until(lambda: finished(folder) >= done and len(children_for_pairs(driver.pid)) == 2)
    time.sleep(0.2 * (done % 2))
    children = children_for_pairs(driver.pid)
    driver.kill()
    driver.communicate()
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children))
    before = query(folder / "pairs.ledger", "SELECT * FROM outcomes ORDER BY number")
    assert len(before) < COUNT

    again = geodelreg("batch", "pairs.csv", "--resume", "-q", cwd=folder)
    assert again.returncode == 0, again.stderr
    check_finished(folder, expected)
    numbers = ", ".join(str(row[0]) for row in before)
    same = f"SELECT * FROM outcomes WHERE number IN ({numbers}) ORDER BY number"
    assert query(folder / "pairs.ledger", same) == before


def test_a_pair_whose_child_is_killed_runs_in_another(
    folder: Path, expected: dict[str, bytes]
) -> None:
    driver = start("batch", "pairs.csv", "-j", "1", cwd=folder)
    wait_until(lambda: finished(folder) >= 1)
    (child,) = children_for_pairs(driver.pid)
    kill(child)
    assert driver.wait(120) == 0, driver.communicate()
    rows = check_finished(folder, expected)
    assert sorted(row["attempts"] for row in rows) == ["1"] * (COUNT - 1) + ["2"]


def test_a_pair_that_always_dies_has_failed_and_the_others_go_on(
    folder: Path, geodelreg: Command, expected: dict[str, bytes]
) -> None:
    driver = start("batch", "pairs.csv", "-j", "1", cwd=folder)
    killed: set[int] = set()
    while finished(folder) < 1:
        for child in children_for_pairs(driver.pid):
            if is_at_work(child) and child not in killed:
                kill(child)
                killed.add(child)
        time.sleep(0.002)
        assert driver.poll() is None
    assert driver.wait(120) == 1
    assert len(killed) == 3
    rows = read_table(folder / "pairs.results.csv")
    assert [row["outcome"] for row in rows] == ["failed"] + ["aligned"] * (COUNT - 1)
    assert rows[0]["error"] == "PairCrashedError"
    assert "SIGKILL" in rows[0]["reason"]
    assert rows[0]["attempts"] == "3"
    assert debris(folder) == []
    again = geodelreg("batch", "pairs.csv", "--retry", "failed", "-q", cwd=folder)
    assert again.returncode == 0, again.stderr
    written = {path.name: path.read_bytes() for path in (folder / "out").iterdir()}
    assert written == expected


def is_at_work(child: int) -> bool:
    """Whether a child holds the raster of the first pair open, or has loaded OpenCV and GDAL."""
    try:
        maps = Path(f"/proc/{child}/maps").read_text()
        threads = len(list(Path(f"/proc/{child}/task").iterdir()))
    except OSError:
        return False
    return "rasterio" in maps and "cv2" in maps and threads >= 2


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["int", "term"]
)
def test_an_interrupted_batch_leaves_no_process_and_no_debris(
    folder: Path, geodelreg: Command, expected: dict[str, bytes], number: signal.Signals, code: int
) -> None:
    driver = start("batch", "pairs.csv", "-j", "2", cwd=folder)
    wait_until(lambda: len(children_for_pairs(driver.pid)) == 2)
    below = descendants(driver.pid)
    wait_until(lambda: finished(folder) >= 1)
    os.kill(driver.pid, number)  # at once: the others are soon done, too
    _, stderr = driver.communicate(timeout=60)
    assert driver.returncode == code
    assert stderr.splitlines()[-1] == f"geodelreg: {'interrupted' if code == 130 else 'terminated'}"
    assert not any(Path(f"/proc/{pid}").exists() for pid in below)
    assert debris(folder) == []
    assert geodelreg("batch", "pairs.csv", "--resume", "-q", cwd=folder).returncode == 0
    check_finished(folder, expected)


def test_a_child_has_one_thread_for_each_library(folder: Path) -> None:
    driver = start("batch", "pairs.csv", "-j", "1", cwd=folder)
    wait_until(lambda: finished(folder) >= 1)
    (child,) = children_for_pairs(driver.pid)
    given = Path(f"/proc/{child}/environ").read_text().split("\0")
    libraries = ("OMP", "OPENBLAS", "MKL", "GDAL")
    assert {f"{name}_NUM_THREADS=1" for name in libraries} <= set(given)
    assert "OPENCV_FOR_THREADS_NUM=1" in given
    most, before = 0, set[str]()
    while driver.poll() is None:
        try:
            tasks = {task.name for task in Path(f"/proc/{child}/task").iterdir()}
        except OSError:
            break
        # a thread that Python has joined already may still be on its way out: it is gone next time
        most, before = max(most, len(tasks & before)), tasks
        time.sleep(0.01)
    assert driver.wait(120) == 0
    assert 1 < most <= 4  # its own, that which reads tasks, and pools of one


def test_a_terminal_shows_how_far_it_is(folder: Path) -> None:
    master, slave = pty.openpty()
    (folder / "pan_1.tif").unlink()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "120", "LINES": "40"}
    driver = subprocess.Popen(
        [*COMMAND, "batch", "pairs.csv"], cwd=folder, stderr=slave, env=environment
    )
    os.close(slave)
    shown = b""
    while True:
        try:
            part = os.read(master, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        shown += part
    os.close(master)
    assert driver.wait(120) == 1
    text = shown.decode()
    for words in ("pairs/min", "time left", "aligned", "failed", "pan_1.tif does not exist"):
        assert words in text
    assert f"{COUNT} pairs: " in text.splitlines()[-3] + text.splitlines()[-4]


def test_a_ledger_has_one_driver_at_a_time(folder: Path, geodelreg: Command) -> None:
    driver = start("batch", "pairs.csv", "-j", "1", cwd=folder)
    wait_until(lambda: finished(folder) >= 1)
    second = geodelreg("batch", "pairs.csv", "--resume", cwd=folder)
    assert second.returncode == 1
    assert "pairs.ledger is being written by another process" in second.stderr
    assert driver.wait(120) == 0
