"""The driver: plans the pairs, hands them to workers, and notes in the ledger what they end as."""

from __future__ import annotations

import math
import os
import queue
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Future
from itertools import chain
from os import PathLike
from pathlib import Path
from time import monotonic
from typing import Any

from geodelreg import __version__
from geodelreg.batch.executors import Workers, lost, workers_of
from geodelreg.batch.job import ALIGN, CHECK, FAILED, IN_PLACE, OUTCOMES, Pair, PairResult, Task
from geodelreg.batch.ledger import Ledger
from geodelreg.batch.plan import Setting, checked_pairs, with_absolute_masks
from geodelreg.batch.rows import Row, rows_of_file
from geodelreg.batch.tables import check_format, write_table
from geodelreg.door.formats import skip_the_rest
from geodelreg.door.names import ALL
from geodelreg.errors import ClusterError, PairCrashedError, UsageError
from geodelreg.geotiff.targets import check_replaceable, make_folder
from geodelreg.options import AlignOptions, BatchOptions, WriteOptions
from geodelreg.report.index import PAGES, page_name

AnyPath = str | PathLike[str]
Manifest = AnyPath | Iterable[Mapping[str, Any] | Row]

_BAD = ("failed", "misaligned", "refused", "cannot_tell")
_LOST_WORKERS = 3
_LOOK_S = 1.0


class Batch:
    """Pairs and their ledger, ready to run; iterate over it for the results as they come.

    Parameters
    ----------
    manifest : path, or iterable of mapping
        A file of CSV or JSON lines, or its rows: ``ms``, ``pan``, ``out`` and options.
    executor : optional
        None: child processes of this machine.  Any `concurrent.futures.Executor`, a client of Dask,
        or the address of its scheduler.
    options : BatchOptions, optional
    align, write : AlignOptions, WriteOptions, optional
        Of pairs whose row says nothing else.
    ledger : path, optional
        By default beside the manifest, of the same name with ``.ledger``; of rows ``batch.ledger``
        in `out_root`.
    out_root : path, optional
        Outputs stay below it; by default the manifest's folder, of rows the current one.
    resume : bool
        Go on with the ledger when it exists: run what has no outcome yet.
    retry : iterable of str
        Outcomes whose pairs are run once more; as `resume` otherwise.
    tables : iterable of path
        Written at the end: all results as ``.csv`` or ``.parquet``, footprints as ``.geojson`` or
        ``.gpkg``.
    report_dir : path, optional
        Folder for pages to look at: ``index.html``, and one for each pair in ``pairs``.
    config : mapping of str to str
        Configuration options of GDAL.

    Attributes
    ----------
    path : Path
        Of the ledger.
    counts : Counter
        Pairs by outcome, and ``unfinished`` ones; kept up to date while it runs.

    Raises
    ------
    ManifestError, LedgerError, UsageError, OutputExistsError, OutputUnwritableError
        Nothing is started.
    """

    def __init__(
        self,
        manifest: Manifest,
        executor: Any = None,
        *,
        options: BatchOptions | None = None,
        align: AlignOptions | None = None,
        write: WriteOptions | None = None,
        ledger: AnyPath | None = None,
        out_root: AnyPath | None = None,
        resume: bool = False,
        retry: Iterable[str] = (),
        tables: Iterable[AnyPath] = (),
        report_dir: AnyPath | None = None,
        config: Mapping[str, str] | None = None,
    ) -> None:
        # rows are gone through more than once
        self._manifest = manifest if isinstance(manifest, str | PathLike) else list(manifest)
        self._executor = executor
        self._options = options or BatchOptions()
        align = with_absolute_masks(align or AlignOptions())
        self._retry = _known_outcomes(retry)
        self._tables = [Path(path) for path in tables]
        self._pages: Path | None = None
        if report_dir is not None:
            self._pages = Path(report_dir).absolute() / PAGES
            self._tables.append(Path(report_dir) / "index.html")
        for path in self._tables:
            check_format(path)
        self._environment = _environment(align, config or {})
        source = _source(manifest)
        root = Path(out_root) if out_root is not None else source.parent if source else Path()
        self.path = ledger_path(manifest, ledger, out_root)
        going_on = (resume or bool(self._retry)) and self.path.exists()
        wal = [Path(f"{self.path}{suffix}") for suffix in ("-wal", "-shm")]
        self._setting = Setting(
            name=str(source or "the list of pairs"),
            folder=(source.parent if source else Path()).absolute(),
            out_root=root.absolute(),
            mode=CHECK if self._options.check else IN_PLACE if self._options.in_place else ALIGN,
            align=align,
            write=write or WriteOptions(),
            reserved=(*([source] if source else []), self.path, *wal, *self._tables),
            fresh=not going_on,
        )
        self._going_on = going_on
        self.counts: Counter[str] = Counter()

    def pairs(self) -> Iterator[Pair]:
        """The pairs, checked; see `checked_pairs` for what it raises, and when."""
        manifest = self._manifest
        if isinstance(manifest, str | PathLike):
            rows: Iterable[Row] = rows_of_file(Path(manifest))
        else:
            rows = (
                row if isinstance(row, Row) else Row(f"row {number}", dict(row))
                for number, row in enumerate(manifest, start=1)
            )
        return checked_pairs(rows, self._setting)

    def planned(self) -> Iterator[Pair]:
        """The pairs that would be run; raises as `prepare` does and changes nothing."""
        for _ in self.pairs():
            pass
        if not self._going_on:
            yield from self.pairs()
            return
        with Ledger(self.path) as ledger:
            ledger.check_pairs(self._kind(), self.pairs())
            for _, pair in ledger.unfinished(self._retry):
                yield pair

    def worst(self, count: int) -> list[PairResult]:
        """Results that a user should look at: failed, misaligned or refused, in this order."""
        with Ledger(self.path) as ledger:
            found = [ledger.results(outcome, count) for outcome in _BAD]
            return list(chain.from_iterable(found))[:count]

    def _kind(self) -> str:
        mode = self._setting.mode
        return f"{mode} {self._options.limit_px!r}" if mode == CHECK else mode

    def prepare(self) -> None:
        """Check all pairs, and write the ledger or see that it is theirs; nothing is started.

        Raises
        ------
        GeodelregError
            As the class says.
        """
        overwrite = self._setting.write.overwrite
        if self._going_on:
            with Ledger(self.path) as ledger:
                for path in self._tables:
                    check_replaceable(path, overwrite or ledger.owns(path))
                ledger.check_pairs(self._kind(), self.pairs())
        else:
            Ledger.check_absent(self.path)
            for path in self._tables:
                check_replaceable(path, overwrite)
            if self._pages is not None:
                check_replaceable(self._pages / page_name(1), overwrite)
            Ledger.create(self.path, self._kind(), self.pairs())
        if self._pages is not None:
            make_folder(self._pages)
        with Ledger(self.path) as ledger:
            for path in self._tables:
                ledger.own(path)
            self.counts = ledger.counts()

    def __iter__(self) -> Iterator[PairResult]:
        """Run what has no outcome, and yield each result once it is in the ledger.

        Raises
        ------
        ClusterError
            The workers cannot be reached or are lost; `resume` goes on.
        FileLockedError
            Another process runs this ledger.
        """
        from geodelreg.geotiff.atomic import exclusive

        with exclusive(self.path), Ledger(self.path) as ledger:
            ledger.retry(self._retry)
            self.counts = ledger.counts()
            if self.counts["unfinished"]:
                workers = workers_of(self._executor, self._options.workers)
                try:
                    for result in self._run(ledger, workers):
                        self.counts[result.outcome] += 1
                        self.counts["unfinished"] -= 1
                        yield result
                finally:
                    workers.close()
            for path in self._tables:
                write_table(ledger.results(), path)

    def _run(self, ledger: Ledger, workers: Workers) -> Iterator[PairResult]:
        todo, again = ledger.unfinished(), deque[tuple[int, Pair]]()
        under_way: dict[Future[str], tuple[int, Pair]] = {}
        finished: queue.SimpleQueue[Future[str]] = queue.SimpleQueue()
        losses: Counter[int] = Counter()
        looked = -math.inf
        while True:
            if monotonic() - looked > _LOOK_S:
                workers.check()
                looked = monotonic()
            while len(under_way) < workers.at_once:
                number, pair = again.popleft() if again else next(todo, (0, None))
                if pair is None:
                    break
                ledger.start(number)
                future = workers.submit(self._task(number, pair).to_json())
                under_way[future] = number, pair
                future.add_done_callback(finished.put)
            if not under_way:
                return
            try:
                future = finished.get(timeout=_LOOK_S)
            except queue.Empty:
                continue
            number, pair = under_way.pop(future)
            result = self._result(number, pair, future, workers, losses)
            if result is None:
                again.append((number, pair))
            elif ledger.finish(result):
                yield result
                if self._options.fail_fast and result.outcome == FAILED:
                    for future in under_way:
                        future.cancel()
                    return

    def _task(self, number: int, pair: Pair) -> Task:
        options = self._options
        return Task(
            number,
            pair,
            self._setting.mode,
            options.limit_px,
            options.timeout_s,
            options.memory_mb,
            self._environment,
            __version__,
            "" if self._pages is None else str(self._pages / page_name(number)),
        )

    def _result(
        self, number: int, pair: Pair, future: Future[str], workers: Workers, losses: Counter[int]
    ) -> PairResult | None:
        """What a future says; None when its worker was lost and the pair has to run elsewhere."""
        error = None if future.cancelled() else future.exception()
        if error is None and not future.cancelled():
            return PairResult.from_json(future.result())
        workers.check()
        if isinstance(error, ClusterError):
            raise error
        if error is not None and not lost(error):
            what = "the executor is broken" if isinstance(error, BrokenExecutor) else "no pair runs"
            raise ClusterError(
                f"{what} ({type(error).__name__}: {error})",
                "Repair the workers, then add `resume=True`: what is finished is not repeated.",
            ) from error
        losses[number] += 1
        if losses[number] < _LOST_WORKERS:
            return None
        cause = PairCrashedError(
            f"{losses[number]} workers were lost that had it", "Look at the logs of the workers."
        )
        return PairResult.of(
            number, pair, FAILED,
            error=type(cause).__name__, reason=str(cause), attempts=losses[number],
        )  # fmt: skip


def run(manifest: Manifest, executor: Any = None, **settings: Any) -> Iterator[PairResult]:
    """Run many pairs.

    Parameters
    ----------
    manifest, executor, **settings
        As of `Batch`.

    Returns
    -------
    iterator of PairResult
        In the order in which they end.  All pairs are checked before this returns; they run while
        it is iterated over.

    Raises
    ------
    ManifestError, LedgerError, UsageError, OutputExistsError, OutputUnwritableError
        Nothing is started.
    """
    batch = Batch(manifest, executor, **settings)
    batch.prepare()
    return iter(batch)


def _source(manifest: Manifest) -> Path | None:
    return Path(manifest) if isinstance(manifest, str | PathLike) else None


def ledger_path(
    manifest: Manifest, ledger: AnyPath | None = None, out_root: AnyPath | None = None
) -> Path:
    """Where the ledger of a batch is: the arguments are those of `Batch`."""
    source = _source(manifest)
    if ledger is not None:
        return Path(ledger)
    if source is not None:
        return source.with_name(source.stem + ".ledger")
    return Path(out_root or ".", "batch.ledger")


def _known_outcomes(names: Iterable[str]) -> tuple[str, ...]:
    names = tuple(names)
    for name in names:
        if name not in OUTCOMES:
            raise UsageError(f"`retry={name!r}` is unknown", f"Use one of: {', '.join(OUTCOMES)}.")
    return names


def _environment(align: AlignOptions, config: Mapping[str, str]) -> dict[str, str]:
    """Variables of all children, wherever they run; the driver's alone count where bytes do."""
    variables = dict(config)
    if align.allow != ALL:
        variables.setdefault("GDAL_SKIP", os.environ.get("GDAL_SKIP", ""))
        skip_the_rest(variables, align.allow)
    date = os.environ.get("SOURCE_DATE_EPOCH")
    return variables | ({"SOURCE_DATE_EPOCH": date} if date else {})
