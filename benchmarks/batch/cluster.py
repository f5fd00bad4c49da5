"""A cluster of Dask as separate processes, and what a batch leaves behind."""

from __future__ import annotations

import csv
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from benchmarks.processes import own_environment

TIMINGS = {"duration_s", "attempts", "host"}


class Cluster:
    """A scheduler and its workers; each can be killed and started again."""

    def __init__(self, folder: Path, workers: int = 2) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = probe.getsockname()[1]
        self._folder, self._count = folder, workers
        self.address = f"tcp://127.0.0.1:{self._port}"
        self.start()

    def start(self) -> None:
        """Start all of it."""
        where = ["--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard"]
        self.scheduler = self._dask("scheduler", *where)
        self.start_workers()

    def start_workers(self) -> None:
        """Start the workers and the nannies that replace them."""
        how = ["--nworkers", str(self._count), "--nthreads", "1", "--memory-limit", "0"]
        how += ["--no-dashboard", "--local-directory", str(self._folder / "dask")]
        self.workers = self._dask("worker", self.address, *how)

    def _dask(self, *args: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *args], env=own_environment(), start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def mend(self) -> None:
        """Start the workers again when they have given up: one was killed while it started."""
        if self.workers.poll() is not None:
            self.start_workers()

    def end(self) -> None:
        """Kill what is left of it."""
        for process in (self.workers, self.scheduler):
            for pid in [*below(process.pid), process.pid]:
                kill(pid)
            process.wait()


@contextmanager
def running_cluster(folder: Path) -> Iterator[Cluster]:
    """A cluster while the block runs."""
    cluster = Cluster(folder)
    try:
        yield cluster
    finally:
        cluster.end()


def kill(pid: int) -> None:
    """SIGKILL."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def below(pid: int, word: str = "") -> list[int]:
    """Processes below one, of those with a word in their command line."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
                parents.setdefault(int(parent), []).append(int(entry.name))
    found, todo = [], [pid]
    while todo:
        children = parents.get(todo.pop(), [])
        todo += children
        found += children
    return [one for one in found if not word or word in _command(one)]


def _command(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    return ""


def batch(folder: Path, *args: str) -> tuple[float, int]:
    """Seconds and exit code of ``geodelreg batch`` on the manifest of a folder."""
    start = time.perf_counter()
    code = driver(folder, *args).wait()
    return time.perf_counter() - start, code


def driver(folder: Path, *args: str) -> subprocess.Popen[bytes]:
    """``geodelreg batch`` in the background."""
    return subprocess.Popen(
        [sys.executable, "-m", "geodelreg_cli", "batch", str(folder / "pairs.csv"), "-q", *args],
        env=own_environment(), stderr=subprocess.DEVNULL,
    )  # fmt: skip


def forget(folder: Path) -> None:
    """Remove what a batch has written into a folder of pairs."""
    for path in [*folder.glob("pairs.ledger*"), *folder.glob("*.results.csv")]:
        path.unlink()
    for path in folder.glob("out/*"):
        path.unlink()


def outputs(folder: Path) -> dict[str, bytes]:
    """All outputs by name."""
    return {path.name: path.read_bytes() for path in (folder / "out").iterdir()}


def table(folder: Path, without: set[str] = TIMINGS) -> list[dict[str, str]]:
    """The table of a batch without its timings."""
    with (folder / "pairs.results.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if k not in without} for row in rows]


def query(ledger: Path, sql: str) -> list[tuple[object, ...]]:
    """Ask a ledger."""
    with closing(sqlite3.connect(ledger)) as db:
        return db.execute(sql).fetchall()


def debris(folder: Path) -> list[Path]:
    """What interrupted writes have left."""
    ends = (".geodelreg", "-wal", "-shm", "-journal")
    return [path for path in folder.rglob("*") if path.name.endswith(ends)]
