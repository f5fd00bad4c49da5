"""Faults at every call that changes files: errors, and kill -9 before, within and after it."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

CALLS = (
    *("write", "fsync", "ftruncate", "replace", "unlink", "mkdir", "rmdir", "copy_file_range"),
    *("link", "chmod"),
)


class Fault:
    """Counts the calls of this process that change files; the chosen one goes wrong."""

    def __init__(self, at: int, action: Callable[[], None], partly: bool) -> None:
        self.at, self.action, self.partly, self.count = at, action, partly, 0

    def wrap(self, call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            self.count += 1
            if self.count != self.at:
                return call(*args, **kwargs)
            try:
                if self.partly and name in ("write", "write_bytes"):
                    target, data = args
                    call(target, bytes(data)[: len(data) // 2])
                elif self.partly:
                    call(*args, **kwargs)
            finally:
                self.action()
            return None

        return wrapped


@contextmanager
def injected(fault: Fault) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, fault.wrap(getattr(os, name), name))
        patch.setattr(Path, "write_bytes", fault.wrap(Path.write_bytes, "write_bytes"))
        patch.setattr(Path, "write_text", fault.wrap(Path.write_text, "write_text"))
        yield


def failing(number: int) -> Callable[[], None]:
    def fail() -> None:
        raise OSError(number, os.strerror(number))

    return fail


def run_with_error(work: Callable[[], object], at: int, number: int = errno.ENOSPC) -> bool:
    """Run with the `at`-th call failing; True when there was such a call."""
    fault = Fault(at, failing(number), partly=False)
    with injected(fault):
        try:
            work()
        except OSError as error:
            raise AssertionError(f"a bare {error!r} reached the caller") from error
        except Exception:
            assert fault.count >= at
    return fault.count >= at


def run_killed(work: Callable[[], object], at: int, partly: bool) -> bool:
    """Run in a child process that is killed at its `at`-th call; True when it was.

    `work` is pickled: the child is not forked from the process of the tests, which has grown so
    large that copying its page tables takes longer than the work.
    """
    child = _SMALL.Process(target=_run_to_be_killed, args=(work, at, partly))
    child.start()
    child.join()
    assert child.exitcode in (0, -signal.SIGKILL)
    return child.exitcode == -signal.SIGKILL


_SMALL = get_context("forkserver")
_SMALL.set_forkserver_preload(
    [
        f"tests.integration.test_{name}"
        for name in ("atomic", "inplace", "private_folder", "together")
    ]
)


def _run_to_be_killed(work: Callable[[], object], at: int, partly: bool) -> None:
    try:
        with injected(Fault(at, lambda: os.kill(os.getpid(), signal.SIGKILL), partly)):
            work()
    finally:
        os._exit(0)


def run_as_ordinary_user(work: Callable[[], object]) -> bool:
    """Run in a child process without root's rights; True when nothing was raised."""
    child = os.fork()
    if child == 0:
        try:
            if os.getuid() == 0:
                os.setgid(65534)
                os.setuid(65534)
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitpid(child, 0)[1] == 0


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def restore(folder: Path, files: dict[str, bytes]) -> None:
    for path in folder.iterdir():
        if path.is_dir():
            for inner in sorted(path.rglob("*"), reverse=True):
                inner.rmdir() if inner.is_dir() else inner.unlink()
            path.rmdir()
        else:
            path.unlink()
    for name, data in files.items():
        (folder / name).write_bytes(data)
