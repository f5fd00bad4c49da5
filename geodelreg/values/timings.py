"""How long the steps take."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import TypeVar

_Item = TypeVar("_Item")


class Timings(dict[str, float]):
    """Seconds of each step by its name; the caller owns it and the steps add to it.

    A step inside another counts for itself alone, so that all of them add up to the whole.
    """

    def __init__(self) -> None:
        super().__init__()
        self._began = perf_counter()

    @property
    def elapsed_s(self) -> float:
        """Seconds since it was made."""
        return perf_counter() - self._began

    def each(self, step: str, items: Iterator[_Item]) -> Iterator[_Item]:
        """The items, the making of each timed as `step`."""
        while True:
            with self(step):
                try:
                    item = next(items)
                except StopIteration:
                    return
            yield item

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        """Time a step; steps of one thread only."""
        start, others = perf_counter(), sum(self.values())
        try:
            yield
        finally:
            inside = sum(self.values()) - others
            self[step] = self.get(step, 0.0) + perf_counter() - start - inside
