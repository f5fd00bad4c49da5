"""Runs that end well: layers, models, batch mode."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from helpers import PAIRS, Listening, inputs, say, square
from qgis.core import (
    QgsApplication,
    QgsProcessingContext,
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
        f"align: {points.featureCount()} tie points, {mesh.featureCount()} triangles, known to "
        f"{done['UNCERTAINTY_PX']:.4f} px"
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


def looked_only(folder: Path) -> None:
    """No output raster: a dry run."""
    import processing

    done = processing.run(
        "geodelreg:align", {**inputs(folder, 1), "OUTPUT": None, "TIE_POINTS": None}
    )
    assert done["OUTPUT"] is None
    assert done["OUTCOME"] == "aligned"
    say("align without an output: found and reported only")


def bands_and_masks(folder: Path) -> None:
    """MS as several layers, a raster mask with values, a vector mask."""
    import processing

    mask, report = square(folder), folder / "masks.json"
    done = processing.run(
        "geodelreg:check",
        {
            "MS": str(folder / "band 1.tif"),
            "MORE": [str(folder / f"band {number}.tif") for number in PAIRS[1:]],
            "PAN": str(folder / "pan 1.tif"),
            "MASK": [str(mask)],
            "PAN_MASK": [str(mask)],
            "REPORT": str(report),
        },
    )
    found = json.loads(report.read_text(encoding="utf-8"))
    assert done["OUTCOME"] == "misaligned"
    assert len(found["inputs"]["source"]["files"]) == len(PAIRS)
    assert [use["image"] for use in found["masks"]] == ["source", "reference"]
    assert {use["kind"] for use in found["masks"]} == {"vector"}
    say(f"check of three band files with two masks: {done['DISTANCE_PX']:.3f} px off")


def style(name: str) -> str:
    """File of one of the plugin's styles."""
    import geodelreg_qgis

    return str(Path(geodelreg_qgis.__file__).parent / "styles" / name)


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


def loaded(folder: Path) -> None:
    """What the layer panel holds when QGIS loads the results."""
    import processing

    project = QgsProject.instance()
    trees = []
    for name, parameters in (
        ("align", {**inputs(folder, 1), "OUTPUT": "TEMPORARY_OUTPUT", "MESH": "TEMPORARY_OUTPUT"}),
        (
            "alignbands",
            {
                "MS": [str(folder / f"band {number}.tif") for number in PAIRS],
                "PAN": str(folder / "pan 1.tif"),
                "OUTPUT": "TEMPORARY_OUTPUT",
                "MESH": None,
            },
        ),
    ):
        target = {**parameters, "TIE_POINTS": "TEMPORARY_OUTPUT"}
        processing.runAndLoadResults(f"geodelreg:{name}", target)
        QgsApplication.processEvents()
        (group,) = project.layerTreeRoot().children()
        trees.append([child.name() for child in group.children()])
        points = group.children()[0].layer()
        assert points.renderer().symbol().symbolLayer(1).layerType() == "GeometryGenerator"
        if name == "align":
            flip = group.findGroup("After / before")
            assert flip.isMutuallyExclusive()
            assert [(n.name(), n.isVisible()) for n in flip.children()] == [
                ("ms 1, aligned", True),
                ("Before", False),
            ]
        project.clear()
    assert trees == [
        ["Tie points", "Mesh", "After / before"],
        ["Tie points", *(f"band {number}, aligned" for number in reversed(PAIRS))],
    ], trees
    say("results come named, styled and grouped")
