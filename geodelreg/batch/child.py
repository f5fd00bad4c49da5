"""The process that runs pairs, one after the other: ``python -m geodelreg.batch.child``.

It is warm: NumPy, OpenCV and GDAL are loaded once.  One line of JSON a task comes in on stdin, one
line a result goes out on stdout.  When stdin ends, whoever owned the process is gone, and it ends
at once, also in the middle of a pair.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import platform
import queue
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from time import perf_counter, sleep
from typing import TYPE_CHECKING, TextIO, TypeVar

from geodelreg.batch.job import ALREADY_ALIGNED, CHECK, FAILED, IN_PLACE, REFUSED, PairResult, Task
from geodelreg.errors import AlignmentRefusedError, FileLockedError, GeodelregError, PairMemoryError

if TYPE_CHECKING:
    from geodelreg.product.check import Check
    from geodelreg.values.result import Alignment

_T = TypeVar("_T")
_IDLE_S = 900.0
"""A worker that has had no pair for so long gets a new process with the next."""
_LOCK_TRIES, _LOCK_WAIT_S = 40, 0.5


def main() -> None:
    """Run the tasks of stdin until it ends."""
    faulthandler.enable()
    with suppress(OSError):  # of all processes, the system shall take this one when memory is short
        Path("/proc/self/oom_score_adj").write_text("900")
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print is no answer
    tasks: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_read, args=(tasks,), daemon=True).start()
    _warm_up()
    _answer(answers, json.dumps({"ready": os.getpid()}))
    while True:
        try:
            line = tasks.get(timeout=_IDLE_S)
        except queue.Empty:
            return
        result, healthy = run_task(Task.from_json(line))
        _answer(answers, json.dumps({"result": result.to_json(), "healthy": healthy}))


def _read(tasks: queue.Queue[str]) -> None:
    for line in sys.stdin:
        tasks.put(line)
    os._exit(0)


def _answer(answers: TextIO, text: str) -> None:
    answers.write(text + "\n")
    answers.flush()


def _warm_up() -> None:
    import cv2
    import pyproj  # noqa: F401 - loaded before the first pair
    import rasterio  # noqa: F401

    import geodelreg.api
    import geodelreg.geotiff.corrected
    import geodelreg.product.warp  # noqa: F401

    cv2.setNumThreads(1)


def run_task(task: Task) -> tuple[PairResult, bool]:
    """Run one pair.

    Parameters
    ----------
    task : Task

    Returns
    -------
    PairResult
        Every error is one of its outcomes.
    bool
        False when the process had better not be used again.
    """
    start, healthy = perf_counter(), True
    result = PairResult.of(task.number, task.pair, FAILED, host=platform.node())
    with _logged_warnings() as logged:
        try:
            result = _RUN[task.mode](task, result)
        except AlignmentRefusedError as refusal:
            result = replace(result, outcome=REFUSED, reason=refusal.cause)
            if refusal.alignment is not None:
                result = _with_alignment(result, refusal.alignment)
                _write_page(task, refusal.alignment)
        except GeodelregError as error:
            reason = f"{error.cause}. {error.remedy}" if error.remedy else error.cause
            result = replace(result, error=type(error).__name__, reason=reason)
        except Exception as error:
            healthy = False
            short = _is_memory(error)
            kind, text = (PairMemoryError, "not enough memory: ") if short else (type(error), "")
            result = replace(result, error=kind.__name__, reason=f"{text}{error}")
    if result.outcome in (REFUSED, FAILED):
        tidy_up(task)
    warnings = tuple(dict.fromkeys([*result.warnings, *logged]))
    return replace(result, warnings=warnings, duration_s=perf_counter() - start), healthy


def tidy_up(task: Task) -> None:
    """Remove what a killed process has left beside the outputs of a pair."""
    from geodelreg.geotiff.atomic import tidy

    tidy(map(Path, task.pair.sources) if task.mode == IN_PLACE else task.pair.targets)


def _align(task: Task, result: PairResult) -> PairResult:
    import geodelreg
    from geodelreg.geo.lonlat import footprint
    from geodelreg.geotiff.targets import make_folder
    from geodelreg.options import AlignOptions, WriteOptions
    from geodelreg.product.provenance import provenance_tags, written_tags

    pair = task.pair
    options = AlignOptions(**pair.align, threads=1)
    alignment = geodelreg.align(pair.sources, pair.reference, options)
    result = _with_alignment(result, alignment)
    _write_page(task, alignment)  # of the inputs as they are
    tags = provenance_tags(alignment)
    if task.mode == IN_PLACE:
        notes = _when_free(lambda: geodelreg.write_in_place(alignment))
        notes += _corrected_before(pair.sources, tags, alignment.verdict.outcome.value)
    else:
        make_folder(Path(pair.output).parent)
        write = WriteOptions(**pair.write)

        def publish() -> list[str]:
            # a file that says it is this very result was left by a run that was killed
            found = [written_tags(path) for path in pair.targets if path.exists()]
            own = bool(found) and all(there == tags for there in found)
            return geodelreg.write(
                alignment, pair.output, replace(write, overwrite=write.overwrite or own)
            )

        notes = _when_free(publish)
    outline = footprint(alignment.source.grid, alignment.correction.corrected)
    return replace(
        result,
        outcome=alignment.verdict.outcome.value,
        warnings=(*result.warnings, *notes),
        footprint=outline,
    )


def _corrected_before(sources: Sequence[str], tags: Mapping[str, str], outcome: str) -> list[str]:
    """Say so when an already aligned header owes that to an earlier correction in place."""
    from geodelreg.product.provenance import written_tags

    if outcome != ALREADY_ALIGNED:
        return []
    pan = "GEODELREG_PAN_FINGERPRINT"
    return [
        f"{Path(name).name}: its header carries a correction against this PAN already"
        for name in sources
        if tags.get(pan) and written_tags(Path(name)).get(pan) == tags[pan]
    ]


def _check(task: Task, result: PairResult) -> PairResult:
    import geodelreg
    from geodelreg.batch.figures import check_figures
    from geodelreg.options import AlignOptions

    options = AlignOptions(**task.pair.align, threads=1)
    check = geodelreg.check(task.pair.sources, task.pair.reference, options, limit_px=task.limit_px)
    result = _with_alignment(result, check.alignment)
    _write_page(task, check.alignment, check)
    figures = {**result.figures, **check_figures(check.misalignment)}
    return replace(result, outcome=check.outcome.value, reason=check.reason, figures=figures)


_RUN: dict[str, Callable[[Task, PairResult], PairResult]] = {
    "align": _align,
    IN_PLACE: _align,
    CHECK: _check,
}


def _write_page(task: Task, alignment: Alignment, check: Check | None = None) -> None:
    """Write the page to look at, where one is asked for; without it the pair is none the worse."""
    if not task.page:
        return
    from geodelreg.geotiff.atomic import write_text_atomically
    from geodelreg.report.page import page

    try:
        write_text_atomically(Path(task.page), page(alignment, check), overwrite=True)
    except GeodelregError as error:
        logging.getLogger(__name__).warning("no page of this pair: %s", error)


def _with_alignment(result: PairResult, alignment: Alignment) -> PairResult:
    """Figures, warnings and the footprint under the header as it is."""
    from geodelreg.batch.figures import figures_of
    from geodelreg.geo.lonlat import footprint

    return replace(
        result,
        figures=figures_of(alignment),
        warnings=alignment.warnings,
        footprint=footprint(alignment.source.grid, alignment.source.grid.transform),
    )


def _when_free(write: Callable[[], _T]) -> _T:
    """Write once the process that holds the target is done; it may be a lost worker's."""
    for _ in range(_LOCK_TRIES):
        with suppress(FileLockedError):
            return write()
        sleep(_LOCK_WAIT_S)
    return write()


def _is_memory(error: Exception) -> bool:
    import cv2

    short_of_memory = -4
    return isinstance(error, MemoryError) or (
        isinstance(error, cv2.error) and getattr(error, "code", None) == short_of_memory
    )


@contextmanager
def _logged_warnings() -> Iterator[list[str]]:
    """Collect what the library logs as warnings while the block runs."""
    texts: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            texts.append(record.getMessage())

    handler, logger = Collector(logging.WARNING), logging.getLogger("geodelreg")
    logger.addHandler(handler)
    logger.propagate, before = False, logger.propagate
    try:
        yield texts
    finally:
        logger.removeHandler(handler)
        logger.propagate = before


if __name__ == "__main__":
    main()
