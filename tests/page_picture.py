"""`make page-picture`: docs/figures/page.jpg, the page in the browser with the shipped recording, drawn anew."""

from __future__ import annotations

from pathlib import Path

from helpers.browser import eventually, served

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "figures" / "page.jpg"
RECORDING, TICK = "press-roll-spin-drag", 8900
"""It is dragged along, still wound up from the spin."""
SIZE = {"width": 1100, "height": 760}


def main() -> None:
    """Serve the recording, look at it, and leave."""
    with served(RECORDING, "--tick", str(TICK)) as screen:
        screen.page.set_viewport_size(SIZE)
        eventually(lambda: screen.shows(f"tick {TICK}"))
        eventually(lambda: screen.page.locator(".uplot").count() >= 3)
        eventually(lambda: (screen.picture().std(axis=(0, 1)) > 20.0).all())
        screen.page.screenshot(path=PICTURE, type="jpeg", quality=82)
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main()
