"""The devices that the driver `simulated` can be: what is known of each, in `devices.toml`."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Final

import msgspec

FILE: Final = Path(__file__).resolve().with_name("devices.toml")


class Preset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A device as the simulation has it; see docs/devices/simulated.md for each number and its source."""

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
def presets() -> dict[str, Preset]:
    """Every preset by its name; read once, when a simulated device is first opened."""
    return msgspec.toml.decode(FILE.read_bytes(), type=dict[str, Preset])
