"""Key on a spring that MuJoCo moves: the scene type of tests with simulated bodies, compiled once for all."""

from pathlib import Path
from typing import Any, Final

KEY: Final = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="key" pos="0 0 -0.01">
      <joint type="slide" axis="0 0 1" stiffness="300" damping="1" frictionloss="1e-6"/>
      <geom name="key" type="box" size="0.02 0.02 0.01" mass="0.05"/>
    </body>
  </worldbody>
</mujoco>
"""
RUBBER: Final = {"stiffness_n_per_m": 500.0, "damping_ns_per_m": 2.0, "friction": {"static": 0.8, "kinetic": 0.7}}
ROLLING: Final = {"method": "midpoint"}


def key_world(folder: Path) -> dict[str, Any]:
    """Return the table [world] of the key; its model is written to `folder`."""
    path = folder / "key.xml"
    path.write_text(KEY)
    return {"model": str(path), "material": RUBBER}
