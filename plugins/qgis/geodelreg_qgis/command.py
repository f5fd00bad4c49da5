"""The ``geodelreg`` command: where it is, how it is run, how it is ended.

QGIS has a GDAL of its own, so geodelreg runs in a process and an environment of its own.  Nothing
here imports QGIS.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

# What QGIS sets for its own Python, PROJ and GDAL; they would lead the child to the wrong files.
_OF_QGIS = re.compile(r"(PYTHON|PROJ_|GDAL_|OGR_|CPL_|GEOTIFF_CSV)")
_QUESTION_S = 60.0
"""A slow disk may need long to start Python; a command that answers later is none."""
_GRACE_S = 1.5
"""Time to take back what is half written; within two seconds the user wants to go on."""
_POLL_S = 0.05
_NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # else Windows shows a console
_INSTALL = (
    "Run “Install geodelreg” in the Processing toolbox, or name the command in Settings ▸ Options "
    "▸ Processing ▸ Providers ▸ geodelreg."
)


class CommandError(Exception):
    """The command is missing, too old, or no geodelreg; the message says what to do."""


@dataclass(frozen=True)
class Finished:
    """How a run ended.

    Attributes
    ----------
    code : int or None
        Exit code; None when the user cancelled.
    output : str
        What it printed on stdout.
    messages : tuple of str
        Lines that it printed on stderr.
    """

    code: int | None
    output: str
    messages: tuple[str, ...]


def find_command(setting: str) -> str:
    """Path of the command.

    Parameters
    ----------
    setting : str
        Path that the user has set; when it is empty, the command is looked for on PATH.

    Raises
    ------
    CommandError
        When there is none.
    """
    found = shutil.which(Path(setting).expanduser() if setting else "geodelreg")
    if found is None:
        where = f"at {setting}" if setting else "on PATH"
        raise CommandError(f"There is no geodelreg command {where}. {_INSTALL}")
    return str(found)


def clean_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Environment of the child: that of QGIS without what points to QGIS's own libraries.

    Messages come as UTF-8, whatever the locale.
    """
    kept = {name: value for name, value in environment.items() if not _OF_QGIS.match(name.upper())}
    return kept | {"PYTHONUTF8": "1"}


def ask(command: str, *arguments: str) -> str:
    """What a command prints about itself.

    Raises
    ------
    CommandError
        When it cannot be run, or fails.
    """
    try:
        done = subprocess.run(
            [command, *arguments],
            capture_output=True,
            stdin=subprocess.DEVNULL,
            encoding="utf-8",
            errors="replace",
            env=clean_environment(os.environ),
            timeout=_QUESTION_S,
            check=True,
            creationflags=_NO_WINDOW,
        )
    except subprocess.CalledProcessError as error:
        raise CommandError(
            f"{command} does not work: {error.stderr.strip()}. {_INSTALL}"
        ) from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CommandError(f"{command} cannot be run: {error}. {_INSTALL}") from error
    return done.stdout


def commands_of(command: str) -> frozenset[str]:
    """Names of the subcommands that a geodelreg command lists in its help."""
    listed = ask(command, "--help").partition("Commands:\n")[2].partition("\n\n")[0]
    return frozenset(re.findall(r"^  ([a-z][\w-]*)", listed, re.M))


def check_version(command: str, needed: str) -> str:
    """Version of a command, at least the one that the plugin is made for.

    Raises
    ------
    CommandError
        When it is older, or no geodelreg.
    """
    answer = ask(command, "--version")
    found = re.fullmatch(r"geodelreg (\d+(?:\.\d+)*)\S*", answer.strip())
    if found is None:
        raise CommandError(
            f"{command} is not geodelreg: it calls itself {answer.strip()!r}. {_INSTALL}"
        )
    if _numbers(found[1]) < _numbers(needed):
        raise CommandError(
            f"{command} is geodelreg {found[1]}, and this plugin needs {needed} or later. Update "
            f"it where it is installed. {_INSTALL}"
        )
    return found[1]


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".")]


def run(
    arguments: Sequence[str], hear: Callable[[str], None], cancelled: Callable[[], bool]
) -> Finished:
    """Run a command to its end, or end it when the user cancels.

    What it prints goes through files: a pipe that nobody reads would stop it, and its own children
    would keep a pipe open.  They and its temporary files are gone afterwards.

    Parameters
    ----------
    arguments : sequence of str
        The command first.
    hear : callable
        Called with each line of stderr, in this thread.
    cancelled : callable
        Asked many times a second; the command is then told to clean up and go, and if it does not,
        ended.

    Raises
    ------
    CommandError
        When it cannot be started.
    """
    heard: list[str] = []
    with tempfile.TemporaryDirectory(prefix="geodelreg-") as folder:
        output, errors = Path(folder, "stdout"), Path(folder, "stderr")
        environment = clean_environment(os.environ)
        environment.update(dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder))
        with output.open("wb") as out, errors.open("wb") as err:
            try:
                process = subprocess.Popen(
                    list(arguments),
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    env=environment,
                    creationflags=_NO_WINDOW,
                )
            except OSError as error:
                raise CommandError(f"{arguments[0]} cannot be run: {error}. {_INSTALL}") from error
        with errors.open("rb") as said:
            begun = b""
            while True:
                ended = process.poll() is not None
                *lines, begun = (begun + said.read()).split(b"\n")
                for line in lines:
                    heard.append(line.decode("utf-8", "replace").rstrip("\r"))
                    hear(heard[-1])
                if ended:
                    break
                if cancelled():
                    _end(process)
                    return Finished(None, "", tuple(heard))
                time.sleep(_POLL_S)
        text = output.read_text(encoding="utf-8", errors="replace")
    return Finished(process.returncode, text, tuple(heard))


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
