"""geodelreg in QGIS: a Processing provider that runs the ``geodelreg`` command.

QGIS loads the plugin through `classFactory`.  What needs no QGIS (`command`, `environment`,
`messages`, `options`, `sources`, `tie_points`) imports none.
"""

from __future__ import annotations

from typing import Any


def classFactory(iface: Any) -> Any:
    """Make the plugin; `iface` is None in ``qgis_process``."""
    from geodelreg_qgis.plugin import Plugin

    return Plugin(iface)
