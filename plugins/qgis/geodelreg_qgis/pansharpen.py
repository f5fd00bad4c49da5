"""“Pansharpen”: align MS and sharpen it with PAN."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterRasterDestination,
)

from geodelreg_qgis.base import GeodelregAlgorithm

OUTPUT = "OUTPUT"


class Pansharpen(GeodelregAlgorithm):
    """``geodelreg pansharpen``."""

    COMMAND = "pansharpen"
    NAME, TITLE = "pansharpen", "Pansharpen"
    ABOUT = (
        "Aligns MS with PAN, then sharpens it on the exact grid of PAN. MS is resampled once, from "
        "where it really lies; every band is multiplied by PAN over the weighted sum of the bands "
        "(weighted Brovey)."
    )

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Parameters and outputs."""
        self.add_rasters()
        self.add_options()
        self.addParameter(QgsProcessingParameterRasterDestination(OUTPUT, "Sharpened MS"))

    def processAlgorithm(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Align and sharpen."""
        output = self.parameterAsOutputLayer(parameters, OUTPUT, context)
        words = [*self.rasters, "--output", output, "--overwrite"]
        self.call([*words, *self.option_words(parameters, context)], feedback)
        return {OUTPUT: output}
