"""What the masks of the two images did, for reports and messages."""

from __future__ import annotations

import logging
from pathlib import PurePath

from geodelreg.errors import NoDataError
from geodelreg.masking import MaskUse
from geodelreg.raster.reader import RasterReader

logger = logging.getLogger(__name__)

_MUCH = 0.5


def mask_uses(ms: RasterReader, pan: RasterReader) -> tuple[MaskUse, ...]:
    """Every mask of MS, then of PAN."""
    readers = (("source", ms), ("reference", pan))
    uses = [use for name, reader in readers if reader.masks for use in reader.masks.uses(name)]
    for use in uses:
        share = f"{100 * use.hidden_share:.1f} %"
        logger.info("mask %s, read as %s, hides %s of the %s", use.path, use.kind, share, use.image)
    return tuple(uses)


def mask_warnings(ms: RasterReader, pan: RasterReader) -> tuple[str, ...]:
    """What about the masks may not be what the user wants."""
    return tuple(note for reader in (ms, pan) if reader.masks for note in reader.masks.warnings())


def much_hidden(ms: RasterReader, pan: RasterReader) -> list[str]:
    """One sentence for each image that masks hide for the greater part."""
    return [
        f"masks hide {100 * reader.masks.hidden_share:.0f} % of {reader.name}"
        for reader in (ms, pan)
        if reader.masks and reader.masks.hidden_share > _MUCH
    ]


def under_masks(error: NoDataError, ms: RasterReader, pan: RasterReader) -> NoDataError:
    """The same error, naming the masks where they hide the greater part of an image."""
    if not much_hidden(ms, pan):
        return error
    readers = [reader.masks for reader in (ms, pan) if reader.masks]
    uses = [use for masks in readers for use in masks.uses("") if use.hidden_share > 0]
    hidden = ", ".join(
        f"{100 * use.hidden_share:.0f} % by {PurePath(use.path).name} ({use.kind})" for use in uses
    )
    return NoDataError(
        f"{error.cause}: masks hide {hidden}",
        "Drop the mask, or say which of its values hide, e.g. FILE=3,8-10.",
    )
