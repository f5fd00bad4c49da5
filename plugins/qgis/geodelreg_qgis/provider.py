"""The Processing provider: which algorithms there are, and the setting they share."""

from __future__ import annotations

import os
from pathlib import Path

from processing.core.ProcessingConfig import ProcessingConfig, Setting, settingsWatcher
from qgis.core import QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from geodelreg_qgis.align import Align, AlignBands
from geodelreg_qgis.apply import Apply
from geodelreg_qgis.base import COMMAND_SETTING
from geodelreg_qgis.batch import Batch
from geodelreg_qgis.check import Check
from geodelreg_qgis.command import CommandError, commands_of, find_command
from geodelreg_qgis.install import Install
from geodelreg_qgis.pansharpen import Pansharpen

ALGORITHMS = (Align, AlignBands, Apply, Check, Pansharpen, Batch, Install)


class Provider(QgsProcessingProvider):
    """geodelreg's algorithms."""

    def load(self) -> bool:
        """Register the setting and the algorithms."""
        ProcessingConfig.settingIcons[self.name()] = self.icon()
        ProcessingConfig.addSetting(
            Setting(
                self.name(),
                COMMAND_SETTING,
                "Path of the geodelreg command (empty: the one on PATH)",
                "",
                valuetype=Setting.FILE,
            )
        )
        ProcessingConfig.readSettings()
        settingsWatcher.settingsChanged.connect(self.refreshAlgorithms)
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        """Take the setting away."""
        settingsWatcher.settingsChanged.disconnect(self.refreshAlgorithms)
        ProcessingConfig.removeSetting(COMMAND_SETTING)

    def loadAlgorithms(self) -> None:
        """Register what the command can do; all of it while there is no command."""
        try:
            able = commands_of(find_command(ProcessingConfig.getSetting(COMMAND_SETTING) or ""))
        except CommandError:
            able = None
        for algorithm in ALGORITHMS:
            if able is None or algorithm.COMMAND is None or algorithm.COMMAND in able:
                self.addAlgorithm(algorithm())

    def id(self) -> str:
        """As in ``geodelreg:align``."""
        return "geodelreg"

    def name(self) -> str:
        """As in the toolbox."""
        return "geodelreg"

    def longName(self) -> str:
        """As in the settings."""
        return "geodelreg (align MS to PAN)"

    def icon(self) -> QIcon:
        """Of the provider and its algorithms."""
        return QIcon(os.fspath(Path(__file__).with_name("icon.svg")))

    def supportsNonFileBasedOutput(self) -> bool:
        """Tie points may go anywhere, rasters into files."""
        return True
