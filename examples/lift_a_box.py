"""Two fingertips hold a box 8 mm from its centre of mass: with torsion it hangs, with point contacts it swings.

    python examples/lift_a_box.py

The script steps hand and world together: it passes poses of the fingers, and reads and changes MuJoCo's model and data.
The box starts in the air without gravity, which is switched on when the fingers grip. Requires `softfinger[world]`.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from softfinger import Engine

BOX = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="box"><freejoint/><geom name="box" type="box" size="0.02 0.02 0.02" mass="0.1"/></body>
  </worldbody>
</mujoco>
"""
RADIUS_M, STIFFNESS, TORSION, ARM_M = 0.008, 500.0, 0.05, 0.008
MATERIAL: dict[str, Any] = {
    "stiffness_n_per_m": STIFFNESS,
    "damping_ns_per_m": 2.0,
    "friction": {"static": 0.8, "kinetic": 0.7},
}
SOFT: dict[str, Any] = {"torsion": {"stiffness_nm_per_rad": TORSION, "friction_length_m": 0.004}}


def hold(material: dict[str, Any], folder: Path) -> float:
    """Return the largest rotation (rad) of the box about the line between the fingers, in 0.6 s under its weight."""
    model = folder / "box.xml"
    model.write_text(BOX)
    engine = Engine(
        {
            "finger": [{"name": "thumb", "radius_m": RADIUS_M}, {"name": "index", "radius_m": RADIUS_M}],
            "coupling": {"stiffness_n_per_m": 1000.0, "torsional_damping_nms_per_rad": 1.5e-3},
            "world": {"model": str(model), "material": material},
        }
    )
    turn = 0.0
    for tick in range(700):
        depth = 3.0 / STIFFNESS * min(tick / 100, 1.0)  # 3 N per finger
        poses = {
            name: [[side * (0.02 + RADIUS_M - depth), ARM_M, 0.0, 1.0, 0.0, 0.0, 0.0]]
            for name, side in (("thumb", -1.0), ("index", 1.0))
        }
        if tick == 100:
            engine.model.opt.gravity[2] = -9.81
        engine.run(poses)
        w, x = engine.data.qpos[3:5]
        turn = max(turn, abs(2.0 * math.atan2(x, w)))
    return turn


if __name__ == "__main__":
    soft, points = hold(MATERIAL | SOFT, Path.cwd()), hold(MATERIAL, Path.cwd())
    weight = 0.1 * 9.81 * ARM_M
    print(f"by soft fingers it turns by {np.degrees(soft):.1f} degrees; at rest m g d / (2 k_z) has ", end="")
    print(f"{np.degrees(weight / (2.0 * TORSION)):.1f}")
    print(f"by points it turns by {np.degrees(points):.0f} degrees")
