"""The plugin: registers the provider, and puts the installation into the menu."""

from __future__ import annotations

from typing import Any

import processing
from qgis.core import QgsApplication
from qgis.PyQt.QtWidgets import QAction

from geodelreg_qgis.provider import Provider

_MENU = "geodelreg"


class Plugin:
    """What QGIS loads and unloads."""

    def __init__(self, iface: Any) -> None:
        self._iface = iface
        self._provider: Provider | None = None
        self._action: QAction | None = None

    def initProcessing(self) -> None:
        """Register the provider; all that ``qgis_process`` asks for."""
        self._provider = Provider()
        QgsApplication.processingRegistry().addProvider(self._provider)

    def initGui(self) -> None:
        """Register the provider, and add the menu."""
        self.initProcessing()
        self._action = QAction("Install geodelreg…", self._iface.mainWindow())
        self._action.triggered.connect(
            lambda: processing.execAlgorithmDialog("geodelreg:install", {})
        )
        self._iface.addPluginToMenu(_MENU, self._action)

    def unload(self) -> None:
        """Take both away."""
        QgsApplication.processingRegistry().removeProvider(self._provider)
        if self._action is not None:
            self._iface.removePluginMenu(_MENU, self._action)
