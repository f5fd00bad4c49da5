"""“Apply a correction”: what Align has found, for other files of the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsDataProvider,
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputMultipleLayers,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
)

from geodelreg_qgis.base import INPUT, GeodelregAlgorithm, folded, helped, source_of

CORRECTION, OUTPUT, FOLDER, IN_PLACE = "CORRECTION", "OUTPUT", "FOLDER", "IN_PLACE"
LAYERS = "LAYERS"

_FILES = "GeoTIFF (*.tif);;GeoJSON (*.geojson);;GeoPackage (*.gpkg);;CSV (*.csv);;All files (*)"


class Apply(GeodelregAlgorithm):
    """``geodelreg apply``."""

    COMMAND = "apply"
    NAME, TITLE = "apply", "Apply a correction"
    ABOUT = (
        "Applies the correction in a report of Align to other layers of the same scene: masks, "
        "bands of another pixel size, vectors that were drawn on MS. They have the same error.\n\n"
        "Rasters get a corrected header and keep their pixels, or are resampled. GeoJSON, "
        "GeoPackage and CSV files get corrected coordinates. Of several layers all are written or "
        "none. Layers of another place are refused.\n\n"
        "Choose one of file, folder, in place."
    )

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Parameters and outputs."""
        self.addParameter(
            helped(
                QgsProcessingParameterFile(CORRECTION, "Report of Align", extension="json"),
                "It holds the correction.",
            )
        )
        any_layer = QgsProcessing.SourceType.TypeMapLayer
        self.addParameter(
            QgsProcessingParameterMultipleLayers(INPUT, "Layers of the same scene", any_layer)
        )
        self.add_options(masks=False)
        self.addParameter(
            folded(
                helped(
                    QgsProcessingParameterBoolean(IN_PLACE, "In place", False),
                    "Correct the headers of the files themselves. Rasters only. Layers in the map "
                    "are opened again.",
                )
            )
        )
        self.addParameter(
            QgsProcessingParameterFileDestination(
                OUTPUT, "Corrected file, of one layer", _FILES, optional=True, createByDefault=False
            )
        )
        self.addParameter(
            QgsProcessingParameterFolderDestination(
                FOLDER, "Folder for the corrected files", optional=True, createByDefault=False
            )
        )
        self.addOutput(QgsProcessingOutputMultipleLayers(LAYERS, "Corrected layers"))

    def checkParameterValues(
        self, parameters: dict[str, Any], context: QgsProcessingContext
    ) -> tuple[bool, str]:
        """Refuse results that go nowhere, or to two places."""
        valid, why = super().checkParameterValues(parameters, context)
        if not valid:
            return valid, why
        output, folder = (
            self.parameterAsFileOutput(parameters, name, context) for name in (OUTPUT, FOLDER)
        )
        in_place = self.parameterAsBoolean(parameters, IN_PLACE, context)
        if [bool(output), bool(folder), in_place].count(True) != 1:
            return False, "Say where the result goes: one of file, folder, in place."
        if output and len(set(self.files(parameters, context)[INPUT])) > 1:
            return False, "Several files do not go to one file: choose a folder."
        return True, ""

    def prepareAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> bool:
        """Remember the layers, of which several may be of one file."""
        layers = self._layers(INPUT, parameters, context)
        self._sources = [
            (layer.name(), layer.source(), source_of(layer).path, layer.id()) for layer in layers
        ]
        self._reopened = self.parameterAsBoolean(parameters, IN_PLACE, context)
        return bool(super().prepareAlgorithm(parameters, context, feedback))

    def processAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Correct all of them or none."""
        output, folder = (
            self.parameterAsFileOutput(parameters, name, context) for name in (OUTPUT, FOLDER)
        )
        files = list(dict.fromkeys(self._files[INPUT]))
        targets = {file: str(Path(folder, Path(file).name)) if folder else output for file in files}
        words = [self.parameterAsFile(parameters, CORRECTION, context), *files]
        if self._reopened:
            words, targets = [*words, "--in-place"], {file: file for file in files}
        else:
            if folder:
                _make(folder)
            where = folder if len(files) > 1 else targets[files[0]]
            words += ["--output", where, "--overwrite"]
        self.call([*words, *self.option_words(parameters, context)], feedback)
        layers = []
        for name, source, file, _ in self._sources:
            layers.append(source.replace(file, targets[file]))
            if not self._reopened:
                details = QgsProcessingContext.LayerDetails(
                    f"{name}, corrected", context.project(), LAYERS
                )
                details.forceName = True
                context.addLayerToLoadOnCompletion(layers[-1], details)
        written = {OUTPUT: output, FOLDER: folder}
        return {LAYERS: layers, **{name: path for name, path in written.items() if path}}

    def postProcessAlgorithm(
        self, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Open the layers of the project again whose files were corrected in place."""
        if self._reopened and context.project():
            for *_, identity in self._sources:
                layer = context.project().mapLayer(identity)
                if layer:
                    layer.setDataSource(
                        layer.source(),
                        layer.name(),
                        layer.providerType(),
                        QgsDataProvider.ProviderOptions(),
                    )
        return {}


def _make(folder: str) -> None:
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise QgsProcessingException(f"The folder cannot be made: {error}") from error
