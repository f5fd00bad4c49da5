"""One pair aligned, and what came of it, whatever that was."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geodelreg import Alignment

log = logging.getLogger(__name__)


def outcome_of(ms: Path, pan: Path) -> tuple[str, Alignment | None]:
    """Align two files in one thread.

    Returns
    -------
    outcome : str
        The verdict's, or the class of the error; ``crash: …`` of one that is none of ours.
    alignment : Alignment or None
        Also of a refusal, as far as it is known.
    """
    from geodelreg import align
    from geodelreg.errors import AlignmentRefusedError, GeodelregError
    from geodelreg.options import AlignOptions

    try:
        alignment = align(ms, pan, AlignOptions(threads=1))
    except AlignmentRefusedError as error:
        return "refused", error.alignment
    except GeodelregError as error:
        return type(error).__name__, None
    except Exception as error:
        log.exception("crashed")
        return f"crash: {type(error).__name__}: {error}", None
    return alignment.verdict.outcome.value, alignment
