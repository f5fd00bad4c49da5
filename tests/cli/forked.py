"""The command in a process forked from one that holds its libraries: loading them is most of a run.

The process that is forked has opened no file and started no thread; its child runs the command as
``python -m geodelreg_cli`` does, and ends as an interpreter ends.  How a fresh process starts is
what `test_startup` looks at; tests that send signals start one, too.

As a script, ``forked.py SOCKET`` serves, and ``forked.py SOCKET ARGS…`` asks for one command.
"""

import os
import select
import socket
import sys
from pathlib import Path

LIBRARIES = (
    *("cv2", "jinja2", "pyproj", "rasterio.features", "rasterio.shutil", "rasterio.vrt"),
    *("rasterio.warp", "rich.progress", "scipy.interpolate", "scipy.optimize", "scipy.spatial"),
    *("shapely", "matplotlib.figure", "matplotlib.backends.backend_agg"),
    "matplotlib.backends.backend_svg",
)
"""What the command loads when it needs it."""

TIMEOUT_S = 120.0


def ask(address: str, args: list[str], cwd: str, env: dict[str, str], streams: list[int]) -> int:
    """Have one command run and return its exit code, negative for a signal.

    Parameters
    ----------
    address : str
        Of the socket.
    args : list of str
        Of the command, without the program's name.
    cwd : str
    env : dict
    streams : list of int
        Descriptors of its standard input, output and error.
    """
    import json

    with socket.socket(socket.AF_UNIX) as channel:
        channel.settimeout(TIMEOUT_S)
        channel.connect(address)
        socket.send_fds(channel, [b"!"], streams)
        channel.sendall(json.dumps([args, cwd, env]).encode())
        channel.shutdown(socket.SHUT_WR)
        return int(channel.recv(16))


def serve(address: str) -> None:
    """Run one command after the other until standard input ends; return in each that is forked."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{address}.new")
        listener.listen()
        Path(f"{address}.new").rename(address)  # whoever finds it can connect
        _load()
        while listener in select.select([listener, 0], [], [])[0]:
            channel, _ = listener.accept()
            with channel:
                _, streams, _, _ = socket.recv_fds(channel, 1, 3)
                child = os.fork()
                if child == 0:
                    listener.close()
                    _become(channel, streams)
                    return
                for stream in streams:
                    os.close(stream)
                _, status = os.waitpid(child, 0)
                channel.sendall(str(os.waitstatus_to_exitcode(status)).encode())
    os._exit(0)


def _load() -> None:
    import gc
    from importlib import import_module

    for name in LIBRARIES:
        import_module(name)
    for package in ("geodelreg", "geodelreg_cli"):
        (folder,) = import_module(package).__path__
        for path in Path(folder).rglob("[!_]*.py"):
            import_module(".".join((package, *path.relative_to(folder).with_suffix("").parts)))
    gc.freeze()


def _become(channel: socket.socket, streams: list[int]) -> None:
    """Take the streams, the folder, the variables and the arguments of a command."""
    import json

    with channel, channel.makefile("rb") as request:
        args, cwd, env = json.load(request)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    sys.argv[1:] = args


if __name__ == "__main__":
    if len(sys.argv) > 2:
        sys.exit(ask(sys.argv[1], sys.argv[2:], str(Path.cwd()), dict(os.environ), [0, 1, 2]))
    import atexit
    import runpy

    codes: list[int] = []
    # the first to be registered is the last to be called: all is done but to take modules apart
    atexit.register(lambda: os._exit(codes[0]) if codes else None)
    serve(sys.argv[1])
    sys.path[0] = str(Path.cwd())
    try:
        runpy.run_module("geodelreg_cli", run_name="__main__", alter_sys=True)
    except SystemExit as ending:
        if isinstance(ending.code, int):
            codes.append(ending.code)
        raise
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
