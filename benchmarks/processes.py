"""Processes that are measured from outside, and how they find geodelreg."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True, slots=True)
class Usage:
    """What a process cost and how it ended."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    status: int
    last_line: str


def measured(command: list[str], env: dict[str, str], timeout_s: float, folder: Path) -> Usage:
    """Run a command as a session of its own and read its resources from the kernel.

    The kernel counts a child's peak from the fork on, when it still is its parent: call this from a
    process that is smaller than what it measures.
    """
    with (folder / "stderr.txt").open("w+b") as errors:
        started = time.perf_counter()
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=errors, env=env, cwd=folder,
            start_new_session=True,
        )  # fmt: skip
        stop = threading.Timer(timeout_s, _kill_session, [process.pid])
        stop.start()
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - started
        stop.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        errors.seek(0)
        lines = errors.read().decode(errors="replace").strip().splitlines()
    last = lines[-1].strip() if lines else ""
    if wall >= timeout_s:
        last = f"stopped after {timeout_s:g} s"
    return Usage(
        wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, process.returncode, last
    )


def _kill_session(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)


def own_environment() -> dict[str, str]:
    """Environment variables under which this checkout's geodelreg is found.

    Its byte code is kept, as pip keeps that of an installed copy and of every peer.
    """
    paths = os.pathsep.join([str(ROOT), str(ROOT / "cli")])
    rest = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    return {**rest, "PYTHONPATH": paths}
