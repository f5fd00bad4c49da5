"""The same batch on executors and on Dask: same bytes, same table, whatever is killed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
from distributed import Client, LocalCluster

import geodelreg.batch
from benchmarks.batch.pairs import write_pairs
from geodelreg.batch import PairResult
from geodelreg.errors import ClusterError, ManifestError
from geodelreg.options import AlignOptions, BatchOptions
from tests.cli.batch_helpers import (
    TIMINGS,
    children_for_pairs,
    debris,
    descendants,
    kill,
    query,
    read_table,
    start,
    wait_until,
)

COUNT = 4
pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a batch that ran on this machine undisturbed, with its table."""
    folder = tmp_path_factory.mktemp("calm")
    manifest = write_pairs(folder, COUNT)
    results = list(geodelreg.batch.run(manifest, tables=[folder / "all.csv"]))
    assert sorted(result.number for result in results) == list(range(1, COUNT + 1))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_pairs(tmp_path / "data", COUNT)
    return tmp_path / "data"


def check_like(calm: Path, folder: Path) -> None:
    """Same outputs, byte by byte, and the same table but for timings."""

    def outputs(of: Path) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (of / "out").iterdir()}

    def table(of: Path) -> list[dict[str, str]]:
        rows = read_table(of / "all.csv", without=TIMINGS)
        return [{k: v.replace(str(of), "") for k, v in row.items()} for row in rows]

    assert outputs(folder) == outputs(calm)
    assert table(folder) == table(calm)
    assert len(table(folder)) == COUNT
    numbers = [row[0] for row in query(folder / "pairs.ledger", "SELECT number FROM outcomes")]
    assert Counter(numbers) == Counter(range(1, COUNT + 1))
    assert debris(folder) == []


def run_all(folder: Path, executor: Any, **settings: Any) -> list[PairResult]:
    tables = [folder / "all.csv"]
    manifest = folder / "pairs.csv"
    return list(geodelreg.batch.run(manifest, executor, tables=tables, **settings))


@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_any_executor_of_concurrent_futures_will_do(calm: Path, folder: Path, kind: str) -> None:
    executor: Executor
    if kind == "threads":
        executor = ThreadPoolExecutor(2)
    else:
        executor = ProcessPoolExecutor(2, mp_context=get_context("spawn"))
    with executor:
        run_all(folder, executor)
    check_like(calm, folder)


def test_a_broken_pool_ends_the_batch_and_the_next_goes_on(calm: Path, folder: Path) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        results = geodelreg.batch.run(folder / "pairs.csv", executor)
        next(results)
        for pid, line in descendants(os.getpid()).items():
            if "spawn_main" in line:
                kill(pid)
        with pytest.raises(ClusterError, match="broken"):
            list(results)
    run_all(folder, None, resume=True)
    check_like(calm, folder)


def test_rows_and_options_in_python(folder: Path) -> None:
    rows = [{"ms": f"ms_{n}.tif", "pan": f"pan_{n}.tif"} for n in (1, 2)]
    absolute = [{key: str(folder / name) for key, name in row.items()} for row in rows]
    absolute[1]["model"] = "shift"
    results = geodelreg.batch.run(
        absolute,
        options=BatchOptions(check=True, workers=1),
        align=AlignOptions(model="scale"),
        ledger=folder / "rows.ledger",
    )
    found = {result.number: result for result in results}
    assert [found[n].outcome for n in (1, 2)] == ["misaligned", "misaligned"]
    assert [found[n].figures["model"] for n in (1, 2)] == ["scale", "shift"]
    distances = [found[n].figures["misalignment_px"] for n in (1, 2)]
    assert all(isinstance(d, float) and 8.0 < d < 10.0 for d in distances)
    with pytest.raises(ManifestError, match="no value for pan") as caught:
        geodelreg.batch.run([{"ms": "a.tif", "out": "b.tif"}], ledger=folder / "bad.ledger")
    assert len(caught.value.problems) == 1
    assert not (folder / "bad.ledger").exists()


def test_workers_that_cannot_start_a_process_end_the_batch_and_fail_no_pair(folder: Path) -> None:
    broken = {"PYTHONHOME": str(folder)}
    results = geodelreg.batch.run(folder / "pairs.csv", config=broken)
    with pytest.raises(ClusterError, match="does not start"):
        list(results)
    ledger = folder / "pairs.ledger"
    assert query(ledger, "SELECT count(*) FROM outcomes") == [(0,)]
    assert debris(folder) == []


@contextmanager
def local_cluster(folder: Path) -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=0,
        local_directory=str(folder),
    ) as cluster:  # fmt: skip
        yield cluster


def worker_pids(client: Client) -> list[int]:
    return list(client.run(os.getpid).values())


def test_two_workers_of_dask_give_the_same_and_a_lost_one_is_replaced(
    calm: Path, folder: Path, tmp_path: Path
) -> None:
    with local_cluster(tmp_path / "dask") as cluster, Client(cluster) as client:
        run_all(folder, client)
        check_like(calm, folder)

        second = tmp_path / "second"
        write_pairs(second, COUNT)
        manifest, tables = second / "pairs.csv", [second / "all.csv"]
        results = geodelreg.batch.run(manifest, client, tables=tables)
        first = next(results)
        busy = [pid for pid in worker_pids(client) if children_for_pairs(pid)]
        os.kill(busy[0], signal.SIGKILL)
        rest = list(results)
        assert sorted(r.number for r in [first, *rest]) == list(range(1, COUNT + 1))
        check_like(calm, second)


def test_a_lost_scheduler_ends_the_command_and_resume_goes_on(
    calm: Path, folder: Path, tmp_path: Path
) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    scheduler = subprocess.Popen(
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"],
        cwd=tmp_path, **quiet,
    )  # fmt: skip
    worker = subprocess.Popen(
        [*dask, "worker", address, "--nworkers", "2", "--nthreads", "1", "--no-dashboard",
         "--local-directory", str(tmp_path)], cwd=tmp_path, **quiet,
    )  # fmt: skip
    try:
        driver = start("batch", "pairs.csv", "--dask", address, "--table", "all.csv", cwd=folder)
        ledger = folder / "pairs.ledger"
        wait_until(
            lambda: ledger.exists() and query(ledger, "SELECT count(*) FROM outcomes")[0][0] >= 1
        )
        scheduler.kill()
        _, stderr = driver.communicate(timeout=120)
        assert driver.returncode == 1
        assert "Dask's scheduler" in stderr or "cluster" in stderr
        assert "--resume" in stderr
        assert "Traceback" not in stderr
    finally:
        below = [*descendants(worker.pid)]
        for pid in (scheduler.pid, worker.pid, *below):
            kill(pid)
        scheduler.wait()
        worker.wait()
    time.sleep(0.5)  # children notice that nobody is left
    run_all(folder, None, resume=True)
    check_like(calm, folder)
