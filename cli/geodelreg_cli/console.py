"""What the user sees on stderr: logs, warnings and the progress bar."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

Progress = Callable[[float, str], None]


class _Stderr(logging.Handler):
    """Log records to whatever stderr is now: the progress bar replaces it while it is shown."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        click.echo(self.format(record), err=True)


def printable(text: str) -> str:
    """`text` without what would control the terminal; names of files may hold anything."""
    return "".join(char if char.isprintable() else "\ufffd" for char in text)


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
        logging.Formatter(
            "%(levelname)s %(name)s: %(message)s" if debug else "geodelreg: %(message)s"
        )
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.WARNING if debug or (verbose and not quiet) else logging.CRITICAL)
    for name in ("geodelreg", "geodelreg_cli"):
        logging.getLogger(name).setLevel(logging.DEBUG if debug else level)
    logging.captureWarnings(True)
    if not (debug or verbose):  # GDAL's own threads know no logger and would print
        os.environ.setdefault("CPL_LOG", os.devnull)


def log_steps(show: Progress | None) -> Progress:
    """Log each step when it begins, at level info, and pass the progress on to a bar if any."""
    begun: list[str] = []

    def report(fraction: float, text: str) -> None:
        if text not in begun:
            begun.append(text)
            logging.getLogger(__name__).info("%s", text)
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
            bar.update(task, completed=fraction, description=text)

        yield show
