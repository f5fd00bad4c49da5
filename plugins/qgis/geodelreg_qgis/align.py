"""“Align”: correct the header of MS, of one file or of one file per band."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsFeature,
    QgsField,
    QgsFields,
    QgsGeometry,
    QgsPointXY,
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputMultipleLayers,
    QgsProcessingOutputNumber,
    QgsProcessingOutputString,
    QgsProcessingParameterFeatureSink,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterRasterDestination,
    QgsProcessingParameterRasterLayer,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QVariant

from geodelreg_qgis.base import MS, PAN, GeodelregAlgorithm, fill, helped
from geodelreg_qgis.loading import ResultGroup
from geodelreg_qgis.tie_points import TiePoint, read_tie_points

OUTPUT, TIE_POINTS, MESH = "OUTPUT", "TIE_POINTS", "MESH"
GCPS, REPORT, PAGE = "GCPS", "REPORT", "PAGE"
OUTCOME, UNCERTAINTY_PX = "OUTCOME", "UNCERTAINTY_PX"

_GCP_FILES = (
    "QGIS georeferencer (*.points);;GDAL options (*.txt);;GDAL (*.csv);;GeoJSON (*.geojson);;"
    "VRT (*.vrt);;ENVI (*.pts)"
)


class _Aligning(GeodelregAlgorithm):
    """Align, of one MS file or of one file per band."""

    COMMAND = "align"

    def add_results(self) -> None:
        """Parameters for what is written beside the raster."""
        point, polygon = (
            QgsProcessing.SourceType.TypeVectorPoint,
            QgsProcessing.SourceType.TypeVectorPolygon,
        )
        self.addParameter(
            helped(
                QgsProcessingParameterFeatureSink(TIE_POINTS, "Tie points", point, optional=True),
                "The points that the correction rests on, with arrows of what it leaves of each. "
                "Each was also left out of a fit and served as a check point.",
            )
        )
        self.addParameter(
            helped(
                QgsProcessingParameterFeatureSink(
                    MESH, "Mesh of the tie points", polygon, optional=True, createByDefault=False
                ),
                "Their Delaunay triangulation: where the ground is covered, and where it is not.",
            )
        )
        for name, label, files in (
            (GCPS, "Control points", _GCP_FILES),
            (PAGE, "Page to look at: before, after, arrows", "HTML (*.html)"),
            (REPORT, "Report", "JSON (*.json)"),
        ):
            self.addParameter(
                QgsProcessingParameterFileDestination(
                    name, label, files, optional=True, createByDefault=False
                )
            )
        self.addOutput(QgsProcessingOutputString(OUTCOME, "Outcome"))
        self.addOutput(QgsProcessingOutputNumber(UNCERTAINTY_PX, "Uncertainty (95 %), PAN pixels"))

    def align(
        self,
        where: Iterable[str],
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Run the command, and make layers of the tie points."""
        given = {
            name: self.parameterAsFileOutput(parameters, name, context)
            for name in (GCPS, REPORT, PAGE)
        }
        with tempfile.TemporaryDirectory(prefix="geodelreg-") as folder:
            points = Path(folder, "tie.points")
            report = Path(given[REPORT] or Path(folder, "report.json"))
            words = [*self.rasters, *where, "--overwrite", "--report", str(report)]
            words += ["--report", given[PAGE]] if given[PAGE] else []
            for file in (str(points), given[GCPS]):
                words += ["--gcps", file] if file else []
            self.call([*words, *self.option_words(parameters, context)], feedback)
            tie_points = list(read_tie_points(points, report))
            found = json.loads(report.read_text(encoding="utf-8"))
        return {
            OUTCOME: found["verdict"]["outcome"],
            UNCERTAINTY_PX: found["accuracy"]["uncertainty_px"],
            TIE_POINTS: self._sink(TIE_POINTS, tie_points, parameters, context),
            MESH: self._sink(MESH, tie_points, parameters, context),
            **{name: path for name, path in given.items() if path},
        }

    def _sink(
        self,
        name: str,
        tie_points: list[TiePoint],
        parameters: dict[str, Any],
        context: QgsProcessingContext,
    ) -> str | None:
        """Write one of the vector results; its name for QGIS, None when it is not wanted."""
        points = name == TIE_POINTS
        fields = QgsFields()
        for field in TiePoint.__dataclass_fields__ if points else ():
            fields.append(QgsField(field, QVariant.Double))
        kind = QgsWkbTypes.Type.Point if points else QgsWkbTypes.Type.Polygon
        sink, layer = self.parameterAsSink(parameters, name, context, fields, kind, self.ms_crs)
        if sink is None:
            return None
        places = [QgsPointXY(point.x, point.y) for point in tie_points]
        if points:
            geometries = map(QgsGeometry.fromPointXY, places)
            rows = [list(vars(point).values()) for point in tie_points]
        else:
            mesh = QgsGeometry.fromMultiPointXY(places).delaunayTriangulation()
            geometries = iter(mesh.asGeometryCollection())
            rows = [[]] * len(mesh.asGeometryCollection())
        features = []
        for geometry, row in zip(geometries, rows):
            feature = QgsFeature(fields)
            feature.setGeometry(geometry)
            feature.setAttributes(row)
            features.append(feature)
        fill(sink, features)
        return layer

    def load_together(
        self, rasters: dict[str, str], results: dict[str, Any], context: QgsProcessingContext
    ) -> None:
        """Have the results loaded with names and styles, in a group; rasters by file."""
        before = self.rasters[0] if len(rasters) == 1 else ""
        group = ResultGroup(f"geodelreg: {self.ms_name}", before, self.ms_id)
        for raster, name in rasters.items():
            group.load(context, raster, f"{name}, aligned")
        group.load(context, results[MESH], "Mesh", "mesh.qml")
        group.load(context, results[TIE_POINTS], "Tie points", "tie_points.qml")


class Align(_Aligning):
    """``geodelreg align`` of one file."""

    NAME, TITLE = "align", "Align"
    ABOUT = (
        "Corrects the georeferencing of MS so that it fits PAN. The pixels stay as they are: the "
        "result is the same file with a better header. What the images do not support is refused, "
        "and nothing is written.\n\n"
        "Without an output raster the correction is found and reported only. Tie points come as a "
        "layer in the CRS of MS; the dashed lines show where MS had them, the arrows what the "
        "correction leaves, drawn much longer than it is. After and before come in a layer group "
        "of which one is seen at a time."
    )

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Parameters and outputs."""
        self.addParameter(QgsProcessingParameterRasterLayer(MS, "MS (multispectral)"))
        self.addParameter(QgsProcessingParameterRasterLayer(PAN, "PAN (panchromatic)"))
        self.add_options()
        self.addParameter(
            QgsProcessingParameterRasterDestination(OUTPUT, "Aligned MS", optional=True)
        )
        self.add_results()

    def processAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Align, or look only."""
        output = self.parameterAsOutputLayer(parameters, OUTPUT, context)
        where = ["--output", output] if output else ["--dry-run"]
        results = self.align(where, parameters, context, feedback)
        self.load_together({output: self.ms_name} if output else {}, results, context)
        return {**results, OUTPUT: output or None}


class AlignBands(_Aligning):
    """``geodelreg align`` of one file per band."""

    NAME, TITLE = "alignbands", "Align band files"
    ABOUT = (
        "Corrects the georeferencing of an MS image that has one file per band. The bands are one "
        "image: one correction is found, and written for all of them or for none."
    )

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Parameters and outputs."""
        raster = QgsProcessing.SourceType.TypeRaster
        self.addParameter(
            QgsProcessingParameterMultipleLayers(MS, "MS (multispectral), one layer a band", raster)
        )
        self.addParameter(QgsProcessingParameterRasterLayer(PAN, "PAN (panchromatic)"))
        self.add_options()
        self.addParameter(
            QgsProcessingParameterFolderDestination(OUTPUT, "Folder for the aligned files")
        )
        self.add_results()
        self.addOutput(QgsProcessingOutputMultipleLayers("LAYERS", "Aligned files"))

    def processAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Align all of them or none."""
        if len(self.rasters) < 3:
            raise QgsProcessingException(
                "There is one MS layer only: use “Align”, or choose the layers of all bands."
            )
        folder = self.parameterAsString(parameters, OUTPUT, context)
        results = self.align(["--output", folder], parameters, context, feedback)
        layers = [str(Path(folder, Path(raster).name)) for raster in self.rasters[:-1]]
        for layer in layers:
            details = QgsProcessingContext.LayerDetails(Path(layer).stem, context.project(), OUTPUT)
            context.addLayerToLoadOnCompletion(layer, details)
        self.load_together({layer: Path(layer).stem for layer in layers}, results, context)
        return {**results, OUTPUT: folder, "LAYERS": layers}
