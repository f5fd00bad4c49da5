"""An environment for geodelreg alone, made with ``venv`` and ``pip``; no QGIS in here."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from geodelreg_qgis.command import CommandError, ask, check_version, run

_LEAST = (3, 11)
"""Python that geodelreg needs."""
_PROBE = (
    "import importlib.util as u, sys; "
    "print(*sys.version_info[:2], all(map(u.find_spec, ('venv', 'ensurepip'))))"
)


def find_python(setting: str) -> str:
    """A Python that can make the environment.

    Parameters
    ----------
    setting : str
        Path that the user has given; when it is empty, that of QGIS, and those on PATH, are tried.

    Raises
    ------
    CommandError
        When none will do; it says why and what to install.
    """
    if setting:
        candidates: list[str] = [str(Path(setting).expanduser())]
    else:
        names = ("python3", *(f"python3.{minor}" for minor in (14, 13, 12, 11)), "python")
        candidates = [
            str(path)
            for name in ("python3", "python")
            if (path := Path(sys.prefix, "bin", name)).exists()
        ]
        candidates += [found for name in names if (found := shutil.which(name))]
    reasons = []
    for candidate in dict.fromkeys(candidates):
        reason = _unfit(candidate)
        if not reason:
            return candidate
        reasons.append(reason)
    least = ".".join(map(str, _LEAST))
    found = "; ".join(reasons) or "none was found on PATH"
    raise CommandError(
        f"No Python can make the environment: {found}. Install Python {least} or later with venv "
        "and pip (Debian and Ubuntu: sudo apt install python3-venv; Windows and macOS: "
        "python.org), or name one under “Python”."
    )


def _unfit(python: str) -> str:
    """Why a Python will not do; empty when it will."""
    try:
        major, minor, complete = ask(python, "-c", _PROBE).split()
    except (CommandError, ValueError):
        return f"{python} does not work"
    if (int(major), int(minor)) < _LEAST:
        return f"{python} is {major}.{minor}"
    return "" if complete == "True" else f"{python} has no venv and ensurepip"


def bundled_wheel(folder: Path) -> Path:
    """The wheel of geodelreg in the plugin.

    Raises
    ------
    CommandError
        When the plugin was not packed with one.
    """
    wheels = sorted(folder.glob("geodelreg-*.whl"))
    if not wheels:
        raise CommandError(
            f"{folder} holds no wheel of geodelreg. Name a wheel, or a folder with its sources, "
            "under “geodelreg”."
        )
    return wheels[-1]


def make_environment(
    parent: Path,
    python: str,
    package: Path,
    needed: str,
    hear: Callable[[str], None],
    cancelled: Callable[[], bool],
) -> str | None:
    """Make an environment with geodelreg in it, whole or not at all.

    Parameters
    ----------
    parent : Path
        Folder for the environment, which gets a new name each time: one that is in use stays.
    python : str
    package : Path
        Wheel or source folder of geodelreg; its ``report`` extra draws the page.
    needed : str
        Version that the plugin needs.
    hear, cancelled : callable
        As in `geodelreg_qgis.command.run`.

    Returns
    -------
    str or None
        Path of the command; None when the user has cancelled.

    Raises
    ------
    CommandError
    """
    parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="geodelreg-", dir=parent))
    scripts = folder / ("Scripts" if os.name == "nt" else "bin")
    pip = (
        "-m",
        "pip",
        "--disable-pip-version-check",
        "install",
        "--no-input",
        "--progress-bar=off",
    )
    done = False
    try:
        for words in (
            (python, "-m", "venv", str(folder)),
            (str(scripts / "python"), *pip, f"{package}[report]"),
        ):
            finished = run(words, hear, cancelled)
            if finished.code is None:
                return None
            if finished.code:
                said = "\n".join(finished.messages[-10:]) or finished.output.strip()[-2000:]
                raise CommandError(
                    f"{' '.join(words)} failed:\n{said}\nSee that this computer reaches the Python "
                    "Package Index (a proxy is set with HTTPS_PROXY or pip.conf), or install "
                    "geodelreg by hand and name its command in the settings."
                )
        command = str(scripts / "geodelreg")
        check_version(command, needed)
        done = True
        return command
    finally:
        if not done:
            shutil.rmtree(folder, ignore_errors=True)


def drop_environments(parent: Path, kept: str) -> None:
    """Remove the environments below a folder but the one that holds a command."""
    for folder in parent.glob("geodelreg-*"):
        if folder not in Path(kept).parents:
            shutil.rmtree(folder, ignore_errors=True)
