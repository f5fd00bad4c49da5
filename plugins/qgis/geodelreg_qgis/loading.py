"""How results look when QGIS loads them: names, styles, and one layer group a run."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, ClassVar

from qgis.core import (
    QgsLayerTreeGroup,
    QgsMapLayer,
    QgsMapLayerStyle,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingLayerPostProcessorInterface,
    QgsProject,
    QgsRasterLayer,
)
from qgis.PyQt.QtCore import QTimer

from geodelreg_qgis.base import HERE


class Styled(QgsProcessingLayerPostProcessorInterface):
    """Gives one result its style, then hands it on."""

    _alive: ClassVar[list[Styled]] = []
    """QGIS keeps no reference to them."""

    def __init__(self, style: str, then: Callable[[QgsMapLayer], None]) -> None:
        super().__init__()
        self._style, self._then = style, then
        self._alive.append(self)

    def postProcessLayer(
        self, layer: QgsMapLayer, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> None:
        """Called by QGIS in its main thread when the layer is in the project."""
        if self._style:
            layer.loadNamedStyle(os.fspath(HERE / "styles" / self._style))
            layer.triggerRepaint()
        self._then(layer)


def load(
    context: QgsProcessingContext,
    layer: str | None,
    name: str,
    style: str = "",
    then: Callable[[QgsMapLayer], None] = lambda layer: None,
) -> None:
    """Have a result named and styled, if QGIS is going to load it.

    Parameters
    ----------
    layer : str or None
        What QGIS calls the result.
    style : str
        File in ``styles``.
    then : callable
        Called with the layer when it is in the project.
    """
    if layer and context.willLoadLayerOnCompletion(layer):
        details = context.layerToLoadOnCompletionDetails(layer)
        details.name, details.forceName = name, True
        details.setPostProcessor(Styled(style, then))


class ResultGroup:
    """A layer group for one run: what was found above, then before and after to flip between.

    QGIS puts results into its layer tree before or after it calls the post-processors, depending on
    its version, so the layers are moved when it is done.

    Parameters
    ----------
    title : str
    before : str
        File of the raster as it was; empty when there are several, which are not flipped.
    project_layer : str
        Id of its layer in the project, whose style the result gets; may be empty.
    """

    def __init__(self, title: str, before: str, project_layer: str) -> None:
        self._title, self._before, self._project_layer = title, before, project_layer
        self._waiting: list[str] = []
        self._group: QgsLayerTreeGroup | None = None
        self._flip: QgsLayerTreeGroup | None = None

    def load(self, context: QgsProcessingContext, layer: str, name: str, style: str = "") -> None:
        """`load` a result, and have it put into the group."""
        load(context, layer, name, style, self._take)

    def _take(self, layer: QgsMapLayer) -> None:
        self._waiting.append(layer.id())
        QTimer.singleShot(0, self._arrange)

    def _arrange(self) -> None:
        project = QgsProject.instance()
        root = project.layerTreeRoot()
        while self._waiting:
            node = root.findLayer(self._waiting.pop(0))
            if node is None:
                continue  # removed meanwhile
            if self._group is None:
                self._group = root.insertGroup(0, self._title)
            parent = self._group
            if self._before and isinstance(node.layer(), QgsRasterLayer):
                parent = self._before_and_after(project, node.layer())
            moved = node.clone()
            moved.setExpanded(False)
            parent.insertChildNode(0, moved)
            for group in (self._group, parent):
                group.setExpanded(False)  # the panel opens on a change, and had nothing to open
                group.setExpanded(True)
            node.parent().removeChildNode(node)
            if self._flip is not None:
                self._flip.setIsMutuallyExclusive(True, 0)

    def _before_and_after(self, project: QgsProject, after: QgsRasterLayer) -> QgsLayerTreeGroup:
        """Group of the raster as it is and as it was; only one of the two is seen at a time."""
        if self._flip is not None:
            return self._flip
        assert self._group is not None
        known: Any = project.mapLayer(self._project_layer)
        was = known.clone() if known else QgsRasterLayer(self._before, "")
        was.setName("Before")
        style = QgsMapLayerStyle()
        style.readFromLayer(was)
        style.writeToLayer(after)
        after.triggerRepaint()
        self._flip = self._group.addGroup("After / before")
        project.addMapLayer(was, False)
        self._flip.addLayer(was)
        return self._flip
