"""For mkdocstrings: our docstrings as Markdown, where columns and examples would flow together."""

import re
from typing import Any

from griffe import Extension, Object


def _columns(paragraph: str) -> bool:
    """Lines of names and what they are, two spaces or more between."""
    return bool(re.match(r"\S+(?:, \S+)*  +\S", paragraph))


def as_markdown(text: str) -> str:
    """The docstring with what is laid out by hand fenced."""
    parts = []
    for paragraph in text.split("\n\n"):
        if paragraph.startswith(">>>"):
            paragraph = f"```pycon\n{paragraph}\n```"
        elif _columns(paragraph):
            paragraph = f"```text\n{paragraph}\n```"
        parts.append(paragraph)
    return "\n\n".join(parts)


class Docstrings(Extension):
    """Rewrites each docstring once, as it is collected."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = as_markdown(obj.docstring.value)
