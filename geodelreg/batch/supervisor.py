"""Warm children and who watches them: time, memory and crashes of a pair are decided here.

`run_pair` is what runs on a worker, whatever the worker is: a thread of the driver, a process of a
pool, a worker of Dask.  It keeps one child for each pair that runs at a time.
"""

from __future__ import annotations

import atexit
import json
import os
import platform
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from time import monotonic

from geodelreg import __version__
from geodelreg.batch.child import tidy_up
from geodelreg.batch.job import FAILED, PairResult, Task
from geodelreg.errors import (
    ClusterError,
    GeodelregError,
    PairCrashedError,
    PairMemoryError,
    PairTimeoutError,
)

START_S = 300.0
"""A child that has not loaded its libraries by then never will."""

ATTEMPTS = 3
_LOOK_S = 0.05
_STATUS = Path("/proc/self/status")
_ONE_THREAD = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
    *("VECLIB_MAXIMUM_THREADS", "OPENCV_FOR_THREADS_NUM", "GDAL_NUM_THREADS"),
)


class _DiedError(Exception):
    """The child has ended without an answer."""


class Child:
    """One child, and the thread that reads its answers.

    Parameters
    ----------
    environment : mapping of str to str
        Variables beside those of this process.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.environment = dict(environment)
        self.pairs = 0
        self.is_healthy = True
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the child
        self._process = subprocess.Popen(
            [sys.executable, "-m", "geodelreg.batch.child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            encoding="utf-8",
            env={**os.environ, "CPL_LOG": os.devnull, **environment}
            | dict.fromkeys(_ONE_THREAD, "1"),
            start_new_session=True,  # Ctrl-C is for the driver, which ends its children
        )
        self._answers: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        try:
            self._answer("it", START_S, None)
        except GeodelregError:
            self.end()
            raise
        except _DiedError:
            raise self._not_started() from None

    @property
    def pid(self) -> int:
        """Number of its process."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether it can take a task."""
        return self._process.poll() is None

    def run(self, task: Task) -> PairResult:
        """Give it a task and wait for the answer.

        Raises
        ------
        PairTimeoutError, PairMemoryError, PairCrashedError
            The child is of no use then.
        """
        self.pairs += 1
        self._errors.seek(0)
        self._errors.truncate()
        name, kills = Path(task.pair.sources[0]).name, _kills_for_memory()
        assert self._process.stdin is not None
        try:
            with suppress(BrokenPipeError):
                self._process.stdin.write(task.to_json() + "\n")
                self._process.stdin.flush()
            answer = json.loads(self._answer(name, task.timeout_s, task.memory_mb))
        except _DiedError:
            raise self._cause_of_death(name, kills) from None
        self.is_healthy = bool(answer["healthy"])
        result = PairResult.from_json(answer["result"])
        if result.error == PairMemoryError.__name__ and self.pairs > 1:
            raise PairMemoryError(result.reason)
        return result

    def kill(self) -> None:
        """Kill it, if it lives."""
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """Kill it, if it lives, and forget it."""
        self.kill()
        for pipe in (self._process.stdin, self._errors):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as answers:
            for line in answers:
                self._answers.put(line)
        self._answers.put("")

    def _answer(self, name: str, timeout_s: float | None, memory_mb: int | None) -> str:
        """The next line, while the child keeps to its limits."""
        start = monotonic()
        while True:
            with suppress(queue.Empty):
                line = self._answers.get(timeout=_LOOK_S)
                if not line.endswith("\n"):
                    self._process.wait()
                    raise _DiedError
                return line
            if timeout_s is not None and monotonic() - start > timeout_s:
                self.end()
                raise PairTimeoutError(
                    f"{name} took more than {timeout_s:g} s",
                    "Allow more (`timeout_s`), then `retry=['failed']`.",
                )
            if memory_mb is not None and _peak_mb(self._process.pid) > memory_mb:
                self.end()
                raise PairMemoryError(
                    f"{name} needed more than {memory_mb} MB of memory",
                    "Allow more (`memory_mb`), then `retry=['failed']`.",
                )

    def _not_started(self) -> GeodelregError:
        what = f"the process for pairs does not start on {platform.node()}"
        if self._process.returncode < 0:  # someone killed it; the next may live
            return PairCrashedError(f"{what}: {self._ending()}", "Look who kills processes there.")
        return ClusterError(
            f"{what}: {self._ending()}", "Install geodelreg there; `geodelreg --version` tries it."
        )

    def _cause_of_death(self, name: str, kills_before: int) -> GeodelregError:
        code = self._process.returncode
        if code == -9 and _kills_for_memory() > kills_before:
            return PairMemoryError(
                f"the system killed the process of {name}, for memory was short",
                "Run fewer pairs at a time (-j), or on a machine with more memory.",
            )
        return PairCrashedError(
            f"the process of {name} ended: {self._ending()}",
            "Look at the rasters with gdalinfo; obtain them again.",
        )

    def _ending(self) -> str:
        """How it ended, and what it left on stderr: a crash's first line, a traceback's last."""
        code = self._process.returncode
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        fatal = [line for line in lines if line.startswith("Fatal Python error")]
        return f"{how} ({(fatal or lines[-1:] or ['no message'])[0]})"


def _peak_mb(pid: int) -> float:
    """Most memory that a process has held; 0 when it has ended."""
    with suppress(OSError):
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
        found = status.partition("VmHWM:")[2].split(maxsplit=1)
        return int(found[0]) * 1024 / 1e6 if found else 0.0
    return 0.0


def _kills_for_memory() -> int:
    """Processes that the system has killed for want of memory since it started."""
    with suppress(OSError):
        counters = Path("/proc/vmstat").read_text(encoding="ascii")
        return int(counters.partition("\noom_kill ")[2].split(maxsplit=1)[0] or 0)
    return 0


class Children:
    """Children of this process: those that run a pair, and idle ones."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[Child] = []
        self._busy: set[Child] = set()
        self._stopped = False

    def run(self, text: str) -> str:
        """As `run_pair`.

        A pair whose child dies is given to a fresh one; what only a worn child could not hold, it
        can.
        """
        task = Task.from_json(text)
        if task.version != __version__:
            raise ClusterError(
                f"the worker {platform.node()} has geodelreg {__version__}, "
                f"the driver {task.version}",
                "Install the same version everywhere.",
            )
        if task.memory_mb is not None and not _STATUS.exists():
            raise ClusterError(
                f"{platform.node()} does not say what its processes hold; `memory_mb` needs that",
                "Leave `memory_mb` out, or run on Linux.",
            )
        start = monotonic()
        for attempt in range(1, ATTEMPTS + 1):
            child = None
            try:
                child = self._take(task.environment, fresh=attempt > 1)
                result = child.run(task)
            except BaseException as error:
                if child is not None:
                    self._drop(child)
                if isinstance(error, ClusterError) or not isinstance(error, GeodelregError):
                    raise
                failure = error
                if child is None:
                    continue
            else:
                self._give_back(child)
                return replace(result, attempts=attempt).to_json()
            if self._stopped:
                failure = ClusterError("the batch was stopped", "Add `resume=True`.")
            spent = isinstance(failure, PairMemoryError) and child.pairs == 1
            if spent or isinstance(failure, ClusterError | PairTimeoutError):
                break  # no further attempt would change it
        tidy_up(task)
        return _failed(task, failure, attempt, monotonic() - start).to_json()

    def _give_back(self, child: Child) -> None:
        if not child.is_healthy:
            self._drop(child)
            return
        with self._lock:
            self._busy.discard(child)
            self._idle.append(child)

    def _take(self, environment: Mapping[str, str], fresh: bool) -> Child:
        child = None if fresh else self._waiting(environment)
        child = child or Child(environment)
        with self._lock:
            self._busy.add(child)
            stopped = self._stopped
        if stopped:
            child.kill()
        return child

    def _waiting(self, environment: Mapping[str, str]) -> Child | None:
        with self._lock:
            same = [child for child in self._idle if child.environment == environment]
            for child in same:
                self._idle.remove(child)
                if child.is_alive:
                    return child
                child.end()
        return None

    def _drop(self, child: Child) -> None:
        with self._lock:
            self._busy.discard(child)
        child.end()

    def stop(self) -> None:
        """End all children, also in the middle of a pair; no pair runs any more."""
        with self._lock:
            self._stopped = True
            children = [*self._idle, *self._busy]
            self._idle.clear()
        for child in children:
            child.kill()


_shared = Children()
atexit.register(_shared.stop)


def run_pair(text: str) -> str:
    """Run one pair on a worker, in a child of its process.

    Parameters
    ----------
    text : str
        `Task` as JSON.

    Returns
    -------
    str
        `PairResult` as JSON; every ending of the pair is one.

    Raises
    ------
    ClusterError
        This worker has another geodelreg than the driver, or none that starts.
    """
    return _shared.run(text)


def _failed(task: Task, error: GeodelregError, attempts: int, duration_s: float) -> PairResult:
    targets = task.pair.targets
    there = [path.name for path in targets if path.exists()]
    whole = f"{len(there)} of {len(targets)} outputs were written: {', '.join(there)}"
    return PairResult.of(
        task.number,
        task.pair,
        FAILED,
        error=type(error).__name__,
        reason=f"{error.cause}. {error.remedy}",
        warnings=(whole,) if there else (),
        duration_s=duration_s,
        attempts=attempts,
        host=platform.node(),
    )
