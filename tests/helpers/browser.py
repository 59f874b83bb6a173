"""A real browser without a screen: Debian's Chromium with WebGL in software, driven by playwright."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

import numpy as np
from numpy.typing import NDArray

from softfinger.tools.bench.view import ARGUMENTS, viewer

WAIT_S = 180.0
"""A generous bound: a page drawn in software, on a machine that does much else and stands still at times."""
SIZE = (840, 520)
"""Of the window, pixels: small, since each is painted by a processor."""


CAMERA = """() => {
    const page = window.__viserMutable, world = page.nodeRefFromName["/objects"];
    world.updateWorldMatrix(true, false);
    page.camera.updateMatrixWorld();
    return [world.matrixWorld, page.camera.matrixWorldInverse, page.camera.projectionMatrix].map(each => each.elements);
}"""
"""Matrices, column by column: the page's world, the camera's view of that, and its picture."""


def why_none() -> str:
    """Why there is no browser here; empty where there is one."""
    if shutil.which("chromium") is None:
        return "no Chromium: make browser (Debian's package chromium)"
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "no playwright: make setup"
    return ""


def answered(address: str) -> int:
    """The status of a page's answer, once anything answers there."""
    while True:
        try:
            with urlopen(address, timeout=60.0) as answer:
                return int(answer.status)
        except URLError:
            time.sleep(0.02)


def eventually(true: Callable[[], Any], every_s: float = 0.1) -> Any:
    """What `true` returns once it is true, or in the end."""
    until = time.monotonic() + WAIT_S
    while not (found := true()) and time.monotonic() < until:
        time.sleep(every_s)
    return found


def coloured(picture: NDArray[np.int64]) -> dict[str, int]:
    """Pixels of each colour that has a meaning: red and blue of the modes, orange of the torsional moment."""
    r, g, b = picture[..., 0], picture[..., 1], picture[..., 2]
    return {
        "red": int(((r - g > 70) & (abs(g - b) < 40)).sum()),
        "blue": int(((b - r > 70) & (b - g > 25)).sum()),
        "orange": int(((r - b > 120) & (g - b > 60)).sum()),
    }


class Screen:
    """A page in the browser."""

    def __init__(self, page: Any) -> None:
        self.page = page

    def picture(self) -> NDArray[np.int64]:
        """Colours (height, width, 3) of the picture, without what stands beside it."""
        from PIL import Image

        box = self.page.locator("canvas").first.bounding_box()
        image = Image.open(io.BytesIO(self.page.screenshot(timeout=1e3 * WAIT_S))).convert("RGB")
        x, y, w, h = (round(box[key]) for key in ("x", "y", "width", "height"))
        return np.array(image.crop((x, y, x + w, y + h))).astype(np.int64)

    def at(self, point: tuple[float, float, float]) -> tuple[float, float]:
        """Where a point of the page's world is on the screen, as the page's own camera sees it now."""
        box = self.page.locator("canvas").first.bounding_box()
        world, view, projection = (np.reshape(each, (4, 4)).T for each in self.page.evaluate(CAMERA))
        x, y, _, w = projection @ view @ world @ (*point, 1.0)
        return box["x"] + 0.5 * box["width"] * (1.0 + x / w), box["y"] + 0.5 * box["height"] * (1.0 - y / w)

    def drag(self, start: tuple[float, float], way: tuple[float, float], key: str | None = None) -> None:
        """Take hold there and go so far, in steps, with a key held or none."""
        mouse, keyboard = self.page.mouse, self.page.keyboard
        if key is not None:
            keyboard.down(key)
        mouse.move(*start)
        mouse.down()
        for share in np.linspace(0.1, 1.0, 10):
            mouse.move(start[0] + share * way[0], start[1] + share * way[1])
            time.sleep(0.1)
        mouse.up()
        if key is not None:
            keyboard.up(key)

    def touch(self, start: tuple[float, float], way: tuple[float, float]) -> None:
        """Put a finger there, go so far with it, in steps, and take it away: events of a touch screen."""
        session = self.page.context.new_cdp_session(self.page)
        for share in np.linspace(0.0, 1.0, 11):
            at = {"x": start[0] + share * way[0], "y": start[1] + share * way[1]}
            kind = "touchMove" if share else "touchStart"
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [at]})
            time.sleep(0.1)
        session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    def choose(self, label: str, value: str) -> None:
        """Take a value of a dropdown."""
        field = self.page.locator(f"xpath=//label[normalize-space()={label!r}]/following::input[1]")
        field.click(timeout=1e3 * WAIT_S)
        self.page.get_by_role("option", name=value, exact=True).click(timeout=1e3 * WAIT_S)

    def fill(self, label: str, value: str) -> None:
        """Write a number into the field beside a slider."""
        field = self.page.locator(f"xpath=//label[normalize-space()={label!r}]/following::input[@type='text'][1]")
        field.fill(value, timeout=1e3 * WAIT_S)
        field.press("Enter")

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click(timeout=1e3 * WAIT_S)

    def shows(self, text: str) -> bool:
        """Whether a text is to be read."""
        return bool(self.page.get_by_text(text).count())


@contextmanager
def browser() -> Iterator[Any]:
    """An empty page of a new browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tool:
        started = tool.chromium.launch(
            executable_path=shutil.which("chromium"), args=ARGUMENTS, headless=True, timeout=1e3 * WAIT_S
        )
        try:
            page = started.new_page(viewport={"width": SIZE[0], "height": SIZE[1]}, has_touch=True)
            page.set_default_timeout(1e3 * WAIT_S)
            yield page
        finally:
            started.close()


def shown(page: Any, address: str) -> Screen:
    """A page of a browser, once the picture of what is served there has its place."""
    page.goto(address)
    page.locator("canvas").first.wait_for()
    page.add_style_tag(content=".mantine-Notifications-root { display: none }")  # it lies over the picture
    return Screen(page)


@contextmanager
def served(*words: str) -> Iterator[Screen]:
    """`softfinger view` with these words in a process of its own, in a browser."""
    with viewer(*words) as (_, address), browser() as page:
        yield shown(page, address)
