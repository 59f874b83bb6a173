"""Who sits before the page, and what it may ask of the daemon."""

from __future__ import annotations

from enum import StrEnum
from typing import Final


class Role(StrEnum):
    """Who sits before the page.

    operator     sees everything and may do everything
    watcher      sees everything and changes nothing
    participant  sees prompts and answers them: no picture and no figure tells what is rendered
    """

    OPERATOR = "operator"
    WATCHER = "watcher"
    PARTICIPANT = "participant"


ALLOWED: Final[dict[Role, frozenset[str] | None]] = {
    Role.OPERATOR: None,
    Role.WATCHER: frozenset({"describe", "mesh", "get_prompt"}),
    Role.PARTICIPANT: frozenset({"get_prompt", "answer"}),
}
"""Commands of each; None: all. Whatever a browser sends, the page sends no others."""
