"""A page as a browser takes it apart, by the parser of Python's library."""

from __future__ import annotations

import base64
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


class Page(HTMLParser):
    """Elements and texts of a page.

    Attributes
    ----------
    elements : list of (str, dict)
        Names and attributes, in order.
    texts : dict of str to list of str
        What stands inside the elements of a name.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.source = path.read_text(encoding="utf-8")
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: dict[str, list[str]] = {}
        self._open: list[str] = []
        self.feed(self.source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        for tag in set(self._open):
            self.texts.setdefault(tag, []).append(data)

    def all(self, tag: str, **wanted: str) -> list[dict[str, str]]:
        """Attributes of the elements of a name that have some values."""
        return [
            attributes
            for name, attributes in self.elements
            if name == tag and wanted.items() <= attributes.items()
        ]

    @property
    def text(self) -> str:
        """What is there to read, with single spaces."""
        unseen = "".join(self.texts.get("style", []) + self.texts.get("script", []))
        seen = [text for text in self.texts.get("body", []) if text not in unseen]
        return " ".join(" ".join(seen).split())

    def addresses(self) -> list[str]:
        """Whatever the page would fetch, or lead to."""
        names = ("src", "href", "xlink:href", "data", "action", "srcset", "poster")
        return [a[name] for _, a in self.elements for name in names if name in a]


def picture(uri: str) -> NDArray[Any]:
    """Grey values of a picture inside a page."""
    encoded = base64.b64decode(uri.partition(",")[2])
    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image.astype(np.float64)


def likeness(image: NDArray[Any], wanted: NDArray[Any]) -> float:
    """Correlation of ranks of two pictures: 1 where one is a stretched form of the other."""
    seen = np.isfinite(wanted)
    ranks = [np.argsort(np.argsort(one[seen], kind="stable")) for one in (image, wanted)]
    return float(np.corrcoef(ranks)[0, 1])
