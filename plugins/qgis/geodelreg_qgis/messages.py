"""What geodelreg says on stderr, sorted for QGIS's log.  Nothing here imports QGIS."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_LINE = re.compile(r"geodelreg: (?:(?P<warning>warning: .*)|(?P<step>[\w ]+), (?P<percent>\d+) %)")
_PAIR = re.compile(r"\d+ .*: (aligned|already_aligned|misaligned|cannot_tell|refused|failed)\b.*")
_ENDING = re.compile(r"(?:geodelreg: )?((?:internal )?error|refused): (.*)", re.IGNORECASE)


@dataclass(frozen=True)
class Message:
    """One line.

    Attributes
    ----------
    text : str
    kind : str
        ``warning``, ``step``, ``pair`` (one of a batch has ended) or ``info``.
    percent : int
        Of a step: how far the run is.
    """

    text: str
    kind: str = "info"
    percent: int = 0


def sort_line(line: str) -> Message:
    """What a line is."""
    found = _LINE.fullmatch(line)
    if found is None:
        return Message(line, "pair" if _PAIR.fullmatch(line) else "info")
    if found["warning"]:
        return Message(found["warning"].capitalize(), "warning")
    return Message(found["step"], "step", int(found["percent"]))


def reason(lines: Sequence[str]) -> str:
    """Why a run has failed: the error and what helps, or all that was said."""
    for number, line in enumerate(lines):
        found = _ENDING.fullmatch(line)
        if found:
            kind = "Refused: " if found[1].lower() == "refused" else ""
            rest = [more.strip() for more in lines[number + 1 :] if more.startswith("  ")]
            return "\n".join([f"{kind}{found[2]}", *rest])
    return "\n".join(lines) or "geodelreg ended without a word."
