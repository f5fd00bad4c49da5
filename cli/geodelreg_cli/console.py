"""What the user sees on stderr: logs, warnings and the progress bar."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from geodelreg.errors import shown
from geodelreg.flags import as_typed

if TYPE_CHECKING:
    from geodelreg.values.result import Alignment

Progress = Callable[[float, str], None]

LOGGED = 0.1
"""Share of a run after which the log says again how far it is."""


class _Stderr(logging.Handler):
    """Log records to whatever stderr is now: the progress bar replaces it while it is shown."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        click.echo(self.format(record), err=True)


class _Shown(logging.Formatter):
    """Names and texts of files in the messages cannot control the terminal; knobs are flags."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        """One line of one record."""
        return shown(as_typed(super().formatMessage(record).strip()))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        """Traceback."""
        return "\n".join(map(shown, super().formatException(ei).split("\n")))


def configure_logging(verbose: int, quiet: bool, debug: bool) -> None:
    """Send logs to stderr: warnings always but with -q, progress of the steps with -v.

    What GDAL has to say about a broken file is in the error that geodelreg raises, so the messages
    of other libraries are shown from -v on only.

    Parameters
    ----------
    verbose : int
        0 warnings, 1 info, 2 and more everything.
    quiet : bool
        Errors only.
    debug : bool
        Everything, with the names of the loggers.
    """
    level = logging.ERROR if quiet else max(logging.DEBUG, logging.WARNING - 10 * verbose)
    handler = _Stderr()
    handler.setFormatter(
        _Shown("%(levelname)s %(name)s: %(message)s" if debug else "geodelreg: %(message)s")
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.WARNING if debug or (verbose and not quiet) else logging.CRITICAL)
    for name in ("geodelreg", "geodelreg_cli"):
        logging.getLogger(name).setLevel(logging.DEBUG if debug else level)
    logging.captureWarnings(True)
    if not (debug or verbose):  # GDAL's own threads know no logger and would print
        os.environ.setdefault("CPL_LOG", os.devnull)


def warn(texts: Iterable[str]) -> None:
    """Warnings of the library, a line each."""
    for text in texts:
        logging.getLogger(__name__).warning("warning: %s", text)


def log_steps(show: Progress | None) -> Progress:
    """Log each step when it begins, and each further tenth, at level info; feed a bar if any."""
    last: dict[str, float] = {}

    def report(fraction: float, text: str) -> None:
        if fraction >= last.get(text, -1.0) + LOGGED:
            last[text] = fraction
            logging.getLogger(__name__).info("%s, %.0f %%", text, 100 * fraction)
        if show is not None:
            show(fraction, text)

    return report


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Progress | None]:
    """Show a bar while the block runs, on a terminal only; None when there is nothing to show."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress

    columns = (BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with RichProgress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)

        def show(fraction: float, text: str) -> None:
            bar.update(task, completed=fraction, description=shown(text))

        yield show


def log_timings(alignment: Alignment) -> None:
    """Where the time went, and what did the work, for -v."""
    log = logging.getLogger(__name__)
    timings = (f"{step} {seconds:.2f}" for step, seconds in alignment.timings_s.items())
    log.info("seconds: %s", ", ".join(timings))
    log.info("versions: %s", ", ".join(f"{n} {v}" for n, v in alignment.versions.items()))
    if alignment.crs_operation:
        log.info("coordinates: %s", alignment.crs_operation)
