"""Ctrl-C and SIGTERM: exit 130 and 143, one line on stderr, no debris."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli.helpers import COMMAND, snapshot

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="needs /proc to see that handlers are set"
)

HOLD_A_TEMPORARY = """
import os, signal, sys, tempfile, time, weakref
import click
class Watched: pass
# what a background job or nohup ignores ends the process again
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGTERM, signal.SIG_DFL)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
import geodelreg_cli.main as main

@main.cli.command()
@click.argument("folder")
def hold(folder):
    with tempfile.TemporaryDirectory(dir=folder):
        print("ready", flush=True)
        if len(sys.argv) > 2:
            weakref.finalize(Watched(), os.kill, os.getpid(), int(sys.argv[2]))
        time.sleep(60)

main.COMMANDS["hold"] = ("__main__", "")
sys.exit(main.run(["hold", sys.argv[1]]))
"""


def wait_for_handler(process: subprocess.Popen[str], number: int) -> None:
    """Return when the process catches a signal itself."""
    for _ in range(1000):
        status = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii")
        caught = int(status.partition("SigCgt:")[2].split()[0], 16)
        if caught >> (number - 1) & 1:
            return
        time.sleep(0.005)
    raise AssertionError(f"no handler for signal {number}")


@pytest.mark.parametrize(
    ("number", "code", "message"),
    [
        (signal.SIGINT, 130, "interrupted"),
        (signal.SIGTERM, 143, "terminated"),
        (signal.SIGHUP, 129, "terminated"),
    ],
)
def test_a_signal_in_mid_work_removes_temporaries(
    tmp_path: Path, number: signal.Signals, code: int, message: str
) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD_A_TEMPORARY, str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    assert len(list(tmp_path.iterdir())) == 1
    process.send_signal(number)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == code
    assert stderr.strip() == f"geodelreg: {message}"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_that_meets_a_callback_is_not_lost(
    tmp_path: Path, number: signal.Signals, code: int
) -> None:
    """Python drops what a weak reference's callback raises: the process would run on."""
    process = subprocess.run(
        [sys.executable, "-c", HOLD_A_TEMPORARY, str(tmp_path), str(int(number))],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert process.returncode == code
    assert "Traceback" not in process.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("delay_s", [0.0, 0.5, 1.0, 1.5])
def test_align_is_terminated_or_done_never_between(pair: Path, delay_s: float) -> None:
    before = snapshot(pair)
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "geodelreg_cli",
            "align",
            "ms.tif",
            "pan.tif",
            "-o",
            "out.tif",
            "-q",
        ],
        cwd=pair,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for_handler(process, signal.SIGTERM)
    time.sleep(delay_s)
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=60)
    after = snapshot(pair)
    assert {name: after[name] for name in before} == before
    assert "Traceback" not in stderr
    if process.returncode in (143, -signal.SIGTERM):  # the latter while the interpreter exits
        assert set(after) <= {*before, "out.tif"}
    else:
        assert process.returncode == 0
        assert set(after) == {*before, "out.tif"}


def test_a_closed_pipe_is_no_error_message() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    process = subprocess.run(
        [*COMMAND, "align", "--help"],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(writer)
    assert process.stderr == ""
