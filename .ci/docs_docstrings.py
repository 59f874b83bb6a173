"""mkdocstrings extension: convert columns and examples of docstrings to Markdown tables and code blocks."""

import re
from typing import Any

from griffe import Extension, Object


def _columns(paragraph: str) -> bool:
    """Return True for lines of names and descriptions, separated by two or more spaces."""
    return bool(re.match(r"\S+(?:, \S+)*  +\S", paragraph))


def _table(paragraph: str) -> str:
    """Return these lines as a table of names and descriptions; indented lines continue the previous one."""
    rows: list[str] = []
    for line in paragraph.splitlines():
        if line.startswith(" "):
            rows[-1] += " " + line.strip()
        else:
            name, *rest = re.split(r"  +", line)
            rows.append(f"| `{name}` | " + "; ".join(rest).replace("|", r"\|"))
    return "\n".join(["| | |", "|---|---|", *(f"{row} |" for row in rows)])


def as_markdown(text: str) -> str:
    """Return the docstring with fenced examples, and columns as tables."""
    parts = []
    for paragraph in text.split("\n\n"):
        if paragraph.startswith(">>>"):
            paragraph = f"```pycon\n{paragraph}\n```"
        elif _columns(paragraph):
            paragraph = _table(paragraph)
        parts.append(paragraph)
    return "\n\n".join(parts)


class Docstrings(Extension):
    """Convert each docstring when it is collected."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = as_markdown(obj.docstring.value)
