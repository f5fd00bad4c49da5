"""“Install geodelreg”: the action that makes an environment for the command."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import (
    QgsApplication,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputString,
    QgsProcessingParameterFile,
    QgsProcessingParameterString,
)
from qgis.PyQt.QtGui import QIcon

from geodelreg_qgis.base import COMMAND_SETTING, HERE, KNOWN, folded, helped
from geodelreg_qgis.command import CommandError
from geodelreg_qgis.environment import (
    bundled_wheel,
    drop_environments,
    find_python,
    make_environment,
)

PYTHON, PACKAGE, FOLDER, COMMAND = "PYTHON", "PACKAGE", "FOLDER", "COMMAND"
_ABOUT = """\
Makes a Python environment with geodelreg in it, and has the plugin use it.

The environment is apart from QGIS: nothing of QGIS is changed, and both keep their own GDAL. The
packages that geodelreg needs are fetched from the Python Package Index. Needed is Python 3.11 or
later with venv and pip; QGIS's own will do where it is recent enough. When the installation fails
or is cancelled, all stays as it was."""


class Install(QgsProcessingAlgorithm):
    """Make an environment, and set the command to the one in it."""

    COMMAND = None

    def createInstance(self) -> Install:
        """Another one."""
        return Install()

    def name(self) -> str:
        """As in ``geodelreg:install``."""
        return "install"

    def displayName(self) -> str:
        """As in the toolbox."""
        return "Install geodelreg"

    def icon(self) -> QIcon:
        """That of the provider."""
        return QIcon(os.fspath(HERE / "icon.svg"))

    def shortHelpString(self) -> str:
        """Help beside the dialog."""
        return _ABOUT

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Parameters and outputs."""
        for name, label, text in (
            (PYTHON, "Python", "Command of a Python; empty: QGIS's own, or one on PATH."),
            (PACKAGE, "geodelreg", "Wheel, or folder of sources; empty: the wheel in the plugin."),
        ):
            parameter = QgsProcessingParameterString(name, label, optional=True)
            self.addParameter(folded(helped(parameter, text)))
        behavior = QgsProcessingParameterFile.Behavior.Folder
        folder = QgsProcessingParameterFile(FOLDER, "Folder", behavior, optional=True)
        self.addParameter(folded(helped(folder, "Empty: the user profile of QGIS.")))
        self.addOutput(QgsProcessingOutputString(COMMAND, "Command"))

    def processAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Make the environment, then use it."""
        python, package, folder = (
            self.parameterAsString(parameters, name, context) for name in (PYTHON, PACKAGE, FOLDER)
        )
        parent = Path(folder or QgsApplication.qgisSettingsDirPath()) / "geodelreg_environments"
        try:
            command = make_environment(
                parent,
                find_python(python),
                Path(package).expanduser() if package else bundled_wheel(HERE / "wheels"),
                KNOWN.version,
                feedback.pushInfo,
                feedback.isCanceled,
            )
        except CommandError as error:
            raise QgsProcessingException(str(error)) from error
        if command is None:
            raise QgsProcessingException("Cancelled; nothing was installed.")
        ProcessingConfig.setSettingValue(COMMAND_SETTING, command)
        drop_environments(parent, command)
        feedback.pushInfo(f"geodelreg is installed: {command}")
        return {COMMAND: command}
