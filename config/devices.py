"""Presets of the driver `simulated`, read from `devices.toml`."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Final

import msgspec

FILE: Final = Path(__file__).resolve().with_name("devices.toml")


class Preset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of one simulated device; docs/devices/simulated.md gives each number and its source."""

    name: str
    sensed_dof: int
    mass_kg: tuple[float, float, float]
    damping_ns_per_m: tuple[float, float, float]
    friction_n: tuple[float, float, float]
    lag_s: float
    force_max_n: float
    delay_ticks: int
    resolution_m: float
    stiffness_max_n_per_m: float
    damping_max_ns_per_m: float
    workspace_radius_m: float


@lru_cache(maxsize=1)
def load_presets() -> dict[str, Preset]:
    """Return all presets by name; the file is read when a simulated device is first opened."""
    return msgspec.toml.decode(FILE.read_bytes(), type=dict[str, Preset])
