"""A finger pulls a trigger, a robot gripper closes on a soft object, and the finger feels the force of the gripper.

    python examples/teleoperate_a_gripper.py

The fingertip moves the trigger by contact. The position of the trigger is the target of the gripper's actuator, and the
actuator's force acts on the trigger: position forward, force back, in each millisecond. MuJoCo simulates trigger,
gripper and object. Requires `softfinger[world]`.
"""

from pathlib import Path

import numpy as np

from softfinger import Engine

GAP_M, SOFT_N_PER_M, ACTUATOR_N_PER_M = 0.004, 300.0, 2000.0
MODEL = f"""
<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="trigger">
      <joint name="trigger" type="slide" axis="1 0 0" range="0 0.02" damping="2"/>
      <geom name="trigger" type="box" size="0.005 0.01 0.02" mass="0.05"/>
    </body>
    <body name="jaw" pos="0 0.3 0">
      <joint name="jaw" type="slide" axis="1 0 0" damping="5"/>
      <geom name="jaw" type="box" size="0.005 0.01 0.02" mass="0.05"/>
    </body>
    <body name="sponge" pos="{GAP_M + 0.015} 0.3 0">
      <joint name="sponge" type="slide" axis="1 0 0" stiffness="{SOFT_N_PER_M}" damping="2"/>
      <geom name="sponge" type="box" size="0.01 0.01 0.02" mass="0.05" solref="0.004 1" solimp="0.99 0.99 0.001"/>
    </body>
  </worldbody>
  <actuator><position name="jaw" joint="jaw" kp="{ACTUATOR_N_PER_M}"/></actuator>
</mujoco>
"""
RADIUS_M = 0.01


def pull(folder: Path, way_m: float, ticks: int = 1500) -> tuple[float, float, float]:
    """Move the finger `way_m` past first contact and wait. Return its force and the gripper's (N), and the pull (m)."""
    path = folder / "gripper.xml"
    path.write_text(MODEL)
    material = {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 2.0}
    engine = Engine(
        {
            "fingertip": {"radius_m": RADIUS_M},
            "world": {"model": str(path), "geom": [{"name": "trigger", "material": material}]},
        }
    )
    data = engine.data
    trigger, sponge = (engine.model.joint(name).dofadr[0] for name in ("trigger", "sponge"))
    felt = 0.0
    for tick in range(ticks):
        x = -0.005 - RADIUS_M + way_m * min(tick / 500, 1.0)
        data.ctrl[0] = data.qpos[trigger]
        data.qfrc_applied[trigger] = -data.actuator_force[0]
        felt = -engine.step([x, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]).force[0]
    return felt, SOFT_N_PER_M * data.qpos[sponge], data.qpos[trigger]


if __name__ == "__main__":
    for way in np.array([0.003, 0.006, 0.009]):
        felt, pressed, pulled = pull(Path.cwd(), way)
        print(
            f"pulled by {1e3 * pulled:.2f} mm: the finger feels {felt:.3f} N, the gripper presses with {pressed:.3f} N"
        )
