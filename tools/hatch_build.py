"""Build step of the wheel that pyproject.toml cannot express: the destination of `config/package.py`.

The top level of the tree is fixed, so the file of the package is in a folder, together with the marker that it is typed
(PEP 561). A wheel contains them as `softfinger/__init__.py` and `softfinger/py.typed`. An editable install must not
contain them: in site-packages they would precede the links of `.dev` and hide them. `force-include` in pyproject.toml
treats both alike.
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
