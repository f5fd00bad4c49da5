"""Small pairs, the tables of a batch, and the processes that run it."""

from __future__ import annotations

import csv
import json
import os
import signal
import sqlite3
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from tests.cli.helpers import COMMAND

TIMINGS = {"duration_s", "attempts", "host"}


def write_manifest(path: Path, rows: Iterable[Mapping[str, object]]) -> Path:
    """CSV with the columns of the first row."""
    rows = list(rows)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_lines(path: Path, rows: Iterable[object]) -> Path:
    """JSON lines."""
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    return path


def read_table(path: Path, without: Iterable[str] = ()) -> list[dict[str, str]]:
    """Rows of a table of results, without some columns."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    dropped = set(without)
    return [{k: v for k, v in row.items() if k not in dropped} for row in rows]


def outcomes(path: Path) -> list[str]:
    return [row["outcome"] for row in read_table(path)]


def query(ledger: Path, sql: str) -> list[tuple[Any, ...]]:
    """Ask a ledger as any user may."""
    with closing(sqlite3.connect(ledger)) as db:
        return db.execute(sql).fetchall()


def start(*args: object, cwd: Path) -> subprocess.Popen[str]:
    """``geodelreg ARGS`` in the background, where Ctrl-C reaches it.

    A shell's background jobs ignore SIGINT, and so would what they start: the tests, and this.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            [*COMMAND, *map(str, args)], cwd=cwd, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
    finally:
        signal.signal(signal.SIGINT, before)


def wait_until(true: Callable[[], object], seconds: float = 60.0) -> None:
    """Return when something is true."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.005)


def descendants(pid: int) -> dict[int, str]:
    """Processes below one, with their command lines."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError, IndexError):
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                parents.setdefault(int(fields[1]), []).append(int(entry.name))
    found, todo = {}, [pid]
    while todo:
        for child in parents.get(todo.pop(), []):
            with suppress(OSError):
                found[child] = Path(f"/proc/{child}/cmdline").read_text().replace("\0", " ")
                todo.append(child)
    return found


def children_for_pairs(pid: int) -> list[int]:
    """The processes below one that run pairs."""
    return [p for p, line in descendants(pid).items() if "geodelreg.batch.child" in line]


def kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def debris(folder: Path) -> list[str]:
    """What a write that was interrupted leaves behind."""
    return sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.name.endswith((".geodelreg", "-wal", "-shm", "-journal"))
    )
