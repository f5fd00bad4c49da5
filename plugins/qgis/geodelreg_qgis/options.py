"""The options of geodelreg's commands in the plugin, and the command lines made of them.

The options are described in ``commands.json``, which is made of the command line's own description
when the plugin is packed (``plugins/qgis/pack.py``).  Nothing here imports QGIS.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_COMMON = {
    "model": "Model of the correction",
    "on_local": "Where one affine is not enough",
    "warp": "Resample onto a north-up grid",
    "limit_px": "Misalignment that still counts as aligned",
    "per_band": "Also tell of each band by itself",
    "check": "Verdicts only, write no rasters",
    "resume": "Go on with an existing ledger",
    "no_align": "Do not align first",
}
"""Options that are offered at first sight, and their labels; the others are folded."""


@dataclass(frozen=True)
class Option:
    """One option of a command.

    Attributes
    ----------
    name : str
        As in Python: ``search_radius_px``.
    flag : str
        As on the command line: ``--search-radius``.
    kind : str
        ``flag``, ``choice``, ``choices``, ``integer``, ``number``, ``text`` or ``texts``.
    default
        None when it has none.
    unit : str
        As in the help of the command, or empty.
    choices : tuple of str
    help : str
    """

    name: str
    flag: str
    kind: str
    default: Any
    unit: str
    choices: tuple[str, ...]
    help: str

    @property
    def label(self) -> str:
        """What the dialog calls it: for the folded ones, the flag in words."""
        words = _COMMON.get(self.name, self.flag.lstrip("-").replace("-", " "))
        return f"{words[0].upper()}{words[1:]}" + (f" [{self.unit.lower()}]" if self.unit else "")

    @property
    def advanced(self) -> bool:
        """Whether it is folded away."""
        return self.name not in _COMMON


@dataclass(frozen=True)
class Command:
    """One command of geodelreg."""

    name: str
    summary: str
    options: tuple[Option, ...] = field(default=())

    def arguments(self, values: Mapping[str, Any]) -> list[str]:
        """Words of a command line for the options that differ from their defaults.

        Parameters
        ----------
        values : mapping
            Of option names to values; None, and names that are missing, mean the default.
        """
        words: list[str] = []
        for option in self.options:
            value = values.get(option.name)
            if value is None or value == option.default:
                continue
            if option.kind == "flag":
                words += [option.flag] if value else []
            elif option.kind in ("texts", "choices"):
                words += [word for item in value if item for word in (option.flag, item)]
            elif value != "":
                words += [option.flag, str(value)]
        return words


@dataclass(frozen=True)
class Commands:
    """All commands that the plugin knows, and the version of geodelreg that they are of."""

    version: str
    by_name: Mapping[str, Command]


def load_commands(path: Path) -> Commands:
    """Read ``commands.json``."""
    described = json.loads(path.read_text(encoding="utf-8"))
    commands = {
        name: Command(
            name,
            command["summary"],
            tuple(
                Option(**{**option, "choices": tuple(option["choices"])})
                for option in command["options"]
            ),
        )
        for name, command in described["commands"].items()
    }
    return Commands(described["version"], commands)
