"""A manifest of very many pairs: ledger, driver and scheduler are real, the pairs only wait.

How long each waits, and what it answers, was recorded from real pairs.  This is a process of its
own, so that its memory is that of a driver: ``python -m benchmarks.batch.large``.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

from geodelreg.batch import Batch
from geodelreg.batch.job import PairResult, Task
from geodelreg.batch.ledger import Ledger
from geodelreg.options import BatchOptions

THREADS = 64
MEAN_WAIT_S = 0.02


class Replay(Executor):
    """Hands a cluster the recorded answer of a pair in place of the pair."""

    def __init__(self, inner: Executor, recorded: list[PairResult]) -> None:
        self._inner = inner
        self._recorded = recorded
        mean = sum(result.duration_s for result in recorded) / len(recorded)
        self._scale = MEAN_WAIT_S / mean

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Let a worker wait as long as the pair took, scaled, and answer."""
        text = args[0]
        task = Task.from_json(text)
        result = self._recorded[task.number % len(self._recorded)]
        seconds = result.duration_s * self._scale
        return self._inner.submit(answer, text, seconds, result.to_json())


def answer(text: str, seconds: float, recorded: str) -> str:
    """What a worker does in place of a pair."""
    task = Task.from_json(text)
    time.sleep(seconds)
    result, pair = PairResult.from_json(recorded), task.pair
    return replace(
        result,
        number=task.number,
        sources=pair.sources,
        reference=pair.reference,
        output=pair.output,
    ).to_json()


def write_manifest(path: Path, count: int) -> None:
    """So many pairs in folders of a thousand; the files need not exist."""
    with path.open("w", encoding="utf-8") as file:
        file.write("ms,pan,out,model,search_radius_px\n")
        for n in range(count):
            scene = f"catalogue/{n // 1000:04d}/LC08_L1TP_{n:09d}_20260101_02_T1"
            model = ("", "shift", "scale")[n % 3]
            file.write(f"{scene}_MS.TIF,{scene}_PAN.TIF,aligned/{scene}.tif,{model},64\n")


def measure(folder: Path, recorded: list[PairResult], count: int) -> dict[str, float]:
    """Plan and run so many pairs; seconds, megabytes and milliseconds a pair."""
    from distributed import Client, LocalCluster

    manifest = folder / "pairs.csv"
    write_manifest(manifest, count)
    size = {"n_workers": 2, "threads_per_worker": THREADS // 2, "memory_limit": 0}
    local: Any = LocalCluster  # Dask has no types
    connect: Any = Client
    with local(dashboard_address=None, **size) as cluster, connect(cluster) as client:
        before_mb = peak_mb()
        executor = Replay(client.get_executor(pure=False), recorded)
        start = time.perf_counter()
        batch = Batch(manifest, executor, options=BatchOptions(workers=4 * THREADS))
        batch.prepare()
        planned = time.perf_counter() - start
        planned_mb = peak_mb()
        start, cpu = time.perf_counter(), time.process_time()
        done = sum(1 for _ in batch)
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    assert done == count
    return {
        "pairs": count,
        "plan_s": planned,
        "run_s": wall,
        "run_cpu_ms_per_pair": 1e3 * cpu / count,
        "before_mb": before_mb,
        "planned_mb": planned_mb,
        "peak_mb": peak_mb(),
        "ledger_mb": batch.path.stat().st_size / 1e6,
        "ledger_ms_per_pair": ledger_ms(batch.path, count),
    }


def ledger_ms(path: Path, count: int) -> float:
    """Milliseconds that the ledger takes for a pair, start and end, once more for all of them."""
    copy = path.with_suffix(".copy")
    shutil.copy(path, copy)
    with Ledger(copy) as ledger:
        results = list(ledger.results(most=10_000))
        ledger.retry(["aligned", "failed", "refused"])
        start = time.perf_counter()
        for result in results:
            ledger.start(result.number)
            assert ledger.finish(result)
        spent = time.perf_counter() - start
    copy.unlink()
    return 1e3 * spent / min(count, len(results))


def peak_mb() -> float:
    """Most memory that this process has held."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split(maxsplit=1)[0]) * 1024 / 1e6


if __name__ == "__main__":
    folder, recorded, count = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    lines = recorded.read_text(encoding="utf-8").splitlines()
    print(json.dumps(measure(folder, [PairResult.from_json(line) for line in lines], count)))
