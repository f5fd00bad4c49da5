"""The fuzzer's witness sees what a case does, also what no hook in Python would."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.error import HTTPError

import pytest

from benchmarks.robustness.hostile.families import is_hostile, prepare
from benchmarks.robustness.witness import Facts, LoopbackServer, Trace, changes, snapshot

needs_strace = pytest.mark.skipif(shutil.which("strace") is None, reason="runs strace")


@pytest.fixture
def server() -> Iterator[LoopbackServer]:
    one = LoopbackServer()
    yield one
    one.stop()


def facts_of(folder: Path, code: str) -> Facts:
    """Of a program whose folder ``allowed`` is its own."""
    (folder / "allowed").mkdir()
    trace = Trace(folder / "log")
    subprocess.run(
        [*trace.command(), sys.executable, "-c", code], cwd=folder / "allowed", check=True
    )
    return trace.facts(folder / "allowed", folder / "allowed")


@needs_strace
@pytest.mark.parametrize(
    ("code", "aim"),
    [
        ("open('../new', 'w')", "new"),
        ("open('../old', 'a')", "old"),
        ("open('../old', 'r+')", "old"),
        ("import os; os.unlink('../old')", "old"),
        ("import os; os.rename('../old', 'mine')", "old"),
        ("import os; os.mkdir('../é')", "é"),
        ("import os; os.chmod('../old', 0o600)", "old"),
        ("import os; os.symlink('x', '../link')", "link"),
    ],
)
def test_a_write_elsewhere_is_seen(tmp_path: Path, code: str, aim: str) -> None:
    (tmp_path / "old").touch()
    written = facts_of(tmp_path, code).written
    assert [line.partition(" ")[2] for line in written] == [str(tmp_path / aim)]


@needs_strace
def test_names_of_any_bytes_are_seen(tmp_path: Path) -> None:
    facts = facts_of(tmp_path, "import os; open(b'../x\\xff\\xc3\\xa9', 'w')")
    assert any(name.endswith("x\udcff\u00e9") for name in facts.written)


@needs_strace
def test_what_is_allowed_is_no_fact(tmp_path: Path) -> None:
    code = "import os; open('a', 'w'); os.rename('a', 'b'); os.unlink('b'); open(os.devnull, 'w')"
    facts = facts_of(tmp_path, code)
    assert facts.written == []
    assert facts.connections == []
    assert len(facts.processes) == 1  # the program itself


@needs_strace
def test_connections_are_seen_also_failed_ones(tmp_path: Path) -> None:
    code = "import socket; socket.socket().connect_ex(('127.0.0.1', 9))"
    assert "127.0.0.1" in facts_of(tmp_path, code).connections[0]


@needs_strace
def test_processes_are_seen_but_not_the_command_itself(tmp_path: Path) -> None:
    code = (
        "import subprocess, sys; subprocess.run([sys.executable, '-c', '1']);"
        "subprocess.run([sys.executable, '-m', 'geodelreg_cli', '--version'])"
    )
    started = facts_of(tmp_path, code).processes
    assert len(started) == 2
    assert not any("geodelreg_cli" in one.partition("[")[2][:200] for one in started[1:])


@needs_strace
def test_threads_that_interrupt_each_other_are_told_apart(tmp_path: Path) -> None:
    code = (
        "from threading import Thread\n"
        "def work(n):\n    for i in range(40): open(f'../{n}-{i}', 'w').close()\n"
        "threads = [Thread(target=work, args=(n,)) for n in range(4)]\n"
        "for t in threads: t.start()\nfor t in threads: t.join()"
    )
    written = facts_of(tmp_path, code).written
    expected = {f"openat {tmp_path}/{n}-{i}" for n in range(4) for i in range(40)}
    assert set(written) == expected


def test_the_server_counts_and_gives_nothing(server: LoopbackServer) -> None:
    with pytest.raises(HTTPError, match="404"):
        urllib.request.urlopen(f"{server.address}/a.tif")
    assert server.count == 1


def test_a_snapshot_shows_every_kind_of_change(tmp_path: Path) -> None:
    names = ("content", "time", "mode", "link", "gone", "linked", "same")
    for name in names:
        (tmp_path / name).write_text(name)
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("content")
    before = snapshot(tmp_path)
    status = (tmp_path / "content").stat()
    (tmp_path / "content").write_text("CONTENT")
    os.utime(tmp_path / "content", ns=(status.st_atime_ns, status.st_mtime_ns))
    os.utime(tmp_path / "time", (0, 0))
    (tmp_path / "mode").chmod(0o600)
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("time")
    (tmp_path / "gone").unlink()
    (tmp_path / "hard").hardlink_to(tmp_path / "linked")
    (tmp_path / "folder").mkdir()
    changed = changes(before, snapshot(tmp_path))
    assert changed == {"content", "time", "mode", "link", "gone", "linked", "hard", "folder"}


def test_a_case_is_its_number(tmp_path: Path) -> None:
    """The same files and the same question in every run."""
    for number in range(3, 163, 4):
        assert is_hostile(number)
        made = []
        for _ in range(2):
            plan = prepare(number, tmp_path / "sandbox", "http://127.0.0.1:1")
            untimed = {
                name: entry[:4] + entry[5:]
                for name, entry in snapshot(tmp_path / "sandbox").items()
            }
            made.append((plan, untimed))
        assert made[0] == made[1]


def test_a_quarter_is_hostile_and_some_use_the_command(tmp_path: Path) -> None:
    hostile = [number for number in range(20_000) if is_hostile(number)]
    assert len(hostile) == 5000
    plans = [prepare(n, tmp_path / "sandbox", "http://127.0.0.1:1") for n in hostile[:80]]
    assert sum(plan.by_command for plan in plans) == 2
    assert len({plan.family for plan in plans}) == 8
