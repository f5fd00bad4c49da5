"""The live table of ``geodelreg batch`` on a terminal."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING

from geodelreg.errors import shown
from geodelreg.flags import as_typed

if TYPE_CHECKING:
    from rich.console import RenderableType

    from geodelreg.batch import Batch, PairResult

LAST = 5


@contextmanager
def live_table(ready: Batch) -> Iterator[Callable[[PairResult], None]]:
    """Show how far the batch is while the block runs; yields what takes each result."""
    from rich.console import Console
    from rich.live import Live

    view = _View(ready)
    with Live(get_renderable=view.render, console=Console(stderr=True), refresh_per_second=4):
        yield view.take


class _View:
    """What is shown: counts, throughput, the time that is left, the last warnings."""

    def __init__(self, ready: Batch) -> None:
        self._ready = ready
        self._start = monotonic()
        self._done = 0
        self._last: deque[str] = deque(maxlen=LAST)

    def take(self, result: PairResult) -> None:
        """Take one result in."""
        self._done += 1
        name, texts = Path(result.sources[0]).name, (*result.warnings, result.reason)
        self._last.extend(shown(f"{name}: {as_typed(text)}") for text in texts if text)

    def render(self) -> RenderableType:
        """The table as it is now."""
        from rich.console import Group
        from rich.padding import Padding
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        counts = dict(self._ready.counts)
        left, total = counts.pop("unfinished", 0), sum(self._ready.counts.values())
        elapsed = monotonic() - self._start
        rate = self._done / elapsed if elapsed > 0 else 0.0
        table = Table(box=None, pad_edge=False)
        for name in (*counts, "left", "pairs/min", "time left"):
            table.add_column(name.replace("_", " "), justify="right")
        ends = _clock(left / rate) if rate else "-"
        table.add_row(*map(str, counts.values()), str(left), f"{60 * rate:.1f}", ends)
        lines = [Text(text, no_wrap=True, overflow="ellipsis") for text in self._last]
        bar = Padding(ProgressBar(max(total, 1), total - left), 0)  # ends its line
        return Group(bar, table, *lines)


def _clock(seconds: float) -> str:
    minutes, second = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{second:02d}"
