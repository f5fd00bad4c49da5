"""SIGTERM and SIGHUP as exceptions, so that every ``finally`` removes its temporaries."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any

# Seconds after which a request to end that Python dropped is made again: any time that the
# callback which it met needs to return.
_AGAIN_S = 0.01


class Terminated(BaseException):
    """The process was asked to end.  Like KeyboardInterrupt, no ``except Exception`` stops it."""

    def __init__(self, signal_number: int) -> None:
        self.signal_number = signal_number
        super().__init__(signal.Signals(signal_number).name)


def _raise(signal_number: int, _frame: FrameType | None) -> None:
    signal.signal(signal_number, signal.SIG_DFL)  # asked twice, the process ends at once
    raise Terminated(signal_number)


def _again(dropped: Any) -> None:
    """Ask again where the exception met a callback, out of which Python lets none.

    Such are ``__del__``, weak references' callbacks (each import has one) and GDAL's: Python
    prints what they raise and goes on, so that a process asked to end would run to its end.
    """
    error = dropped.exc_value
    if not isinstance(error, Terminated | KeyboardInterrupt):
        sys.__unraisablehook__(dropped)
        return
    import _thread
    import threading

    number = signal.SIGINT
    if isinstance(error, Terminated):
        number = signal.Signals(error.signal_number)
        signal.signal(number, _raise)
    main = threading.main_thread().ident
    if main is not None and hasattr(signal, "pthread_kill"):
        ask = partial(signal.pthread_kill, main, number)  # wakes it also out of a sleep
    else:  # Windows
        ask = partial(_thread.interrupt_main, number)
    timer = threading.Timer(_AGAIN_S, ask)
    timer.daemon = True
    timer.start()


@contextmanager
def termination_as_exception() -> Iterator[None]:
    """Raise `Terminated` in the main thread on SIGTERM and SIGHUP.

    A signal that the parent has set to be ignored (``nohup``) stays ignored.
    """
    hook, sys.unraisablehook = sys.unraisablehook, _again
    numbers = [getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP")]
    replaced = [n for n in numbers if n is not None and signal.getsignal(n) is signal.SIG_DFL]
    for number in replaced:
        signal.signal(number, _raise)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number in replaced:
            signal.signal(number, signal.SIG_DFL)
