"""For mkdocstrings: our docstrings as Markdown, where columns and examples would flow together."""

import re
from typing import Any

from griffe import Extension, Object


def _columns(paragraph: str) -> bool:
    """Lines of names and what they are, two spaces or more between."""
    return bool(re.match(r"\S+(?:, \S+)*  +\S", paragraph))


def _table(paragraph: str) -> str:
    """Those lines as a table: name, and what it is; lines further in go on with the one before."""
    rows: list[str] = []
    for line in paragraph.splitlines():
        if line.startswith(" "):
            rows[-1] += " " + line.strip()
        else:
            name, *rest = re.split(r"  +", line)
            rows.append(f"| `{name}` | " + "; ".join(rest).replace("|", r"\|"))
    return "\n".join(["| | |", "|---|---|", *(f"{row} |" for row in rows)])


def as_markdown(text: str) -> str:
    """Return the docstring with examples fenced, and columns as tables."""
    parts = []
    for paragraph in text.split("\n\n"):
        if paragraph.startswith(">>>"):
            paragraph = f"```pycon\n{paragraph}\n```"
        elif _columns(paragraph):
            paragraph = _table(paragraph)
        parts.append(paragraph)
    return "\n\n".join(parts)


class Docstrings(Extension):
    """Rewrites each docstring once, as it is collected."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = as_markdown(obj.docstring.value)
