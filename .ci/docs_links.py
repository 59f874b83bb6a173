"""mkdocs hook: convert links to files outside docs/ to links to the code host."""

import re
from pathlib import Path, PurePosixPath
from typing import Any

LINK = re.compile(r"(\]\()([^)#:\s]+)((?:#[^)\s]*)?\))")


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Return the page with links outside docs/ as web addresses; mkdocs checks the other links."""
    docs = Path(config.docs_dir)
    root = docs.parent

    def address(link: re.Match[str]) -> str:
        target = (docs / PurePosixPath(page.file.src_uri).parent / link[2]).resolve()
        if target.is_relative_to(docs) or not target.is_relative_to(root) or not target.exists():
            return link[0]
        kind = "tree" if target.is_dir() else "blob"
        return f"{link[1]}{config.repo_url.rstrip('/')}/{kind}/HEAD/{target.relative_to(root)}{link[3]}"

    return LINK.sub(address, markdown)
