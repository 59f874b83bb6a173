"""Roles of a page's user, and the commands that each may send."""

from __future__ import annotations

from enum import StrEnum
from typing import Final


class Role(StrEnum):
    """Role of a page's user.

    operator     full view, all commands
    watcher      full view, no changes
    participant  prompts and their answers only: no picture or number reveals what is rendered
    """

    OPERATOR = "operator"
    WATCHER = "watcher"
    PARTICIPANT = "participant"


ALLOWED: Final[dict[Role, frozenset[str] | None]] = {
    Role.OPERATOR: None,
    Role.WATCHER: frozenset({"describe", "mesh", "get_prompt"}),
    Role.PARTICIPANT: frozenset({"get_prompt", "answer"}),
}
"""Commands allowed per role; None: all. The page sends no others, whatever a browser requests."""
