"""The material library: what `material = "rubber"` stands for.

`materials.toml` holds tables as a scene would write them. A scene names one and may change single keys:

    material = "rubber"
    material = { name = "rubber", stiffness_n_per_m = 800, friction = { kinetic = 0.6 } }
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

FILE: Final = Path(__file__).resolve().with_name("materials.toml")


@lru_cache(maxsize=1)
def library() -> Mapping[str, Mapping[str, Any]]:
    """Every material by its name, as the tables of the file; read once, when a scene first names one."""
    return MappingProxyType(tomllib.loads(FILE.read_text(encoding="utf-8")))
