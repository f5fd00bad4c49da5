"""The part of ``check.py`` that runs inside QGIS: models, batch mode, cancelling, refusals.

``python3 in_qgis.py FOLDER``, where FOLDER holds three pairs; prints a line for each thing tried.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsApplication,
    QgsCoordinateReferenceSystem,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingModelAlgorithm,
    QgsProcessingModelChildAlgorithm,
    QgsProcessingModelChildParameterSource,
    QgsProcessingModelOutput,
    QgsProcessingModelParameter,
    QgsProcessingOutputHtml,
    QgsProcessingParameterRasterLayer,
    QgsProject,
    QgsRasterLayer,
    QgsVectorLayer,
)

PAIRS = (1, 2, 3)
CANCELLED_AFTER_S = (0.0, 0.3, 0.7, 1.1, 1.6, 2.2)


class Listening(QgsProcessingFeedback):
    """Feedback that keeps what it is told."""

    def __init__(self) -> None:
        super().__init__(False)
        self.warnings: list[str] = []
        self.steps: list[float] = []
        self.progressChanged.connect(self.steps.append)

    def pushWarning(self, warning: str) -> None:
        """Keep a warning."""
        self.warnings.append(warning)


def files(folder: Path) -> dict[str, bytes]:
    """Every file below a folder but GDAL's statistics, with its content."""
    return {
        str(path): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.endswith(".aux.xml")
    }


def say(what: str) -> None:
    """Report one thing that works."""
    print(f"ok: {what}", flush=True)


def refusal(run: Callable[[], Any]) -> str:
    """Message of a run that must fail."""
    try:
        run()
    except QgsProcessingException as error:
        return str(error)
    raise AssertionError("it was not refused")


def inputs(folder: Path, number: int) -> dict[str, str]:
    """Parameters for one pair."""
    return {"MS": str(folder / f"ms {number}.tif"), "PAN": str(folder / f"pan {number}.tif")}


def align(folder: Path) -> None:
    """Align with all results as layers."""
    import processing

    feedback = Listening()
    done = processing.run(
        "geodelreg:align",
        {
            **inputs(folder, 1),
            "OUTPUT": str(folder / "aligned.tif"),
            "TIE_POINTS": "memory:",
            "MESH": "memory:",
            "PAGE": str(folder / "page.html"),
        },
        feedback=feedback,
    )
    points, mesh = done["TIE_POINTS"], done["MESH"]
    linked = QgsApplication.processingRegistry().algorithmById("geodelreg:align")
    assert isinstance(linked.outputDefinition("PAGE"), QgsProcessingOutputHtml)
    assert "<html" in Path(done["PAGE"]).read_text(encoding="utf-8")
    assert done["OUTCOME"] == "aligned"
    assert points.crs() == QgsRasterLayer(done["OUTPUT"]).crs()
    assert points.featureCount() > 50
    assert mesh.featureCount() > points.featureCount()
    assert all(-1 < feature["residual_x"] < 1 for feature in points.getFeatures())
    assert feedback.steps == sorted(feedback.steps)
    assert feedback.steps[-1] == 100
    assert points.loadNamedStyle(style("tie_points.qml"))[1]
    say(
        f"align: {points.featureCount()} tie points, {mesh.featureCount()} triangles, RMSE "
        f"{done['CHECK_RMSE_PX']:.4f} px"
    )
    bands = processing.run(
        "geodelreg:alignbands",
        {
            "MS": [str(folder / f"band {number}.tif") for number in PAIRS],
            "PAN": str(folder / "pan 1.tif"),
            "OUTPUT": str(folder / "bands"),
        },
    )
    assert sorted(path.name for path in (folder / "bands").glob("*.tif")) == [
        f"band {number}.tif" for number in PAIRS
    ]
    assert all(QgsRasterLayer(layer).isValid() for layer in bands["LAYERS"])
    say("align: three band files, one correction")


def style(name: str) -> str:
    """File of one of the plugin's styles."""
    import geodelreg_qgis

    return str(Path(geodelreg_qgis.__file__).parent / "styles" / name)


def looked_only(folder: Path) -> None:
    """No output raster: a dry run."""
    import processing

    done = processing.run(
        "geodelreg:align", {**inputs(folder, 1), "OUTPUT": None, "TIE_POINTS": None}
    )
    assert done["OUTPUT"] is None
    assert done["OUTCOME"] == "aligned"
    say("align without an output: found and reported only")


def model(folder: Path) -> None:
    """Check, align, and sharpen what was aligned, in one model; saved, and run for three pairs."""
    import processing

    made = QgsProcessingModelAlgorithm("Check, align, sharpen", "")
    for name in ("ms", "pan"):
        parameter = QgsProcessingModelParameter(name)
        parameter.setParameterName(name)
        made.addModelParameter(QgsProcessingParameterRasterLayer(name, name), parameter)
    source = QgsProcessingModelChildParameterSource
    for name, parameters, output in (
        ("check", {"MS": source.fromModelParameter("ms")}, None),
        ("align", {"MS": source.fromModelParameter("ms")}, "TIE_POINTS"),
        (
            "pansharpen",
            {
                "MS": source.fromChildOutput("align", "OUTPUT"),
                "NO_ALIGN": source.fromStaticValue(True),
            },
            "OUTPUT",
        ),
    ):
        child = QgsProcessingModelChildAlgorithm(f"geodelreg:{name}")
        child.setChildId(name)
        child.addParameterSources("PAN", [source.fromModelParameter("pan")])
        for key, value in parameters.items():
            child.addParameterSources(key, [value])
        if output:
            result = QgsProcessingModelOutput(output.lower(), output.lower())
            result.setChildId(name)
            result.setChildOutputName(output)
            child.setModelOutputs({output.lower(): result})
        made.addChildAlgorithm(child)
    made.updateDestinationParameters()
    assert made.toFile(str(folder / "model.model3"))
    again = QgsProcessingModelAlgorithm()
    assert again.fromFile(str(folder / "model.model3"))
    again.initAlgorithm()
    names = [output.name() for output in again.destinationParameterDefinitions()]
    for number in PAIRS:
        wanted = {
            name: str(folder / f"model {number}.{'tif' if 'output' in name else 'gpkg'}")
            for name in names
        }
        pair = inputs(folder, number)
        processing.run(again, {"ms": pair["MS"], "pan": pair["PAN"], **wanted})
        sharp = QgsRasterLayer(str(folder / f"model {number}.tif"))
        assert (sharp.width(), sharp.height()) == (800, 800)
        assert QgsVectorLayer(str(folder / f"model {number}.gpkg")).featureCount() > 50
    say("a model (check, align, pansharpen of the aligned) saved, read again, run for three pairs")


def batch_mode(folder: Path) -> None:
    """Three pairs in the batch dialog of Processing; the second one is refused."""
    from processing.gui.BatchAlgorithmDialog import BatchAlgorithmDialog

    algorithm = QgsApplication.processingRegistry().createAlgorithmById("geodelreg:align")
    dialog = BatchAlgorithmDialog(algorithm)
    panel = dialog.mainWidget()
    shutil.copy(folder / "noise.tif", folder / "ms 4.tif")
    shutil.copy(folder / "pan 1.tif", folder / "pan 4.tif")
    numbers = (1, 4, 3, 2)
    while panel.batchRowCount() < len(numbers):
        panel.addRow()
    context = QgsProcessingContext()
    columns = panel.parameter_to_column if hasattr(panel, "parameter_to_column") else None
    assert columns is not None, "the batch panel of this QGIS has another layout"
    for row, number in enumerate(numbers):
        for name, value in inputs(folder, number).items():
            panel.wrappers[row][columns[name]].setParameterValue(value, context)
        for name, value in (
            ("OUTPUT", str(folder / f"batch {number}.tif")),
            ("TIE_POINTS", ""),
        ):
            panel.tblParameters.cellWidget(row + 1, columns[name]).setValue(value)
    panel.checkLoadLayersOnCompletion.setChecked(False)
    dialog.runAlgorithm()
    made = sorted(path.name for path in folder.glob("batch *.tif"))
    assert made == [f"batch {number}.tif" for number in PAIRS], made
    say("batch mode: three pairs aligned, a fourth refused and left out")


def batch_algorithm(folder: Path) -> None:
    """The batch of the command itself, by patterns."""
    import processing

    feedback = Listening()
    (folder / "batch").mkdir()
    done = processing.run(
        "geodelreg:batch",
        {
            "PAIR_MS": str(folder / "ms {n}.tif"),
            "PAIR_PAN": str(folder / "pan {n}.tif"),
            "OUTPUT": "out/{n}.tif",
            "OUT_ROOT": str(folder / "batch"),
            "TABLE": str(folder / "table.csv"),
            "FOOTPRINTS": "memory:",
            "PAGES": str(folder / "pages"),
        },
        feedback=feedback,
    )
    outcomes = sorted(feature["outcome"] for feature in done["FOOTPRINTS"].getFeatures())
    assert outcomes == ["aligned"] * 3 + ["refused"], outcomes
    assert len(list((folder / "batch" / "out").glob("*.tif"))) == len(PAIRS)
    assert feedback.steps[-1] == 100
    assert len(feedback.warnings) == 1
    assert Path(done["INDEX"]).exists()
    say(f"batch: {done['OUTCOME']}, footprints as a layer")


def cancel(folder: Path) -> None:
    """Cancel at six moments, in the same thread as QGIS runs algorithms in scripts."""
    import processing

    slowest = 0.0
    for name in ("align", "pansharpen"):
        for wait in CANCELLED_AFTER_S:
            before, feedback = files(folder), Listening()
            asked: list[float] = []

            def ask(feedback: Listening = feedback, asked: list[float] = asked) -> None:
                asked.append(time.monotonic())
                feedback.cancel()

            timer = threading.Timer(wait, ask)
            timer.start()
            target = {**inputs(folder, 2), "OUTPUT": str(folder / "cancelled.tif")}
            message = refusal(
                lambda name=name, target=target, feedback=feedback: processing.run(
                    f"geodelreg:{name}", target, feedback=feedback
                )
            )
            slowest = max(slowest, time.monotonic() - asked[0])
            assert "Cancelled" in message, message
            assert files(folder) == before
            assert not [path for path in folder.rglob("*") if "geodelreg" in path.name]
    assert slowest < 2
    say(
        f"cancelled at {2 * len(CANCELLED_AFTER_S)} moments: over within {slowest:.2f} s, no debris"
    )


def cancel_batch(folder: Path) -> None:
    """Cancel a batch when its first pair is done, and let it go on."""
    import processing

    (folder / "again").mkdir()
    target = {
        "PAIR_MS": str(folder / "ms {n}.tif"),
        "PAIR_PAN": str(folder / "pan {n}.tif"),
        "OUTPUT": "{n}.tif",
        "OUT_ROOT": str(folder / "again"),
        "WORKERS": 1,
        "TABLE": str(folder / "again.csv"),
    }
    feedback = Listening()
    feedback.progressChanged.connect(lambda percent: feedback.cancel())
    message = refusal(lambda: processing.run("geodelreg:batch", target, feedback=feedback))
    assert "The pairs that are done stay" in message, message
    done = len(list((folder / "again").glob("*.tif")))
    assert 1 <= done < len(PAIRS)
    assert not [path for path in (folder / "again").iterdir() if path.name.startswith(".")]
    processing.run("geodelreg:batch", {**target, "RESUME": True})
    assert len(list((folder / "again").glob("*.tif"))) == len(PAIRS)
    say(f"a batch cancelled after {done} of {len(PAIRS)} pairs goes on")


def refusals(folder: Path) -> None:
    """Layers that are no files, and images that do not support an alignment."""
    import processing

    before = files(folder)
    pair, project = inputs(folder, 1), QgsProject.instance()

    def tried(**changed: Any) -> str:
        target = {**pair, "OUTPUT": str(folder / "refused.tif"), "TIE_POINTS": None, **changed}
        return refusal(lambda: processing.run("geodelreg:align", target))

    web = QgsRasterLayer("type=xyz&url=https://tile.invalid/{z}/{x}/{y}.png", "Web map", "wms")
    other = QgsRasterLayer(inputs(folder, 3)["MS"], "Assigned")
    other.setCrs(QgsCoordinateReferenceSystem("EPSG:32633"))
    memory = QgsVectorLayer("Polygon?crs=EPSG:32618", "Clouds", "memory")
    project.addMapLayers([web, other, memory])
    for message, expected in (
        (tried(MS=web), "web map"),
        (tried(MS=other), "in QGIS only"),
        (tried(MASK=[memory]), "kept in memory"),
        (tried(MS=str(folder / "noise.tif")), "Refused: "),
        (tried(PAN=pair["MS"]), "as MS and as PAN"),
        (tried(OUTPUT=pair["MS"]), "ms 1.tif"),
        (tried(OUTPUT=str(folder / "no" / "folder.tif")), "folder"),
    ):
        assert expected in message, message
        print(f"    {message.splitlines()[-1]}")
    project.removeAllMapLayers()
    assert files(folder) == before
    say("refused in plain words, nothing written")


def commands(folder: Path) -> None:
    """No command, and an older one."""
    import processing
    from processing.core.ProcessingConfig import ProcessingConfig

    from geodelreg_qgis.base import COMMAND_SETTING

    registry = QgsApplication.processingRegistry()
    old = folder / "old geodelreg"
    old.write_text("#!/bin/sh\necho geodelreg 0.0.9\n", encoding="utf-8")
    old.chmod(0o755)
    setting = ProcessingConfig.settings[COMMAND_SETTING]
    try:
        setting.value = str(folder / "nowhere")
        able, why = registry.createAlgorithmById("geodelreg:align").canExecute()
        assert not able
        assert "no geodelreg command" in why
        assert "Install geodelreg" in why
        setting.value = str(old)
        target = {**inputs(folder, 1), "OUTPUT": str(folder / "old.tif")}
        message = refusal(lambda: processing.run("geodelreg:align", target))
        assert "0.0.9" in message
        print(f"    {why}\n    {message}")
    finally:
        setting.value = ""
        old.unlink()
    say("no command, and an older one: told what to do")


def main(folder: Path) -> None:
    """Try everything in a QGIS without windows."""
    application = QgsApplication([], True)
    application.initQgis()
    import processing
    from processing.core.Processing import Processing

    Processing.initialize()
    from geodelreg_qgis.plugin import Plugin

    assert processing
    plugin = Plugin(None)
    plugin.initProcessing()
    looking, stopping = (align, looked_only, refusals, commands), (cancel, cancel_batch)
    for step in (*looking, *stopping, model, batch_mode, batch_algorithm):
        step(folder)
    plugin.unload()
    sys.stdout.flush()
    os._exit(0)  # QGIS 3.22 may crash while Python takes it down


if __name__ == "__main__":
    main(Path(sys.argv[1]))
