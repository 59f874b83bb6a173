"""The one step of building the wheel that pyproject.toml cannot say: where `config/package.py` goes.

The top level of the tree is fixed, so the package's own file stands in a folder, and beside it the one that says that
it is typed (PEP 561). A wheel carries them as `softfinger/__init__.py` and `softfinger/py.typed`. An editable install
must not: they would stand in site-packages before the links of `.dev`, and hide them. `force-include` in pyproject.toml
does both alike.
"""

from __future__ import annotations

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class OwnFile(BuildHookInterface):  # type: ignore[type-arg]
    """Puts the package's own files into wheels that are installed whole."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """`version` is hatchling's word for the kind of wheel: `standard` or `editable`."""
        if version == "standard":
            build_data["force_include"]["config/package.py"] = "softfinger/__init__.py"
            build_data["force_include"]["config/py.typed"] = "softfinger/py.typed"
