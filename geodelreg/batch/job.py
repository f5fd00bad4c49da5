"""What is asked for a pair, and what became of it; both travel as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

ALIGN, IN_PLACE, CHECK = "align", "in_place", "check"

ALIGNED, ALREADY_ALIGNED, REFUSED, FAILED = "aligned", "already_aligned", "refused", "failed"
MISALIGNED, CANNOT_TELL = "misaligned", "cannot_tell"
OUTCOMES = (ALIGNED, ALREADY_ALIGNED, MISALIGNED, REFUSED, CANNOT_TELL, FAILED)

_COMPACT = (",", ":")


@dataclass(frozen=True, slots=True)
class Pair:
    """One row of a manifest, checked; all paths of files are absolute.

    Attributes
    ----------
    sources : tuple of str
        MS file, or one file per band.
    reference : str
        PAN.
    output : str
        File, or folder with several MS files; empty when none is written.
    align, write : dict
        Options of `AlignOptions` and `WriteOptions` that differ from the defaults.
    """

    sources: tuple[str, ...]
    reference: str
    output: str = ""
    align: Mapping[str, Any] = field(default_factory=dict)
    write: Mapping[str, Any] = field(default_factory=dict)

    @property
    def targets(self) -> list[Path]:
        """Files that are written."""
        if not self.output:
            return []
        if len(self.sources) == 1:
            return [Path(self.output)]
        return [Path(self.output, Path(source).name) for source in self.sources]

    def to_json(self) -> str:
        """The same text for equal pairs."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return json.dumps(values, sort_keys=True, separators=_COMPACT, ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str) -> Pair:
        """Back from `to_json`."""
        return cls(**_with_tuples(json.loads(text)))


@dataclass(frozen=True, slots=True)
class Task:
    """A pair on its way to a worker.

    Attributes
    ----------
    number : int
        Of the pair in the manifest, from 1.
    pair : Pair
    mode : str
        ``align``, ``in_place`` or ``check``.
    limit_px, timeout_s, memory_mb
        As in `BatchOptions`.
    environment : dict of str to str
        Variables of the process that runs the pair, beside those of the worker.
    version : str
        Of the geodelreg that planned it.
    page : str
        Where the page to look at goes; empty when none is made.
    """

    number: int
    pair: Pair
    mode: str
    limit_px: float
    timeout_s: float | None
    memory_mb: int | None
    environment: Mapping[str, str]
    version: str
    page: str = ""

    def to_json(self) -> str:
        """One line of text."""
        return json.dumps(asdict(self), separators=_COMPACT)

    @classmethod
    def from_json(cls, text: str) -> Task:
        """Back from `to_json`."""
        values = json.loads(text)
        return cls(**values | {"pair": Pair(**_with_tuples(values["pair"]))})


@dataclass(frozen=True, slots=True)
class PairResult:
    """What became of a pair.

    Attributes
    ----------
    number : int
        Of the pair in the manifest, from 1.
    sources, reference, output
        As in `Pair`.
    outcome : str
        ``aligned``, ``already_aligned``, ``refused`` or ``failed``; of a check ``aligned``,
        ``misaligned``, ``cannot_tell`` or ``failed``.
    error : str
        Class of the error of a pair that failed; else empty.
    reason : str
        Why it was refused or failed, or what a check has to add.
    warnings : tuple of str
    figures : dict of str to float, str or None
        `FIGURES`; None = not known.
    footprint : dict or None
        GeoJSON geometry in longitude and latitude (WGS 84) of MS, corrected where it was.
    duration_s : float
        Of the pair itself.
    attempts : int
        Processes that were given it, the last of which ended it.
    host : str
        Machine that ran it.
    """

    number: int
    sources: tuple[str, ...]
    reference: str
    output: str
    outcome: str
    error: str = ""
    reason: str = ""
    warnings: tuple[str, ...] = ()
    figures: Mapping[str, float | str | None] = field(default_factory=dict)
    footprint: Mapping[str, Any] | None = None
    duration_s: float = 0.0
    attempts: int = 1
    host: str = ""

    @classmethod
    def of(cls, number: int, pair: Pair, outcome: str, **more: Any) -> PairResult:
        """That a pair has ended so; `more` are the other fields."""
        return cls(number, pair.sources, pair.reference, pair.output, outcome, **more)

    def to_json(self) -> str:
        """One line of text."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return json.dumps(values, separators=_COMPACT, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> PairResult:
        """Back from `to_json`."""
        return cls(**_with_tuples(json.loads(text)))


def _with_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Fields as they were before they were JSON."""
    return {name: tuple(one) if isinstance(one, list) else one for name, one in values.items()}


FIGURES = (
    "model",
    "offset_px",
    "offset_m",
    "before_rmse_px",
    "uncertainty_px",
    "residual_rms_px",
    "check_rmse_px",
    "check_rmse_m",
    "check_ce90_px",
    "sigma_corner_px",
    "coverage",
    "tie_points",
    "misalignment_px",
    "misalignment_m",
    "misalignment_sigma_px",
)
"""How far MS was off at its centre, the accuracy, and what a check measures."""
