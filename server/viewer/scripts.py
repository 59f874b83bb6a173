"""JavaScript of this folder on the page; it reports keys, wheels and gamepads, which viser does not, by text fields."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any, Final

FOLDER: Final = Path(__file__).parent
SHARED_SCRIPT: Final = "field"
"""Script that precedes all others."""


def add_script(gui: Any, name: str) -> Any:
    """Add a hidden frame that runs `NAME.js`; return the text field of that name, to which the script writes."""
    run_script(gui, name)
    return gui.add_text(name, "")


def run_script(gui: Any, name: str) -> None:
    """Add a hidden frame that runs `NAME.js`."""
    script = "".join((FOLDER / f"{each}.js").read_text("utf-8") for each in (SHARED_SCRIPT, name))
    frame = html.escape(f"<script>{script}</script>", quote=True)
    gui.add_html(f'<iframe hidden aria-hidden="true" tabindex="-1" srcdoc="{frame}"></iframe>')
