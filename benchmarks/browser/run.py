"""Open the pages in headless Chromium: swipe, keyboard, touch, console, requests, accessibility."""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.browser.pages import PAIRS, Pages, make_pages

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
WIDE, PHONE = (1280, 900), (390, 844)
LINE_PX = 24
"""Beside the swipe line, where its handle is."""
_FOCUSED = "document.activeElement.id || document.activeElement.type"
_NUMBERS = (
    "[...document.querySelectorAll('#pairs tbody tr:not([hidden])')].map(r => +r.id.slice(5))"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--browser", help="Chromium to start; by default the one on PATH")
    parser.add_argument("--shots", type=Path, help="folder for screenshots of all pages")


@dataclass
class Visit:
    """A page that is open, and what it did that it must not do."""

    page: Any
    told: list[str] = field(default_factory=list)


class Browser:
    """A started browser that watches every page.

    Parameters
    ----------
    chromium
        As launched by Playwright.
    """

    def __init__(self, chromium: Any) -> None:
        self._chromium = chromium

    @contextmanager
    def visit(self, path: Path, size: tuple[int, int] = WIDE, **settings: Any) -> Iterator[Visit]:
        """Open a page; when the block ends it must have kept quiet and to itself."""
        width, height = size
        context = self._chromium.new_context(
            viewport={"width": width, "height": height}, **settings
        )
        visit = Visit(context.new_page())
        told, own = visit.told, path.as_uri()
        visit.page.on("console", lambda message: told.append(f"console: {message.text}"))
        visit.page.on("pageerror", lambda error: told.append(f"error: {error}"))
        visit.page.on("dialog", lambda dialog: told.append(f"dialog: {dialog.message}"))
        visit.page.on(
            "request",
            lambda request: told.extend(_beyond(request.url, own)),
        )
        visit.page.goto(own)
        try:
            yield visit
            assert not told, told
        finally:
            context.close()


def _beyond(address: str, own: str) -> list[str]:
    """What to say of a request: nothing of the page itself and of data inside it."""
    return [] if address.startswith(("data:", own)) else [f"request: {address}"]


def check_quiet_and_accessible(browser: Browser, pages: Pages, shots: Path | None) -> None:
    """Every page, wide and on a phone, light and dark: axe-core is content, nothing overflows."""
    from axe_playwright_python.sync_playwright import Axe

    for name, path in pages.named().items():
        for scheme in ("light", "dark"):
            for label, size in (("wide", WIDE), ("phone", PHONE)):
                with browser.visit(path, size, color_scheme=scheme) as visit:
                    found = Axe().run(visit.page).response["violations"]
                    assert not found, [
                        (v["id"], [node["html"][:120] for node in v["nodes"]][:3]) for v in found
                    ]
                    wide = visit.page.evaluate("document.documentElement.scrollWidth")
                    assert wide <= size[0], f"{name}, {label}: {wide} px wide"
                    if shots is not None:
                        shot = shots / f"{name}_{label}_{scheme}.png"
                        visit.page.screenshot(path=shot, full_page=True)


def check_swipe(browser: Browser, pages: Pages, shots: Path | None) -> None:
    """Mouse, touch and keyboard move the line, and what is on either side is what it should be."""
    with browser.visit(pages.good, has_touch=True) as visit:
        page = visit.page
        stage, line = page.locator(".stage").first, page.locator(".stage input").first
        stage.scroll_into_view_if_needed()
        line.press("End")
        left = _picture(stage)
        line.press("Home")
        right = _picture(stage)
        assert np.abs(left - right).mean() > 3, "both sides look the same"
        assert line.input_value() == "0"
        for _ in range(5):
            line.press("ArrowRight")
        assert line.input_value() == "5"
        box = stage.bounding_box()
        y = box["y"] + box["height"] / 4
        page.mouse.move(box["x"] + 0.3 * box["width"], y)
        page.mouse.down()
        page.mouse.move(box["x"] + 0.6 * box["width"], y, steps=5)
        page.mouse.up()
        assert 57 <= int(line.input_value()) <= 63, line.input_value()
        _check_halves(_picture(stage), left, right, int(line.input_value()))
        _drag_by_finger(
            page, (box["x"] + 0.6 * box["width"], y), (box["x"] + 0.2 * box["width"], y)
        )
        assert 17 <= int(line.input_value()) <= 23, line.input_value()
        _check_halves(_picture(stage), left, right, int(line.input_value()))
        said = line.get_attribute("aria-valuetext")
        assert said.startswith(f"{line.input_value()} % overlay as delivered"), said


def _drag_by_finger(page: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    session = page.context.new_cdp_session(page)
    steps = [tuple(np.add(start, np.subtract(end, start) * t)) for t in np.linspace(0, 1, 6)]
    for kind, spots in (
        ("touchStart", steps[:1]), *(("touchMove", [spot]) for spot in steps[1:]), ("touchEnd", []),
    ):  # fmt: skip
        points = [{"x": float(x), "y": float(y)} for x, y in spots]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def _picture(stage: Any) -> np.ndarray[Any, Any]:
    """(H, W) grey values of the stage, without the labels at its foot."""
    image = cv2.imdecode(np.frombuffer(stage.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image[: int(0.85 * len(image))].astype(np.float64)


def _check_halves(
    seen: np.ndarray[Any, Any], left: np.ndarray[Any, Any], right: np.ndarray[Any, Any], at: int
) -> None:
    line = round(seen.shape[1] * at / 100)
    for part, wanted in (
        (np.s_[:, LINE_PX : line - LINE_PX], left),
        (np.s_[:, line + LINE_PX : -LINE_PX], right),
    ):
        assert np.abs(seen[part] - wanted[part]).mean() < 0.5


def check_reach(browser: Browser, pages: Pages, shots: Path | None) -> None:
    """The keyboard alone reaches the controls and the line."""
    with browser.visit(pages.good) as visit:
        reached = []
        for _ in range(8):
            visit.page.keyboard.press("Tab")
            reached.append(visit.page.evaluate(_FOCUSED))
        assert reached[0] == "compare"
        assert "range" in reached, reached


def check_modes(browser: Browser, pages: Pages, shots: Path | None) -> None:
    """Blink can be paused, and does not move for those who want no motion; checkerboard weaves."""
    with browser.visit(pages.good) as visit:
        page, stage = visit.page, visit.page.locator(".stage").first
        page.locator(".stage input").first.press("End")
        left = _picture(stage)
        page.check("input[value=checker]")
        woven = _picture(stage)
        share = float((np.abs(woven - left) < 1).mean())
        assert 0.4 < share < 0.95, share
        page.check("input[value=blink]")
        moving = "getComputedStyle(document.querySelector('.stage img.left')).animationName"
        assert page.evaluate(moving) == "blink"
        page.click("#pause")
        assert page.evaluate(moving) == "none"
        page.select_option("#compare", index=1)
        assert page.locator(".stage img.left").first.get_attribute("data-view") == "pan"
    with browser.visit(pages.good, reduced_motion="reduce") as visit:
        page = visit.page
        page.check("input[value=blink]")
        assert page.evaluate(moving) == "none"
        page.click("#pause")
        assert not page.locator(".stage img.left").first.is_visible()


def check_layers(browser: Browser, pages: Pages, shots: Path | None) -> None:
    """Each reason for rejecting points has a box that shows and hides them."""
    with browser.visit(pages.good) as visit:
        boxes = visit.page.locator("input[data-layer]")
        assert boxes.count() >= 1
        for box in boxes.all():
            layer = visit.page.locator(f"#{box.get_attribute('data-layer')}")
            assert layer.is_visible() == box.is_checked()
            box.click()
            assert layer.is_visible() == box.is_checked()


def check_index(browser: Browser, pages: Pages, shots: Path | None) -> None:
    """The table sorts and filters, the map follows it, and links lead to pages."""
    with browser.visit(pages.index) as visit:
        page = visit.page
        rows, shapes = page.locator("#pairs tbody tr"), page.locator("[data-pair]")
        assert rows.count() == PAIRS
        assert page.evaluate(_NUMBERS) == list(range(1, PAIRS + 1))
        page.click("#pairs th:first-child button")
        assert page.evaluate(_NUMBERS) == list(range(PAIRS, 0, -1))
        page.click("text=Off by")
        offsets = page.evaluate(
            "[...document.querySelectorAll('#pairs tbody tr')]"
            ".map(r => r.cells[4].dataset.value).filter(v => v !== '').map(Number)"
        )
        assert offsets == sorted(offsets)
        assert len(offsets) > PAIRS / 2
        page.fill("#find", "scene_01")
        assert sorted(page.evaluate(_NUMBERS)) == list(range(10, 20))
        shown = [s for s in shapes.all() if s.is_visible()]
        assert 0 < len(shown) <= 10
        page.fill("#find", "")
        page.uncheck("input[value=aligned]")
        assert page.locator("#pairs tr[data-outcome=aligned]:visible").count() == 0
        page.check("input[value=aligned]")
        shapes.first.click()
        assert page.locator("#pairs tr.chosen").count() == 1
    with browser.visit(pages.index) as visit:
        visit.page.click("#pair-1 a")
        assert "Aligned" in visit.page.title()
        visit.told[:] = [told for told in visit.told if "/pairs/000001.html" not in told]


CHECKS: tuple[Callable[[Browser, Pages, Path | None], None], ...] = (
    check_swipe, check_reach, check_modes, check_layers, check_index, check_quiet_and_accessible,
)  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Make the pages, open them, and say what held; 1 when something did not."""
    from playwright.sync_api import sync_playwright

    executable = args.browser or next(filter(None, map(shutil.which, BROWSERS)), None)
    if executable is None:
        print("No Chromium on PATH: install one, or name it with --browser.")
        return 2
    if args.shots is not None:
        args.shots.mkdir(parents=True, exist_ok=True)
    failed = 0
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        start = time.perf_counter()
        pages = make_pages(Path(name))
        print(f"pages made in {time.perf_counter() - start:.1f} s")
        chromium = playwright.chromium.launch(executable_path=executable, args=list(FLAGS))
        for check in CHECKS:
            start = time.perf_counter()
            try:
                check(Browser(chromium), pages, args.shots)
                said = "ok"
            except AssertionError as error:
                failed += 1
                said = f"FAILED: {error}"
            print(f"{check.__name__}: {said} ({time.perf_counter() - start:.1f} s)")
        chromium.close()
    return 1 if failed else 0
