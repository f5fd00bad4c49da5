"""The part of ``check.py`` that runs inside QGIS: ``python3 in_qgis FOLDER``.

FOLDER holds three pairs.  A line is printed for each thing that works.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from applied import applied, applied_in_place, not_applied
from qgis.core import (
    QgsApplication,
)
from results import align, bands_and_masks, batch_algorithm, batch_mode, loaded, looked_only, model
from stops import cancel, cancel_batch, commands, refusals


def main(folder: Path) -> None:
    """Try everything in a QGIS without windows."""
    application = QgsApplication([], True)
    application.initQgis()
    import processing
    from processing.core.Processing import Processing

    Processing.initialize()
    from geodelreg_qgis.plugin import Plugin

    assert processing
    plugin = Plugin(None)
    plugin.initProcessing()
    for step in (
        *(align, looked_only, bands_and_masks, loaded, model, batch_mode, batch_algorithm),
        *(applied, applied_in_place, not_applied),
        *(refusals, commands, cancel, cancel_batch),
    ):
        step(folder)
    plugin.unload()
    sys.stdout.flush()
    os._exit(0)  # QGIS 3.22 may crash while Python takes it down


if __name__ == "__main__":
    main(Path(sys.argv[1]))
