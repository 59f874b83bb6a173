"""Theme and layout of each browser: light or dark by its preference or by a switch; a folded panel on phones."""

from __future__ import annotations

from typing import Any, Final

from softfinger.server.viewer.scripts import add_script, run_script

SETTINGS: Final[dict[str, Any]] = {"show_logo": False, "show_share_button": False, "control_width": "large"}
"""Settings of viser. Its panel of controls has the width of the theme, also in a window that was narrow."""
SWITCH: Final = (
    '<div style="padding: 0 0.75em 0.5em; text-align: right"><button type="button" role="switch" data-theme-switch '
    'aria-checked="false" style="font: inherit; font-size: 0.85em; color: inherit; background: none; cursor: pointer; '
    'border: none; padding: 0.2em">dark look</button></div>'
)


class Theme:
    """Theme switch, the script that reports its value, and the script of the layout."""

    def __init__(self, gui: Any) -> None:
        gui.configure_theme(**SETTINGS)
        gui.add_html(SWITCH)
        run_script(gui, "layout")
        self._field = add_script(gui, "theme")
        self._field.on_update(self._on_report)

    def _on_report(self, event: Any) -> None:
        chosen = self._field.value.split()[1:]
        if event.client is not None and chosen in (["dark"], ["light"]):
            event.client.gui.configure_theme(**SETTINGS, dark_mode=chosen == ["dark"])
