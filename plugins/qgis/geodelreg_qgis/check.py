"""“Check”: tell whether MS lies where PAN says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputNumber,
    QgsProcessingOutputString,
    QgsProcessingParameterFileDestination,
)

from geodelreg_qgis.base import GeodelregAlgorithm

REPORT, OUTCOME, DISTANCE_PX, SIGMA_PX = "REPORT", "OUTCOME", "DISTANCE_PX", "SIGMA_PX"

_ANSWERS = (0, 3, 4)
"""Exit codes: aligned, cannot tell, misaligned."""


class Check(GeodelregAlgorithm):
    """``geodelreg check``."""

    COMMAND = "check"
    NAME, TITLE = "check", "Check"
    ABOUT = (
        "Tells whether MS lies where PAN says, and writes nothing. The misalignment is the largest "
        "in the overlap of the two.\n\n"
        "The outcome is aligned, misaligned or cannot_tell; models can branch on it. The report "
        "holds everything that was measured."
    )

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Parameters and outputs."""
        self.add_rasters()
        self.add_options()
        self.addParameter(
            QgsProcessingParameterFileDestination(
                REPORT, "Report", "JSON (*.json)", optional=True, createByDefault=False
            )
        )
        self.addOutput(QgsProcessingOutputString(OUTCOME, "Outcome"))
        self.addOutput(QgsProcessingOutputNumber(DISTANCE_PX, "Misalignment, PAN pixels"))
        self.addOutput(QgsProcessingOutputNumber(SIGMA_PX, "Its standard error, PAN pixels"))

    def processAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Measure, and say in a sentence what was found."""
        words = [*self.rasters, "--json", *self.option_words(parameters, context)]
        finished = self.call(words, feedback, _ANSWERS)
        check = json.loads(finished.output)["check"]
        report = self.parameterAsFileOutput(parameters, REPORT, context)
        if report:
            Path(report).write_text(finished.output, encoding="utf-8")
        off = check["misalignment"]
        feedback.pushInfo(_sentence(check["outcome"], off))
        for band in check["bands"] or ():
            off_band = band["misalignment"]
            feedback.pushInfo(f"{band['name']}: {_sentence(band['outcome'], off_band)}")
        return {
            OUTCOME: check["outcome"],
            DISTANCE_PX: off["distance_px"],
            SIGMA_PX: off["sigma_px"],
            **({REPORT: report} if report else {}),
        }


def _sentence(outcome: str, off: dict[str, Any]) -> str:
    words = outcome.replace("_", " ")
    if off["distance_px"] is None or off["sigma_px"] is None:
        return words
    return f"{words}: off by at most {off['distance_px']:.3f} ± {off['sigma_px']:.3f} PAN px"
