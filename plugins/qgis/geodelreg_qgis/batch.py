"""“Batch of many pairs”: align or check them, with a ledger."""

from __future__ import annotations

import csv
import json
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsFeature,
    QgsField,
    QgsFields,
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputHtml,
    QgsProcessingOutputString,
    QgsProcessingParameterFeatureSink,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterString,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QVariant

from geodelreg_qgis.base import GeodelregAlgorithm, fill, folded, helped
from geodelreg_qgis.loading import load
from geodelreg_qgis.messages import reason

MANIFEST, PAIR_MS, PAIR_PAN, OUT_ROOT = "MANIFEST", "PAIR_MS", "PAIR_PAN", "OUT_ROOT"
LEDGER, TABLE, FOOTPRINTS, OUTCOME = "LEDGER", "TABLE", "FOOTPRINTS", "OUTCOME"
PAGES, INDEX = "PAGES", "INDEX"

_ANSWERS = (0, 1, 3, 4)
"""Exit codes: also when some pairs have failed, were refused or are misaligned."""


class Batch(GeodelregAlgorithm):
    """``geodelreg batch``."""

    COMMAND = "batch"
    NAME, TITLE = "batch", "Batch of many pairs"
    ABOUT = (
        "Aligns, or checks, many pairs in parallel.\n\n"
        "Name a manifest, or patterns of the files of MS and PAN. The ledger keeps what became of "
        "each pair, so that a batch can go on where it was cancelled."
    )

    CANCELLED = (
        "Cancelled. The pairs that are done stay; “Go on with an existing ledger” does the rest."
    )

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Parameters and outputs."""
        manifest = "Manifests (*.csv *.jsonl)"
        self.addParameter(
            helped(
                QgsProcessingParameterFile(
                    MANIFEST, "Manifest (CSV or JSON lines)", optional=True, fileFilter=manifest
                ),
                "A table with the columns ms, pan and out; further columns are options.",
            )
        )
        for name, label in (
            (PAIR_MS, "Pattern of MS files, instead of a manifest"),
            (PAIR_PAN, "Pattern of PAN files"),
        ):
            self.addParameter(
                helped(
                    QgsProcessingParameterString(name, label, optional=True),
                    "For example /data/{scene}_MS.tif and /data/{scene}_PAN.tif: a field in braces "
                    "stands for the same text in all patterns.",
                )
            )
        self.add_options()
        folder = QgsProcessingParameterFile.Behavior.Folder
        self.addParameter(
            helped(
                QgsProcessingParameterFile(
                    OUT_ROOT, "Folder of the outputs", folder, optional=True
                ),
                "Relative outputs begin there; by default in the folder of the manifest.",
            )
        )
        self.addParameter(
            folded(
                helped(
                    QgsProcessingParameterFile(LEDGER, "Ledger", optional=True),
                    "By default beside the manifest, or batch.ledger in the folder of the outputs.",
                )
            )
        )
        self.addParameter(
            QgsProcessingParameterFileDestination(TABLE, "Table of results", "CSV (*.csv)")
        )
        polygon = QgsProcessing.SourceType.TypeVectorPolygon
        self.addParameter(
            QgsProcessingParameterFeatureSink(FOOTPRINTS, "Footprints", polygon, optional=True)
        )
        self.addParameter(
            QgsProcessingParameterFolderDestination(
                PAGES, "Pages to look at", optional=True, createByDefault=False
            )
        )
        self.addOutput(QgsProcessingOutputHtml(INDEX, "Pages to look at"))
        self.addOutput(QgsProcessingOutputString(OUTCOME, "Number of pairs by outcome (JSON)"))

    def processAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Run all pairs; some may fail."""
        words = self.option_words(parameters, context)
        for name, flag in ((OUT_ROOT, "--out-root"), (LEDGER, "--ledger")):
            value = self.parameterAsString(parameters, name, context)
            words += [flag, value] if value else []
        manifest = self.parameterAsString(parameters, MANIFEST, context)
        pair = [self.parameterAsString(parameters, name, context) for name in (PAIR_MS, PAIR_PAN)]
        words += [manifest] if manifest else []
        words += ["--pair", *pair] if any(pair) else []
        table = Path(self.parameterAsFileOutput(parameters, TABLE, context))
        pages = self.parameterAsString(parameters, PAGES, context)
        with tempfile.TemporaryDirectory(prefix="geodelreg-") as folder:
            footprints = Path(folder, "footprints.geojson")
            made = ["--overwrite", "--table", str(table), "--footprints", str(footprints)]
            made += ["--report-dir", pages] if pages else []
            plan = self.call([*words, "--overwrite", "--dry-run"], feedback)
            pairs = len(plan.output.splitlines())
            finished = self.call([*words, *made], feedback, _ANSWERS, pairs)
            if not footprints.exists():
                raise QgsProcessingException(reason(finished.messages))
            layer = self._footprints(footprints, parameters, context)
        with table.open(encoding="utf-8", newline="") as file:
            counts = Counter(row["outcome"] for row in csv.DictReader(file))
        if counts["failed"] or counts["refused"] or counts["cannot_tell"]:
            feedback.pushWarning(f"Not all pairs could be aligned; see {table}.")
        index = {PAGES: pages, INDEX: str(Path(pages, "index.html"))} if pages else {}
        return {TABLE: str(table), FOOTPRINTS: layer, OUTCOME: json.dumps(counts), **index}

    def _footprints(
        self, file: Path, parameters: dict[str, Any], context: QgsProcessingContext
    ) -> str | None:
        """Copy the footprints to where the user wants them; their name for QGIS."""
        found = QgsVectorLayer(str(file), "footprints", "ogr")
        numbers = (QVariant.Int, QVariant.LongLong, QVariant.Double)
        fields = QgsFields()  # lists become text, which every format can hold
        for field in found.fields():
            kind = field.type() if field.type() in numbers else QVariant.String
            fields.append(QgsField(field.name(), kind))
        sink, layer = self.parameterAsSink(
            parameters, FOOTPRINTS, context, fields, found.wkbType(), found.crs()
        )
        if sink is None:
            return None
        features = []
        for footprint in found.getFeatures():
            feature = QgsFeature(fields)
            feature.setGeometry(footprint.geometry())
            values = footprint.attributes()
            feature.setAttributes(
                ["; ".join(map(str, v)) if isinstance(v, list) else v for v in values]
            )
            features.append(feature)
        fill(sink, features)
        load(context, layer, "Footprints", "footprints.qml")
        return str(layer)
