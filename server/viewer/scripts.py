"""JavaScript of this folder on the page; it reports keys, wheels and gamepads, which viser does not, by text fields.

It also sets the theme and layout of each browser: light or dark by its preference or by a switch, a folded panel on
phones.
"""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any, Final

FOLDER: Final = Path(__file__).parent
SHARED_SCRIPT: Final = "field"
"""Script that precedes all others."""
SETTINGS: Final[dict[str, Any]] = {"show_logo": False, "show_share_button": False, "control_width": "large"}
"""Settings of viser. Its panel of controls has the width of the theme, also in a window that was narrow."""
SWITCH: Final = (
    '<div style="padding: 0 0.75em 0.5em; text-align: right"><button type="button" role="switch" data-theme-switch '
    'aria-checked="false" style="font: inherit; font-size: 0.85em; color: inherit; background: none; cursor: pointer; '
    'border: none; padding: 0.2em">dark look</button></div>'
)


def run_script(gui: Any, name: str) -> None:
    """Run `NAME.js` in a hidden frame of the page."""
    script = "".join((FOLDER / f"{script_name}.js").read_text("utf-8") for script_name in (SHARED_SCRIPT, name))
    frame = html.escape(f"<script>{script}</script>", quote=True)
    gui.add_html(f'<iframe hidden aria-hidden="true" tabindex="-1" srcdoc="{frame}"></iframe>')


def add_script(gui: Any, name: str) -> Any:
    """Run `NAME.js`; return the text field of that name, to which the script writes."""
    run_script(gui, name)
    return gui.add_text(name, "")


def add_theme(gui: Any) -> None:
    """Add the theme switch, the script that reports its value, and the script of the layout."""
    gui.configure_theme(**SETTINGS)
    gui.add_html(SWITCH)
    run_script(gui, "layout")
    field = add_script(gui, "theme")

    def on_report(event: Any) -> None:
        chosen = field.value.split()[1:]
        if event.client is not None and chosen in (["dark"], ["light"]):
            event.client.gui.configure_theme(**SETTINGS, dark_mode=chosen == ["dark"])

    field.on_update(on_report)
