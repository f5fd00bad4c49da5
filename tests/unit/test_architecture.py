"""Promises of the layout that no linter knows: half pixels, sizes, optional libraries."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted([*ROOT.glob("geodelreg/**/*.py"), *ROOT.glob("cli/**/*.py")])
HALF = re.compile(r"[-+]\s*(?:0?\.5\b(?!\s*\*)|HALF_PIXEL)|\b0?\.5\s*[-+]")

# Lines that add or subtract one half and are no change of pixel convention, and why.
HALVES_OF_OTHER_THINGS = {
    "geodelreg/product/figures.py: "
    "Rectangle((columns.start - 0.5, rows.start - 0.5), *size, fill=False, ec=_ACCENT, lw=1.5)": (
        "matplotlib draws pixel (0, 0) of an image from -0.5 to 0.5"
    ),
    "geodelreg/report/figures.py: "
    'values, extent=(-0.5, width - 0.5, height - 0.5, -0.5), cmap="cividis", alpha=0.8,': (
        "matplotlib draws pixel (0, 0) of an image from -0.5 to 0.5"
    ),
    "geodelreg/report/figures.py: "
    "axes.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))": (
        "matplotlib draws pixel (0, 0) of an image from -0.5 to 0.5"
    ),
    "geodelreg/report/residuals.py: start + (np.arange(count) + 0.5) * size / count": (
        "the middle of each part of a window"
    ),
    "geodelreg/report/words.py: "
    'halves = {low: share < 0.5, high: share > 0.5, "middle": np.abs(share - 0.5) < 0.25}': (
        "the middle of the picture"
    ),
}


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_there_are_sources() -> None:
    assert ROOT / "geodelreg" / "geo" / "pixel.py" in SOURCES


def test_only_geo_pixel_converts_between_pixel_centres_and_corners() -> None:
    found = {
        f"{relative(path)}: {line.strip()}"
        for path in SOURCES
        if relative(path) != "geodelreg/geo/pixel.py"
        for line in path.read_text(encoding="utf-8").splitlines()
        if HALF.search(line.partition("#")[0])
    }
    assert found == set(HALVES_OF_OTHER_THINGS)


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_modules_stay_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) < 400


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_drawing_libraries_are_optional(path: Path) -> None:
    imports = r"^(?:import|from) (?:matplotlib|jinja2)\b"
    assert not re.search(imports, path.read_text(encoding="utf-8"), re.M)
