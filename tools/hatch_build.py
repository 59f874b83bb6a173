"""Build step of the wheel that pyproject.toml cannot express: files of the package `softfinger` itself.

The top level of the tree is fixed, so these files are in folders: `__init__.py`, `__main__.py` and the marker that the
package is typed (PEP 561). An editable install must not contain them: in site-packages they would precede the links of
`.dev` and hide them. `force-include` in pyproject.toml treats both alike.
"""

from __future__ import annotations

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PackageFile(BuildHookInterface):  # type: ignore[type-arg]
    """Hook that adds the files of the package to wheels, but not to editable installs."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files; hatchling passes `standard` or `editable` as `version`."""
        if version == "standard":
            build_data["force_include"]["config/package.py"] = "softfinger/__init__.py"
            build_data["force_include"]["config/py.typed"] = "softfinger/py.typed"
            build_data["force_include"]["server/main.py"] = "softfinger/__main__.py"
