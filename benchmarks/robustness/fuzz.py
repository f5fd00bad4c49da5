"""Mutated and hostile inputs against the library: nothing may crash, hang, grow or get out.

Warm worker processes run numbered cases: mutations (`benchmarks.robustness.fuzz_cases`) and files,
folders and names that mean harm (`benchmarks.robustness.hostile`). This process makes the latter,
watches what comes of both (`benchmarks.robustness.witness`), their time and their memory, and
replaces a worker that dies.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from benchmarks.processes import ROOT, own_environment
from benchmarks.records import Row, resume
from benchmarks.report import replace_section
from benchmarks.robustness.hostile.families import is_hostile, prepare
from benchmarks.robustness.hostile.plan import Plan
from benchmarks.robustness.witness import (
    Facts,
    LoopbackServer,
    Snapshot,
    Trace,
    judge,
    snapshot,
)

HANG_S = 30.0
"""Of CPU time, for the machine may be busy."""

WAIT_S = 300.0
"""Of wall time, for a case that waits for something."""

HOSTILE_WAIT_S = 150.0
"""Of wall time, for a hostile case: it is small, and what it waits for never comes."""

LARGEST_RSS = 1_500_000_000
_POLL_S = 0.05
FAULTS = (
    "traceback", "crash", "hang", "memory", "promise", "connection", "process", "foreign write",
)  # fmt: skip


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
    """A process in a sandbox, what it runs, and since when."""

    root: Path
    process: subprocess.Popen[bytes]
    pipe: Connection
    server: LoopbackServer
    trace: Trace | None
    number: int | None = None
    plan: Plan | None = None
    before: Snapshot = field(default_factory=dict)
    connections: int = 0
    started: float = 0.0
    cpu_before: float = 0.0

    @classmethod
    def start(cls, root: Path, traced: bool = True) -> Worker:
        """Start a process and wait until it is warm.

        Parameters
        ----------
        root : Path
            Its sandbox becomes a folder of this one.
        traced : bool
            Under strace, so that what GDAL does is seen as well.
        """
        folder = Path(tempfile.mkdtemp(dir=root))
        trace = Trace(folder / "strace") if traced else None
        ours, theirs = multiprocessing.Pipe()
        module = [sys.executable, "-m", "benchmarks.robustness.worker", str(theirs.fileno())]
        environment = _worst_environment(folder / "sandbox")
        with (folder / "stderr").open("wb") as errors:
            process = subprocess.Popen(
                [*(trace.command() if trace else []), *module, str(folder / "sandbox" / "case")],
                pass_fds=[theirs.fileno()], env=environment, cwd=ROOT, stderr=errors,
                stdin=subprocess.DEVNULL,
            )  # fmt: skip
        theirs.close()
        try:
            ours.recv()
        except EOFError as error:
            raise SystemExit((folder / "stderr").read_text()) from error
        return cls(folder, process, ours, LoopbackServer(), trace)

    @property
    def sandbox(self) -> Path:
        """The one folder in which the process may change anything."""
        return self.root / "sandbox"

    def give(self, number: int) -> None:
        """Start a case."""
        self.plan = None
        if is_hostile(number):
            self.plan = prepare(number, self.sandbox, self.server.address)
        else:
            shutil.rmtree(self.sandbox / "case", ignore_errors=True)
            (self.sandbox / "case").mkdir()
        self.before = snapshot(self.sandbox)
        if self.trace:
            self.trace.forget()
        self.connections = self.server.count
        self.number, self.started = number, time.monotonic()
        self.cpu_before = _cpu_s(self.process.pid)
        self.pipe.send(self.plan or number)

    def poll(self) -> Row | None:
        """Row of the case when it has ended, also when the process had to be ended or died."""
        try:
            if self.pipe.poll():
                row: Row = self.pipe.recv()
                return self._judged(row)
        except (EOFError, ConnectionResetError):
            self.process.wait()
            code = self.process.returncode
            return self._lost("crash", f"exit code {code}: {self._last_words()}")
        waited = time.monotonic() - self.started
        wait_s = HOSTILE_WAIT_S if self.plan else WAIT_S
        if waited > wait_s or _cpu_s(self.process.pid) - self.cpu_before > HANG_S:
            return self._lost("hang", f"stopped after {waited:.0f} s")
        if (rss := _rss(self.process.pid)) > 2 * LARGEST_RSS:
            return self._lost("memory", f"{rss / 1e6:.0f} MB")
        return None

    def _lost(self, outcome: str, detail: str) -> Row:
        self.process.kill()
        self.process.wait()
        name = self.plan.name if self.plan else ""
        row = {"number": self.number, "name": name, "outcome": outcome, "detail": detail}
        seconds = time.monotonic() - self.started
        return self._judged(row | {"broken": [], "seconds": seconds, "rss_mb": 0.0})

    def _judged(self, row: Row) -> Row:
        """With the worst that the case has done as its outcome."""
        judgement = judge(
            row, self.plan, self.before, self.sandbox,
            self.trace.facts(self.sandbox / "case", self.sandbox) if self.trace else Facts(),
        )  # fmt: skip
        if (count := self.server.count - self.connections) > 0:
            judgement["connection"].append(f"{count} connections to the server")
        worst = next((kind for kind in reversed(FAULTS) if judgement.get(kind)), None)
        outcome = row["outcome"]
        if worst is None and row["rss_mb"] * 1e6 > LARGEST_RSS:
            worst = "memory"
        if worst is None or (worst == "promise" and outcome in FAULTS):
            worst = outcome
        broken = [fact for facts in judgement.values() for fact in facts]
        return row | {"broken": broken, "outcome": worst}

    def _last_words(self) -> str:
        return (self.root / "stderr").read_bytes()[-500:].decode(errors="replace")

    def stop(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        self.pipe.close()
        self.server.stop()
        shutil.rmtree(self.root, ignore_errors=True)


def _worst_environment(sandbox: Path) -> dict[str, str]:
    """Of a user who has switched on what he should not have."""
    for name in ("home", "tmp", "case"):
        (sandbox / name).mkdir(parents=True)
    kept = {k: v for k, v in own_environment().items() if "proxy" not in k.lower()}
    return {
        **kept,
        "GDAL_VRT_ENABLE_PYTHON": "YES",
        "PYTHONDONTWRITEBYTECODE": "1",
        "HOME": str(sandbox / "home"),
        "TMPDIR": str(sandbox / "tmp"),
    }


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
                    if workers[index].process.poll() is not None:
                        workers[index].stop()
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
    parser.add_argument("--case", type=int, help="run one case and print it")
    parser.add_argument(
        "--keep", type=Path, help="new folder for the sandbox of --case, as it is afterwards"
    )
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
    with tempfile.TemporaryDirectory(prefix="fuzz") as name:
        worker = Worker.start(Path(name))
        try:
            worker.give(number)
            while (row := worker.poll()) is None:
                time.sleep(_POLL_S)
            if keep is not None:
                shutil.move(worker.root, keep)
        finally:
            worker.stop()
    print(f"{row['name']}\n{row['outcome']}, {row['seconds']:.2f} s: {row['detail']}")
    print("\n".join(row["broken"]))
    return 0
