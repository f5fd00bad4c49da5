"""One alignment with defaults, and what came of it."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from affine import Affine

log = logging.getLogger(__name__)


def align_scene(folder: Path) -> tuple[str, str, Affine | None, float]:
    """Align the two rasters of a folder; outcome, model, corrected geotransform, seconds."""
    from geodelreg import align
    from geodelreg.errors import GeodelregError

    started = time.perf_counter()
    try:
        found = align(folder / "ms.tif", folder / "pan.tif")
    except GeodelregError as error:
        return type(error).__name__, "none", None, time.perf_counter() - started
    except Exception as error:
        log.exception("crashed")
        return f"crash: {type(error).__name__}", "none", None, time.perf_counter() - started
    seconds = time.perf_counter() - started
    return found.verdict.outcome.value, found.correction.model, found.correction.corrected, seconds
