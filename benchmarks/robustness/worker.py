"""A warm process that runs fuzz cases; `benchmarks.robustness.fuzz` starts it."""

from __future__ import annotations

import os
import resource
import sys
from multiprocessing.connection import Connection
from pathlib import Path

from benchmarks.records import Row
from benchmarks.robustness.fuzz_cases import check_message, ended, run_case, seeds
from benchmarks.robustness.hostile.doing import HungError, crs_of, do, is_same_crs
from benchmarks.robustness.hostile.plan import Plan

_ADDRESS_SPACE = 12_000_000_000
"""Beyond this an allocation fails, before the machine suffers."""


def serve(pipe: Connection, folder: Path) -> None:
    """Run the cases that arrive, numbers or plans, in `folder`, which is made anew for each."""
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for is_pan in (False, True):
        seeds(is_pan, 80)
    pipe.send(None)
    while (case := pipe.recv()) is not None:
        Path("/proc/self/clear_refs").write_text("5")  # forgets the peak of memory
        row = run_plan(case, folder) if isinstance(case, Plan) else run_case(case, folder)
        pipe.send(row | {"rss_mb": _peak() / 1e6})


def run_plan(plan: Plan, folder: Path) -> Row:
    """Run one hostile case, whose files are in `folder`; others judge what it does there."""
    here, environment, broken = Path.cwd(), dict(os.environ), list[str]()
    os.chdir(folder)
    crs = crs_of(plan.ms) if plan.is_about_crs else None
    try:
        row, error = ended(lambda: do(plan))
        written = plan.ms if plan.action == "inplace" else plan.target
        if plan.is_about_crs and row["outcome"] == "ok" and not is_same_crs(crs, crs_of(written)):
            broken.append("the CRS was lost or altered")
    finally:
        os.chdir(here)
        os.environ.clear()
        os.environ.update(environment)  # what the command sets for itself
    if error is not None:
        check_message(error, broken)
    if error is not None and plan.must_work:
        broken.append("an honest input was refused")
    if HungError.__name__ in row["detail"]:
        row["outcome"] = "hang"
    return row | {"number": plan.number, "name": plan.name, "broken": broken}


def _peak() -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


if __name__ == "__main__":
    serve(Connection(int(sys.argv[1])), Path(sys.argv[2]))
