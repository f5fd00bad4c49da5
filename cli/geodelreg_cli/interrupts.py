"""SIGTERM and SIGHUP as exceptions, so that every ``finally`` removes its temporaries."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Terminated(BaseException):
    """The process was asked to end.  Like KeyboardInterrupt, no ``except Exception`` stops it."""

    def __init__(self, signal_number: int) -> None:
        self.signal_number = signal_number
        super().__init__(signal.Signals(signal_number).name)


def _raise(signal_number: int, _frame: FrameType | None) -> None:
    signal.signal(signal_number, signal.SIG_DFL)  # asked twice, the process ends at once
    raise Terminated(signal_number)


@contextmanager
def termination_as_exception() -> Iterator[None]:
    """Raise `Terminated` in the main thread on SIGTERM and SIGHUP.

    A signal that the parent has set to be ignored (``nohup``) stays ignored.
    """
    numbers = [getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP")]
    replaced = [n for n in numbers if n is not None and signal.getsignal(n) is signal.SIG_DFL]
    for number in replaced:
        signal.signal(number, _raise)
    try:
        yield
    finally:
        for number in replaced:
            signal.signal(number, signal.SIG_DFL)
