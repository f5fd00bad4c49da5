"""Runs that end otherwise: cancelled, refused, without a command."""

from __future__ import annotations

import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from helpers import PAIRS, Listening, files, inputs, refusal, say
from qgis.core import (
    QgsApplication,
    QgsCoordinateReferenceSystem,
    QgsProject,
    QgsRasterLayer,
    QgsVectorLayer,
)

CANCELLED_AFTER = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75)  # of the time that a whole run takes here


def cancel(folder: Path) -> None:
    """Cancel at six moments, in the same thread as QGIS runs algorithms in scripts."""
    import processing

    slowest, named = 0.0, set(folder.rglob("*geodelreg*"))
    for name in ("align", "pansharpen"):
        whole_s = min(_whole_run_s(folder, name) for _ in range(2))
        for wait in (part * whole_s for part in CANCELLED_AFTER):
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
            assert set(folder.rglob("*geodelreg*")) == named
    assert slowest < 2
    say(f"cancelled at {2 * len(CANCELLED_AFTER)} moments: over within {slowest:.2f} s, no debris")


def _whole_run_s(folder: Path, name: str) -> float:
    """How long a run takes that is not cancelled."""
    import processing

    with tempfile.TemporaryDirectory() as away:
        begun = time.monotonic()
        target = {**inputs(folder, 2), "OUTPUT": str(Path(away) / "whole.tif")}
        processing.run(f"geodelreg:{name}", target)
        return time.monotonic() - begun


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
    edited = QgsVectorLayer(str(folder / "Wölkchen.geojson"), "Edited", "ogr")
    part = QgsVectorLayer(str(folder / "Wölkchen.geojson"), "Part", "ogr")
    edited.startEditing()
    edited.deleteFeature(next(edited.getFeatures()).id())
    part.setSubsetString("kind = 'cloud'")
    project.addMapLayers([web, other, memory, edited, part])
    for message, expected in (
        (tried(MS=web), "web map"),
        (tried(MS=other), "in QGIS only"),
        (tried(MASK=[memory]), "kept in memory"),
        (tried(MASK=[edited]), "not saved"),
        (tried(MASK=[part]), "a part of its file"),
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
        provider = registry.providerById("geodelreg")
        old.write_text("#!/bin/sh\nprintf 'Commands:\\n  align  Correct\\n\\n'\n", encoding="utf-8")
        provider.refreshAlgorithms()
        able = {algorithm.name() for algorithm in provider.algorithms()}
        assert able == {"align", "alignbands", "install"}, able
    finally:
        setting.value = ""
        old.unlink()
        registry.providerById("geodelreg").refreshAlgorithms()
    say("no command, and an older one: told what to do")
