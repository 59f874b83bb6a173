"""Plane that a device presses on, and a constant force: the scene of tests that compare forces in N."""

from typing import Any

from softfinger.config.load import build
from softfinger.config.schema import Scene

DEPTH_M = 0.001
"""Depth to which helpers/faulty_device presses into the plane z = 0."""


def pressed_scene(
    *, name: str = "lid.top", position_m: tuple[float, float, float] = (0.0, 0.0, 0.0), **material: Any
) -> Scene:
    """Return a frictionless plane that can be driven, and a constant force: F_z = k d + f."""
    return build(
        Scene,
        {
            "fingertip": {"radius_m": 0.01},
            "probe": {"velocity_time_constant_s": 0.0},
            "object": [
                {
                    "name": name,
                    "shape": "plane",
                    "position_m": list(position_m),
                    "motion": {"kind": "driven"},
                    "material": {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 0.0} | material,
                }
            ],
            "effect": [{"kind": "constant_force", "force_n": [0.0, 0.0, 1.0]}],
        },
        "test scene",
    )
