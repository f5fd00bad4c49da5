"""What geodelreg's algorithms have in common: inputs, options, and the run of the command."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import (
    QgsFeature,
    QgsFeatureSink,
    QgsMapLayer,
    QgsMapLayerType,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterBand,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRasterLayer,
    QgsProcessingParameterString,
    QgsProviderRegistry,
)
from qgis.PyQt.QtGui import QIcon

from geodelreg_qgis.command import CommandError, Finished, check_version, find_command, run
from geodelreg_qgis.messages import reason, sort_line
from geodelreg_qgis.options import Command, Option, load_commands
from geodelreg_qgis.sources import Source, SourceError, check_pair, file_of

COMMAND_SETTING = "GEODELREG_COMMAND"
HERE = Path(__file__).parent
KNOWN = load_commands(HERE / "commands.json")

MS, MORE, PAN, MASK, MASK_HIDES, PAN_MASK = "MS", "MORE", "PAN", "MASK", "MASK_HIDES", "PAN_MASK"
INPUT = "INPUT"
_BANDS_OF = {"band": MS, "pan_band": PAN}
_NUMBERS = {
    "integer": QgsProcessingParameterNumber.Type.Integer,
    "number": QgsProcessingParameterNumber.Type.Double,
}


def folded(parameter: QgsProcessingParameterDefinition) -> QgsProcessingParameterDefinition:
    """The same parameter among the advanced ones."""
    flag = QgsProcessingParameterDefinition.Flag.FlagAdvanced
    parameter.setFlags(parameter.flags() | flag)
    return parameter


def helped(
    parameter: QgsProcessingParameterDefinition, text: str
) -> QgsProcessingParameterDefinition:
    """The same parameter with a help text."""
    parameter.setHelp(text)
    return parameter


def fill(sink: QgsFeatureSink, features: Iterable[QgsFeature]) -> None:
    """Write features, all of them.

    Raises
    ------
    QgsProcessingException
        When one cannot be written.
    """
    for feature in features:
        if not sink.addFeature(feature):
            raise QgsProcessingException(f"A feature cannot be written: {sink.lastError()}")


def source_of(layer: QgsMapLayer) -> Source:
    """What matters of a layer."""
    provider, vector = layer.providerType(), layer.type() == QgsMapLayerType.VectorLayer
    parts = QgsProviderRegistry.instance().decodeUri(provider, layer.source())
    path = parts.get("path") or layer.source()
    crs, file_crs = layer.crs(), layer.dataProvider().crs()
    names = (
        {}
        if crs == file_crs
        else {"crs": crs.userFriendlyIdentifier(), "file_crs": file_crs.userFriendlyIdentifier()}
    )
    return Source(
        layer.name(),
        provider,
        parts.get("vsiPrefix", "") + path + parts.get("vsiSuffix", ""),
        unsaved=vector and layer.isModified(),
        filter=layer.subsetString() if vector else "",
        **names,
    )


class GeodelregAlgorithm(QgsProcessingAlgorithm):
    """An algorithm that runs one command of geodelreg."""

    COMMAND: ClassVar[str | None] = None
    """Name of the command; None of an algorithm that runs none."""
    NAME: ClassVar[str]
    TITLE: ClassVar[str]
    ABOUT: ClassVar[str]
    """Help beside the dialog."""
    CANCELLED: ClassVar[str] = "Cancelled; nothing was written."

    # --- what QGIS asks ---------------------------------------------------------------------------

    def createInstance(self) -> GeodelregAlgorithm:
        """Another one."""
        return type(self)()

    def name(self) -> str:
        """As in ``geodelreg:align``."""
        return self.NAME

    def displayName(self) -> str:
        """As in the toolbox."""
        return self.TITLE

    def icon(self) -> QIcon:
        """That of the provider."""
        return QIcon(os.fspath(HERE / "icon.svg"))

    def tags(self) -> list[str]:
        """What it is found by in the toolbox."""
        return ["coregistration", "registration", "align", "georeference", "pansharpening", "gcp"]

    def shortDescription(self) -> str:
        """Tooltip in the toolbox."""
        return self.described().summary

    def shortHelpString(self) -> str:
        """Help beside the dialog."""
        return self.ABOUT

    def canExecute(self) -> tuple[bool, str]:
        """Whether there is a command to run, and what to do when there is none."""
        try:
            find_command(command_setting())
        except CommandError as error:
            return False, str(error)
        return True, ""

    def checkParameterValues(
        self, parameters: dict[str, Any], context: QgsProcessingContext
    ) -> tuple[bool, str]:
        """Refuse layers that are no files before anything is started."""
        valid, why = super().checkParameterValues(parameters, context)
        if valid:
            try:
                self.files(parameters, context)
            except QgsProcessingException as error:
                return False, str(error)
        return valid, why

    def prepareAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> bool:
        """Look at the layers in the thread that owns them."""
        self._files = self.files(parameters, context)
        for layer in self._layers(MS, parameters, context)[:1]:
            self.ms_crs, self.ms_id, self.ms_name = layer.crs(), layer.id(), layer.name()
        return True

    # --- for the algorithms -----------------------------------------------------------------------

    def described(self) -> Command:
        """Its command."""
        return KNOWN.by_name[self.COMMAND or ""]

    def add_rasters(self) -> None:
        """Parameters for MS, as one file or several, and PAN."""
        raster = QgsProcessing.SourceType.TypeRaster
        self.addParameter(QgsProcessingParameterRasterLayer(MS, "MS (multispectral)"))
        self.addParameter(
            helped(
                QgsProcessingParameterMultipleLayers(
                    MORE, "Further bands of MS, when each is a file", raster, optional=True
                ),
                "Layers with the other bands of the same MS image.",
            )
        )
        self.addParameter(QgsProcessingParameterRasterLayer(PAN, "PAN (panchromatic)"))

    def add_options(self, masks: bool = True) -> None:
        """Parameters for the options of the command, and for masks where it takes some."""
        options = self.described().options
        for option in options:
            parameter = helped(self._parameter(option), option.help)
            self.addParameter(folded(parameter) if option.advanced else parameter)
        if not masks:
            return
        any_layer = QgsProcessing.SourceType.TypeMapLayer
        for name, of in ((MASK, "MS"), (PAN_MASK, "PAN")):
            self.addParameter(
                folded(
                    helped(
                        QgsProcessingParameterMultipleLayers(
                            name, f"Masks of {of}", any_layer, optional=True
                        ),
                        f"Rasters, polygons or quality bands (Landsat QA_PIXEL, Sentinel-2 SCL) "
                        f"that hide pixels of {of}: clouds, water.",
                    )
                )
            )
        self.addParameter(
            folded(
                helped(
                    QgsProcessingParameterString(
                        MASK_HIDES, "Values of the masks that hide", optional=True
                    ),
                    "For example 3,8-10; or binary, landsat-qa, sentinel2-scl. Empty: as the mask "
                    "itself suggests.",
                )
            )
        )

    def _parameter(self, option: Option) -> QgsProcessingParameterDefinition:
        name, label = option.name.upper(), option.label
        parent = _BANDS_OF.get(option.name, "")
        if self.parameterDefinition(parent) is not None and isinstance(
            self.parameterDefinition(parent), QgsProcessingParameterRasterLayer
        ):
            return QgsProcessingParameterBand(name, label, option.default, parent, optional=True)
        if option.kind == "flag":
            return QgsProcessingParameterBoolean(name, label, option.default)
        if option.kind in ("choice", "choices"):
            return QgsProcessingParameterEnum(
                name,
                label,
                list(option.choices),
                option.kind == "choices",
                option.default,
                option.default is None,
                usesStaticStrings=True,
            )
        if option.kind in _NUMBERS:
            return QgsProcessingParameterNumber(
                name, label, _NUMBERS[option.kind], option.default, optional=True
            )
        return QgsProcessingParameterString(
            name, label, option.default, multiLine=option.kind == "texts", optional=True
        )

    def option_words(self, parameters: dict[str, Any], context: QgsProcessingContext) -> list[str]:
        """Words of the command line for options and masks."""
        readers = {
            "flag": self.parameterAsBoolean,
            "choice": self.parameterAsEnumString,
            "choices": self.parameterAsEnumStrings,
            "integer": self.parameterAsInt,
            "number": self.parameterAsDouble,
            "text": self.parameterAsString,
            "texts": lambda *given: self.parameterAsString(*given).split("\n"),
        }
        described = self.described()
        values = {
            option.name: readers[option.kind](parameters, option.name.upper(), context)
            for option in described.options
            if parameters.get(option.name.upper()) is not None
        }
        words = described.arguments(values)
        hides = self.parameterAsString(parameters, MASK_HIDES, context)
        for name, flag in ((MASK, "--mask"), (PAN_MASK, "--pan-mask")):
            for file in self._files[name]:
                words += [flag, f"{file}={hides}" if hides else file]
        return words

    def files(
        self, parameters: dict[str, Any], context: QgsProcessingContext
    ) -> dict[str, list[str]]:
        """Names of the files of all layers that are given.

        Raises
        ------
        QgsProcessingException
            When a layer is no file.
        """
        found = {}
        try:
            for name in (MS, MORE, PAN, MASK, PAN_MASK, INPUT):
                layers = self._layers(name, parameters, context)
                found[name] = [file_of(source_of(layer)) for layer in layers]
            check_pair([*found[MS], *found[MORE]], found[PAN])
        except SourceError as error:
            raise QgsProcessingException(str(error)) from error
        return found

    def _layers(
        self, name: str, parameters: Mapping[str, Any], context: QgsProcessingContext
    ) -> list[QgsMapLayer]:
        definition = self.parameterDefinition(name)
        if definition is None:
            return []
        if isinstance(definition, QgsProcessingParameterMultipleLayers):
            return list(self.parameterAsLayerList(parameters, name, context))
        layer = self.parameterAsRasterLayer(parameters, name, context)
        if layer is None:
            raise QgsProcessingException(self.invalidRasterError(parameters, name))
        return [layer]

    @property
    def rasters(self) -> list[str]:
        """Names of the files of MS and PAN, in the order of the command line."""
        return [file for name in (MS, MORE, PAN) for file in self._files[name]]

    def call(
        self,
        words: Iterable[str],
        feedback: QgsProcessingFeedback,
        answers: Iterable[int] = (0,),
        pairs: int = 0,
    ) -> Finished:
        """Run the command, and show in QGIS's log what it says.

        Parameters
        ----------
        words : iterable of str
            What follows the name of the command.
        answers : iterable of int
            Exit codes that are an answer, and no failure.
        pairs : int
            Number of the pairs of a batch.

        Raises
        ------
        QgsProcessingException
            When it fails, or the user cancels.
        """
        try:
            command = find_command(command_setting())
            check_version(command, KNOWN.version)
            line = [command, self.described().name, *words]
            feedback.pushCommandInfo(shlex.join(line))
            finished = run([*line, "-v"], listener(feedback, pairs), feedback.isCanceled)
        except CommandError as error:
            raise QgsProcessingException(str(error)) from error
        if finished.code is None:
            raise QgsProcessingException(self.CANCELLED)
        if finished.code not in answers:
            raise QgsProcessingException(reason(finished.messages))
        return finished


def listener(feedback: QgsProcessingFeedback, pairs: int = 0) -> Callable[[str], None]:
    """What puts the lines of a command into QGIS's log; of a batch, it counts the pairs."""
    ended = 0

    def show(line: str) -> None:
        nonlocal ended
        message = sort_line(line)
        if message.kind == "step":
            feedback.setProgressText(message.text)
            feedback.setProgress(message.percent)
        elif message.kind == "warning":
            feedback.pushWarning(message.text)
        else:
            feedback.pushInfo(message.text)
        if message.kind == "pair" and pairs:
            ended += 1
            feedback.setProgress(100 * ended / pairs)

    return show


def command_setting() -> str:
    """Path of the command as the user has set it; empty for the one on PATH."""
    return ProcessingConfig.getSetting(COMMAND_SETTING) or ""
