"""kill -9 of workers, scheduler, children and driver at random times, and what is left."""

from __future__ import annotations

import random
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.batch import cluster as dask

VICTIMS = ("worker", "scheduler", "child", "driver")
LONGEST_S = 3.0


@dataclass
class Tally:
    """What was killed, and what is wrong afterwards."""

    kills: Counter[str] = field(default_factory=Counter)
    rounds: int = 0
    pairs: int = 0
    repeated: int = 0
    wrong: list[str] = field(default_factory=list)


def run_kills(folder: Path, expected: dict[str, bytes], count: int, seed: int) -> Tally:
    """Run the pairs of a folder, again and again, until so many processes were killed.

    Parameters
    ----------
    folder : Path
        With the manifest; what earlier runs have written is removed.
    expected : dict of str to bytes
        Outputs of an undisturbed run.
    count : int
        Kills.
    seed : int
    """
    rng, tally = random.Random(seed), Tally()
    todo = [VICTIMS[n % len(VICTIMS)] for n in range(count)]
    rng.shuffle(todo)
    with dask.running_cluster(folder) as cluster:
        while todo:
            dask.forget(folder)
            _one_round(folder, cluster, rng, todo, tally)
            _judge(folder, expected, tally)
    return tally


def _one_round(
    folder: Path, cluster: dask.Cluster, rng: random.Random, todo: list[str], tally: Tally
) -> None:
    driver = dask.driver(folder, "--resume", "--dask", cluster.address)
    while True:
        end = time.monotonic() + rng.uniform(0.2, LONGEST_S)
        while driver.poll() is None and (not todo or time.monotonic() < end):
            cluster.mend()
            time.sleep(0.05)
        if driver.poll() is None and _kill(todo[-1], cluster, driver.pid, rng):
            tally.kills[todo.pop()] += 1
            if cluster.scheduler.poll() is not None:
                driver.wait()
                cluster.end()
                cluster.start()
        if driver.poll() == 0:
            return
        if driver.poll() is not None:
            driver = dask.driver(folder, "--resume", "--dask", cluster.address)


def _kill(victim: str, cluster: dask.Cluster, driver: int, rng: random.Random) -> bool:
    """Kill one process of a kind; False when none is there yet."""
    pids = {
        "driver": [driver],
        "scheduler": [cluster.scheduler.pid],
        "worker": dask.below(cluster.workers.pid, "spawn_main"),
        "child": dask.below(cluster.workers.pid, "geodelreg.batch.child"),
    }[victim]
    if not pids:
        return False
    pid = rng.choice(pids)
    dask.kill(pid)
    if victim == "scheduler":
        cluster.scheduler.wait()
    elif victim == "driver":
        while Path(f"/proc/{pid}/maps").exists() and Path(f"/proc/{pid}/maps").read_bytes():
            time.sleep(0.01)
    return True


def _judge(folder: Path, expected: dict[str, bytes], tally: Tally) -> None:
    ledger = folder / "pairs.ledger"
    tally.rounds += 1
    tally.pairs += len(expected)
    rows = dask.query(ledger, "SELECT number, outcome FROM outcomes")
    if Counter(row[0] for row in rows) != Counter(range(1, len(expected) + 1)):
        tally.wrong.append("not every pair has one outcome")
    if {row[1] for row in rows} != {"aligned"}:
        tally.wrong.append(f"outcomes {Counter(row[1] for row in rows)}")
    found = dask.outputs(folder)
    if found != expected:
        differing = [n for n in expected if found.get(n) != expected[n]]
        tally.wrong.append(f"outputs differ: {differing or set(found) - set(expected)}")
    tally.wrong += [f"left over: {path}" for path in dask.debris(folder)]
    ((again,),) = dask.query(ledger, "SELECT sum(started - 1) FROM pairs")
    tally.repeated += int(str(again))
