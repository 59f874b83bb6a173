"""Scripts of this folder in the page, which tell by text fields what the page itself does not: keys, wheels, pads."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any, Final

FOLDER: Final = Path(__file__).parent
SHARED: Final = "field"
"""The script that all others begin with."""


def add_script(gui: Any, name: str) -> Any:
    """A hidden frame of the page that runs `NAME.js`, and the text field of that name that it writes to."""
    script = "".join((FOLDER / f"{each}.js").read_text("utf-8") for each in (SHARED, name))
    frame = html.escape(f"<script>{script}</script>", quote=True)
    gui.add_html(f'<iframe hidden aria-hidden="true" tabindex="-1" srcdoc="{frame}"></iframe>')
    return gui.add_text(name, "")
