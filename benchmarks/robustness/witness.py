"""What a case has done to the machine, seen from outside: files, connections, processes.

Nothing here asks the library: the file system is compared before and after, connections reach a
server of our own, and ``strace`` sees what GDAL does behind Python's back.
"""

from __future__ import annotations

import hashlib
import http.server
import os
import re
import shutil
import stat
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.robustness.hostile.plan import Plan

Snapshot = dict[str, tuple[Any, ...]]
COMMAND = ("-m", "geodelreg_cli")
"""Arguments of Python that make it the command: the one process that a case may start."""

_OPENING = ("open", "openat", "openat2", "creat")
_CHANGING = (
    "unlink", "unlinkat", "rename", "renameat", "renameat2", "link", "linkat", "symlink",
    "symlinkat", "mkdir", "mkdirat", "rmdir", "mknod", "mknodat", "truncate", "chmod", "fchmodat",
    "chown", "lchown", "fchownat", "utimensat", "setxattr", "lsetxattr", "removexattr",
)  # fmt: skip
_SENDING = ("connect", "sendto", "sendmsg", "sendmmsg")
_TRACED = ",".join(["execve", "execveat", *_OPENING, *_CHANGING, *_SENDING])
_HARMLESS = ("/dev/null", "/dev/tty", "/proc/")
_CALL = re.compile(r"(\d+) +(\w+)\((.*)\) += (-?\d+)(?:<(.*)>)?")
_UNFINISHED, _RESUMED = " <unfinished ...>", re.compile(r"(\d+) +<\.\.\. \w+ resumed>(.*)")
_PATH = re.compile(r'(?:(?:AT_FDCWD|\d+)<([^>]*)>, )?"((?:[^"\\]|\\.)*)"')


def snapshot(root: Path) -> Snapshot:
    """Everything below a folder: kind, owner, mode; of files size, time and digest, of links aim.

    Of folders the time is left out: a file that comes and goes again is no change.
    """
    found: Snapshot = {}
    for folder, folders, files in os.walk(root):
        for name in (*folders, *files):
            path = Path(folder, name)
            status = path.lstat()
            entry: tuple[Any, ...] = (status.st_mode, status.st_uid, status.st_gid)
            if stat.S_ISREG(status.st_mode):
                digest = hashlib.sha256(path.read_bytes()).hexdigest()
                entry += (status.st_size, status.st_mtime_ns, status.st_nlink, digest)
            elif stat.S_ISLNK(status.st_mode):
                entry += (str(path.readlink()),)
            found[path.relative_to(root).as_posix()] = entry
    return found


def changes(before: Snapshot, after: Snapshot) -> set[str]:
    """Names of what came, went or is not as it was."""
    return {name for name in before | after if before.get(name) != after.get(name)}


class LoopbackServer:
    """Counts whatever connects to it, and has nothing to give."""

    def __init__(self) -> None:
        self._server = _Counting(("127.0.0.1", 0), _Nothing)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """``http://127.0.0.1:PORT``."""
        return f"http://127.0.0.1:{self._server.server_port}"

    @property
    def count(self) -> int:
        """Connections until now."""
        return self._server.count

    def stop(self) -> None:
        """Close the port."""
        self._server.shutdown()
        self._server.server_close()


class _Counting(http.server.ThreadingHTTPServer):
    daemon_threads = True
    count = 0

    def verify_request(self, request: Any, client_address: Any) -> bool:
        self.count += 1
        return True


class _Nothing(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_error(404)

    do_HEAD = do_POST = do_PUT = do_OPTIONS = do_GET  # noqa: N815

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        pass


@dataclass(slots=True)
class Facts:
    """What the system calls of a case say."""

    connections: list[str] = field(default_factory=list)
    processes: list[str] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    read: set[str] = field(default_factory=set)


class Trace:
    """The system calls of a process and its children, as ``strace`` writes them down.

    Parameters
    ----------
    log : Path
        Does not exist yet.
    """

    def __init__(self, log: Path) -> None:
        self.log = log

    def command(self) -> list[str]:
        """What to put before a command; the process keeps the number that its parent sees.

        Raises
        ------
        SystemExit
            There is no strace.
        """
        strace = shutil.which("strace")
        if strace is None:
            raise SystemExit("benchmarks fuzz needs strace (Debian, Fedora, …: package strace)")
        return [
            strace, "-D", "-f", "--seccomp-bpf", "-qq", "-y", "-A", "-s", "300",
            "-e", "signal=none", "-e", f"trace={_TRACED}", "-o", str(self.log), "--",
        ]  # fmt: skip

    def forget(self) -> None:
        """Start anew: what follows is of the next case."""
        os.truncate(self.log, 0)

    def facts(self, cwd: Path, allowed: Path) -> Facts:
        """What was done since `forget`.

        Parameters
        ----------
        cwd : Path
            Of the process.
        allowed : Path
            Folder in which the snapshot is the judge of what was written.
        """
        facts = Facts()
        text = self.log.read_bytes().decode("utf-8", "surrogateescape")
        for line in _whole_lines(text):
            call = _CALL.match(line)
            if call:
                _, name, args, result, opened = call.groups()
                _add(facts, name, args, int(result), opened or "", (cwd, allowed))
        return facts


def _whole_lines(text: str) -> Iterator[str]:
    """Calls that were interrupted by another thread's are put together."""
    begun: dict[str, str] = {}
    for line in text.splitlines():
        if line.endswith(_UNFINISHED):
            begun[line.split(" ", 1)[0]] = line.removesuffix(_UNFINISHED)
        elif resumed := _RESUMED.match(line):
            yield begun.pop(resumed[1], "") + resumed[2]
        else:
            yield line


def _add(
    facts: Facts, name: str, args: str, result: int, opened: str, places: tuple[Path, Path]
) -> None:
    cwd, allowed = places
    if name in _SENDING:
        if "AF_INET" in args:
            facts.connections.append(f"{name}({args})")
    elif result < 0:
        return
    elif name.startswith("execve"):
        if not args.startswith(_own_command()):
            facts.processes.append(args[:200])
    elif name in _OPENING and not re.search(r"O_(WRONLY|RDWR|CREAT|TRUNC)", args):
        facts.read.add(_unescaped(opened))
    else:
        paths = [opened] if name in _OPENING else list(_paths(args, cwd))
        for path in map(_unescaped, paths):
            if not (path.startswith(_HARMLESS) or Path(path).is_relative_to(allowed)):
                facts.written.append(f"{name} {path}")


def _own_command() -> str:
    return ", ".join([f'"{sys.executable}"', f'["{sys.executable}"', *(f'"{a}"' for a in COMMAND)])


def _paths(args: str, cwd: Path) -> Iterator[str]:
    for folder, name in _PATH.findall(args):
        path = Path(folder or cwd, _unescaped(name))
        yield str(Path(os.path.realpath(path.parent)) / path.name)


def _unescaped(text: str) -> str:
    if "\\" not in text:
        return text
    return os.fsdecode(os.fsencode(text).decode("unicode_escape").encode("latin-1"))


def judge(
    row: dict[str, Any], plan: Plan | None, before: Snapshot, sandbox: Path, facts: Facts
) -> dict[str, list[str]]:
    """Faults of a case, by kind.

    Parameters
    ----------
    row : dict
        What the worker says.
    plan : Plan, optional
        Of a hostile case. A mutated one watches its own folder, ``case``.
    before : Snapshot
        Of the sandbox.
    sandbox : Path
    facts : Facts
    """
    changed = changes(before, snapshot(sandbox))
    if row["outcome"] in ("crash", "hang"):  # a private folder of ours is for the next run
        changed = {name for name in changed if ".geodelreg" not in name}
    own = {f"case/{os.path.normpath(name)}" for name in plan.outputs} if plan else set()
    foreign = {
        name
        for name in changed - own
        if not name.startswith("tmp/") and (plan or not name.startswith("case/"))
    }
    promises = list(row["broken"])
    if plan and row["outcome"] == "error" and "AlignmentRefusedError" not in row["detail"]:
        promises += [f"changed on error: {name}" for name in sorted(changed & own)]
    if plan and row["outcome"] == "ok":
        secrets = {path for path in facts.read if path.startswith(f"{sandbox}/victims/secret")}
        promises += [f"read {path}, which nobody has named" for path in sorted(secrets)]
    return {
        "promise": promises,
        "connection": facts.connections,
        "process": facts.processes,
        "foreign write": [f"changed: {name}" for name in sorted(foreign)] + facts.written,
    }
