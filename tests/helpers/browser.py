"""Headless Chromium (Debian's, WebGL in software), driven by playwright."""

import io
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from helpers import waits
from softfinger.tools.bench.view import ARGUMENTS, run_viewer

WAIT_S = 180.0
"""Generous limit: the page is rendered in software, on a machine that may be busy or pause."""
SIZE = (840, 520)
"""Size of the window in pixels. Small, since the CPU renders each pixel."""


CAMERA = """() => {
    const page = window.__viserMutable, world = page.nodeRefFromName["/objects"];
    world.updateWorldMatrix(true, false);
    page.camera.updateMatrixWorld();
    return [world.matrixWorld, page.camera.matrixWorldInverse, page.camera.projectionMatrix].map(each => each.elements);
}"""
"""Matrices, column by column: pose of the page's world, view of the camera, projection."""


def why_none() -> str:
    """Return the reason why no browser is available, or an empty text."""
    if shutil.which("chromium") is None:
        return "Chromium is not installed: run `make browser` (package chromium of Debian)"
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "no playwright: make setup"
    return ""


eventually = partial(waits.eventually, seconds=WAIT_S, every_s=0.1)


def coloured(picture: NDArray[np.int64]) -> dict[str, int]:
    """Count the pixels of each colour with a meaning: red and blue of the modes, orange of the torsional moment."""
    r, g, b = picture[..., 0], picture[..., 1], picture[..., 2]
    return {
        "red": int(((r - g > 70) & (abs(g - b) < 40)).sum()),
        "blue": int(((b - r > 70) & (b - g > 25)).sum()),
        "orange": int(((r - b > 120) & (g - b > 60)).sum()),
    }


class Screen:
    def __init__(self, page: Any) -> None:
        self.page = page

    def picture(self) -> NDArray[np.int64]:
        """Return the colours (height, width, 3) of the canvas."""
        from PIL import Image

        box = self.page.locator("canvas").first.bounding_box()
        image = Image.open(io.BytesIO(self.page.screenshot(timeout=1e3 * WAIT_S))).convert("RGB")
        x, y, w, h = (round(box[key]) for key in ("x", "y", "width", "height"))
        return np.array(image.crop((x, y, x + w, y + h))).astype(np.int64)

    def at(self, point: tuple[float, float, float]) -> tuple[float, float]:
        """Return the screen position of a point of the page's world, for the present camera of the page."""
        box = self.page.locator("canvas").first.bounding_box()
        world, view, projection = (np.reshape(matrix, (4, 4)).T for matrix in self.page.evaluate(CAMERA))
        x, y, _, w = projection @ view @ world @ (*point, 1.0)
        return box["x"] + 0.5 * box["width"] * (1.0 + x / w), box["y"] + 0.5 * box["height"] * (1.0 - y / w)

    def drag(self, start: tuple[float, float], distance: tuple[float, float], key: str | None = None) -> None:
        """Drag the mouse from `start` by `distance` pixels in steps, optionally with a key pressed."""
        mouse, keyboard = self.page.mouse, self.page.keyboard
        if key is not None:
            keyboard.down(key)
        mouse.move(*start)
        mouse.down()
        for share in np.linspace(0.1, 1.0, 10):
            mouse.move(start[0] + share * distance[0], start[1] + share * distance[1])
            time.sleep(0.1)
        mouse.up()
        if key is not None:
            keyboard.up(key)

    def touch(self, start: tuple[float, float], distance: tuple[float, float]) -> None:
        """Drag one finger from `start` by `distance` pixels in steps, with events of a touch screen."""
        session = self.page.context.new_cdp_session(self.page)
        for share in np.linspace(0.0, 1.0, 11):
            at = {"x": start[0] + share * distance[0], "y": start[1] + share * distance[1]}
            kind = "touchMove" if share else "touchStart"
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [at]})
            time.sleep(0.1)
        session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    def choose(self, label: str, value: str) -> None:
        field = self.page.locator(f"xpath=//label[normalize-space()={label!r}]/following::input[1]")
        field.click(timeout=1e3 * WAIT_S)
        self.page.get_by_role("option", name=value, exact=True).click(timeout=1e3 * WAIT_S)

    def fill(self, label: str, value: str) -> None:
        """Write a number into the field of a slider."""
        field = self.page.locator(f"xpath=//label[normalize-space()={label!r}]/following::input[@type='text'][1]")
        field.fill(value, timeout=1e3 * WAIT_S)
        field.press("Enter")

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click(timeout=1e3 * WAIT_S)

    def shows(self, text: str) -> bool:
        return bool(self.page.get_by_text(text).count())


@contextmanager
def browser() -> Iterator[Any]:
    """Open an empty page in a new browser."""
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
    """Open an address and wait until its canvas exists."""
    page.goto(address)
    page.locator("canvas").first.wait_for()
    page.add_style_tag(content=".mantine-Notifications-root { display: none }")  # notifications cover the canvas
    return Screen(page)


@contextmanager
def served(*words: str) -> Iterator[Screen]:
    """Run `softfinger view` with these arguments in a process, and open its page."""
    with run_viewer(*words) as (_, address), browser() as page:
        yield shown(page, address)
