"""A correction that was found before, applied to layers."""

from __future__ import annotations

import shutil
from pathlib import Path

from helpers import files, refusal, say
from qgis.core import QgsApplication, QgsProject, QgsRasterLayer, QgsVectorLayer


def applied(folder: Path) -> None:
    """A raster and two layers of one GeoPackage, loaded where they belong."""
    import processing

    raster = QgsRasterLayer(str(folder / "band 3.tif"), "Band")
    gpkg = folder / "Wege 2.gpkg"
    shutil.copy(folder / "Wege.gpkg", gpkg)
    layer = QgsVectorLayer(f"{gpkg}|layername=Wege", "Wege", "ogr")
    assert layer.isValid()
    layers = [raster, layer, layer.clone()]
    project = QgsProject.instance()
    project.addMapLayers(layers)
    was = [layer.extent() for layer in layers]
    done = processing.runAndLoadResults(
        "geodelreg:apply",
        {
            "CORRECTION": str(folder / "a.json"),
            "INPUT": [layer.id() for layer in layers],
            "FOLDER": "TEMPORARY_OUTPUT",
        },
    )
    QgsApplication.processEvents()
    assert Path(done["FOLDER"]).is_dir()
    assert len(done["LAYERS"]) == len(layers)
    for layer, before in zip(layers, was, strict=True):
        after = project.mapLayersByName(f"{layer.name()}, corrected")[0]
        moved = after.extent().center().distance(before.center())
        assert after.isValid()
        assert moved > 0
        assert layer.extent() == before
    project.clear()
    say("apply: a raster and a GeoPackage loaded where they belong, the old ones stay")


def applied_in_place(folder: Path) -> None:
    """The layer in the map is where its file says from then on, with its style."""
    import processing

    file = folder / "in place.tif"
    shutil.copy(folder / "band 3.tif", file)
    layer = QgsRasterLayer(str(file), "Band")
    layer.setOpacity(0.5)
    QgsProject.instance().addMapLayer(layer)
    before = layer.extent()
    processing.runAndLoadResults(
        "geodelreg:apply",
        {"CORRECTION": str(folder / "a.json"), "INPUT": [layer.id()], "IN_PLACE": True},
    )
    QgsApplication.processEvents()
    assert QgsProject.instance().mapLayers() == {layer.id(): layer}
    assert layer.isValid()
    assert layer.extent() != before
    assert layer.extent() == QgsRasterLayer(str(file), "").extent()
    assert layer.opacity() == 0.5
    QgsProject.instance().clear()
    say("apply in place: the layer in the map is opened again")


def not_applied(folder: Path) -> None:
    """Results that go nowhere or to two places, another scene, what is no report."""
    import processing

    before = files(folder)
    band, geojson = str(folder / "band 3.tif"), str(folder / "Äcker.geojson")
    one, several = str(folder / "never.tif"), str(folder / "never")
    memory = QgsVectorLayer("Polygon?crs=EPSG:32618", "Clouds", "memory")
    QgsProject.instance().addMapLayer(memory)
    for changed, expected in (
        ({}, "one of file, folder, in place"),
        ({"OUTPUT": one, "FOLDER": several}, "one of file, folder, in place"),
        ({"OUTPUT": one, "IN_PLACE": True}, "one of file, folder, in place"),
        ({"OUTPUT": one, "INPUT": [band, geojson]}, "choose a folder"),
        ({"OUTPUT": one, "INPUT": [memory]}, "kept in memory"),
        ({"OUTPUT": band}, "band 3.tif"),
        ({"INPUT": [geojson], "IN_PLACE": True}, "is a vector file, which has no header"),
        ({"OUTPUT": one, "CORRECTION": geojson}, "is no"),
        ({"OUTPUT": str(folder / "no" / "folder.tif")}, "folder"),
    ):
        target = {"CORRECTION": str(folder / "a.json"), "INPUT": [band], **changed}
        message = refusal(lambda target=target: processing.run("geodelreg:apply", target))
        assert expected in message, message
        print(f"    {message.splitlines()[-1]}")
    QgsProject.instance().removeAllMapLayers()
    assert files(folder) == before
    say("apply: refused in plain words, nothing written")
