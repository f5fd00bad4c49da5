"""Many pairs: a manifest, a ledger that forgets nothing, and workers on one machine or many."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from geodelreg.batch.driver import Batch, ledger_path, run
    from geodelreg.batch.job import PairResult

__all__ = ["Batch", "PairResult", "ledger_path", "run"]

_HOMES = {
    "Batch": "geodelreg.batch.driver",
    "PairResult": "geodelreg.batch.job",
    "ledger_path": "geodelreg.batch.driver",
    "run": "geodelreg.batch.driver",
}


def __getattr__(name: str) -> Any:
    """Load a public name on first use (PEP 562)."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
