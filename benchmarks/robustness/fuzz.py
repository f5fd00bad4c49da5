"""Mutated inputs against the library: nothing may crash, hang, grow or break a promise.

Warm worker processes run numbered cases (`benchmarks.robustness.fuzz_cases`); this process watches
their time and memory, and replaces one that dies.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from benchmarks.records import Row, resume
from benchmarks.report import replace_section

HANG_S = 30.0
"""Of CPU time, for the machine may be busy."""

WAIT_S = 300.0
"""Of wall time, for a case that waits for something."""

LARGEST_RSS = 1_500_000_000
_ADDRESS_SPACE = 12_000_000_000
"""Beyond this an allocation fails, before the machine suffers."""

_POLL_S = 0.05
FAULTS = ("traceback", "crash", "hang", "memory", "promise")


def serve(pipe: Connection, root: Path) -> None:
    """Run the cases whose numbers arrive, in a process of its own; None ends it."""
    import resource

    from benchmarks.robustness.fuzz_cases import run_case, seeds

    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with (root / "stderr").open("ab") as log:
        os.dup2(log.fileno(), 2)
    for is_pan in (False, True):
        seeds(is_pan, 80)
    pipe.send(None)
    while (number := pipe.recv()) is not None:
        _reset_peak()
        folder = root / f"case{number}"
        folder.mkdir()
        try:
            row = run_case(number, folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        pipe.send(row | {"rss_mb": _peak() / 1e6})


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


def _rss(pid: int) -> int:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _cpu_s(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass(slots=True)
class Worker:
    """A process, the case it runs, and since when."""

    root: Path
    process: BaseProcess
    pipe: Connection
    number: int | None = None
    started: float = 0.0
    cpu_before: float = 0.0

    @classmethod
    def start(cls, root: Path) -> Worker:
        """Start a process and wait until it is warm."""
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        folder = Path(tempfile.mkdtemp(dir=root))
        process = context.Process(target=serve, args=(theirs, folder), daemon=True)
        process.start()
        theirs.close()
        ours.recv()
        return cls(folder, process, ours)

    def give(self, number: int) -> None:
        """Start a case."""
        self.number, self.started = number, time.monotonic()
        self.cpu_before = _cpu_s(self.process.pid or 0)
        self.pipe.send(number)

    def poll(self) -> Row | None:
        """Row of the case when it has ended, also when the process had to be ended or died."""
        try:
            if self.pipe.poll():
                row: Row = self.pipe.recv()
                return row | {"outcome": _judged(row)}
        except (EOFError, ConnectionResetError):
            self.process.join()
            return self._lost("crash", f"exit code {self.process.exitcode}: {self._last_words()}")
        waited = time.monotonic() - self.started
        if waited > WAIT_S or _cpu_s(self.process.pid or 0) - self.cpu_before > HANG_S:
            return self._lost("hang", f"stopped after {waited:.0f} s")
        if (rss := _rss(self.process.pid or 0)) > 2 * LARGEST_RSS:
            return self._lost("memory", f"{rss / 1e6:.0f} MB")
        return None

    def _lost(self, outcome: str, detail: str) -> Row:
        self.stop()
        seconds = time.monotonic() - self.started
        row = {"number": self.number, "name": "", "outcome": outcome, "detail": detail}
        return row | {"broken": [], "seconds": seconds, "rss_mb": 0.0}

    def _last_words(self) -> str:
        return (self.root / "stderr").read_bytes()[-500:].decode(errors="replace")

    def stop(self) -> None:
        """End the process."""
        if self.process.is_alive() and self.process.pid:
            os.kill(self.process.pid, signal.SIGKILL)
        self.process.join()
        shutil.rmtree(self.root, ignore_errors=True)


def _judged(row: Row) -> str:
    if row["outcome"] in ("ok", "error") and row["rss_mb"] * 1e6 > LARGEST_RSS:
        return "memory"
    if row["outcome"] in ("ok", "error") and row["broken"]:
        return "promise"
    return str(row["outcome"])


def run_cases(numbers: list[int], processes: int, minutes: float = math.inf) -> Iterator[Row]:
    """Rows of cases, as they end."""
    waiting = iter(numbers)
    stop = time.monotonic() + 60 * minutes
    with tempfile.TemporaryDirectory(prefix="fuzz") as name:
        workers = [Worker.start(Path(name)) for _ in range(processes)]
        try:
            busy = {index for index in range(processes) if _feed(workers[index], waiting)}
            while busy:
                time.sleep(0 if any(workers[i].pipe.poll() for i in busy) else _POLL_S / 25)
                for index in sorted(busy):
                    row = workers[index].poll()
                    if row is None:
                        continue
                    yield row
                    if not workers[index].process.is_alive():
                        workers[index] = Worker.start(Path(name))
                    if time.monotonic() > stop or not _feed(workers[index], waiting):
                        busy.discard(index)
        finally:
            for worker in workers:
                worker.stop()


def _feed(worker: Worker, waiting: Iterator[int]) -> bool:
    number = next(waiting, None)
    if number is not None:
        worker.give(number)
    return number is not None


def page(rows: list[Row]) -> str:
    """Table of outcomes in Markdown."""
    actions = sorted({_action(row) for row in rows})
    counts = Counter((_action(row), row["outcome"]) for row in rows)
    outcomes = ("ok", "error", *FAULTS)
    heads = {"error": "clean error", "promise": "promise broken"}
    lines = ["| action | " + " | ".join(heads.get(o, o) for o in outcomes) + " |"]
    lines.append("|---" + "|---:" * len(outcomes) + "|")
    for action in actions:
        cells = " | ".join(f"{counts[action, outcome]}" for outcome in outcomes)
        lines.append(f"| {action} | {cells} |")
    totals = Counter(row["outcome"] for row in rows)
    lines.append("| all | " + " | ".join(f"{totals[outcome]}" for outcome in outcomes) + " |")
    slowest = max((row["seconds"] for row in rows), default=0.0)
    peak = max((row["rss_mb"] for row in rows), default=0.0)
    lines += ["", f"{len(rows)} cases; slowest {slowest:.1f} s, peak memory {peak:.0f} MB."]
    return "\n".join(lines) + "\n"


def _action(row: Row) -> str:
    return str(row["name"]).partition(",")[0] or "(lost)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks fuzz``."""
    parser.add_argument("--out", type=Path, help="JSON lines; a run continues it")
    parser.add_argument("--count", type=int, default=20_000, help="cases, from number 0")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop starting cases then")
    parser.add_argument("--case", type=int, help="run one case in this process and print it")
    parser.add_argument("--keep", type=Path, help="new folder for the files of --case")
    parser.add_argument("--docs", type=Path, help="page whose table is replaced")


def run(args: argparse.Namespace) -> int:
    """Run what is missing of the cases; 1 when any is worse than a clean error."""
    if args.case is not None:
        return _one(args.case, args.keep)
    if args.out is None:
        raise SystemExit("--out FILE.jsonl is needed")
    rows = resume(args.out)
    done = {row["number"] for row in rows}
    missing = [number for number in range(args.count) if number not in done]
    with args.out.open("a", encoding="utf-8") as out:
        for row in run_cases(missing, args.processes, args.minutes):
            rows.append(row)
            out.write(json.dumps(row) + "\n")
            out.flush()
    text = page(rows)
    print(text)
    for row in rows:
        if row["outcome"] in FAULTS:
            print(f"{row['number']}: {row['outcome']}: {row['name']}: {row['broken']}")
    if args.docs:
        replace_section(args.docs, "fuzz", text)
    return 1 if any(row["outcome"] in FAULTS for row in rows) else 0


def _one(number: int, keep: Path | None) -> int:
    from benchmarks.robustness.fuzz_cases import run_case

    folder = keep or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    row = run_case(number, folder)
    print(f"{row['name']}\n{row['outcome']}, {row['seconds']:.2f} s: {row['detail']}")
    print("\n".join(row["broken"]))
    if keep is None:
        shutil.rmtree(folder)
    return 0
