"""One finger drags a plate until the plate slips, or pushes it over a floor."""

from pathlib import Path

import numpy as np
import pytest
from helpers.touching import GRIP, Array

from softfinger.proxy.engine import Engine
from softfinger.proxy.record import SLIDING

pytestmark = pytest.mark.plain

G, R, MASS = 9.81, 0.008, 0.1
STATIC, KINETIC = 0.8, 0.7
"""Friction of the finger on the body."""
HALF, THIN = 0.02, 0.005
"""Half extents of a plate, too flat to tip over."""
DT = 1e-3
PLATE = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" friction="{floor} 0 0" solref="0.002 1"/>
    <body name="plate" pos="0 0 0.005">
      <joint type="slide" axis="1 0 0"/><joint type="slide"/>
      <geom name="plate" type="box" size="0.02 0.02 0.005" mass="0.1" friction="{floor} 0 0" solref="0.002 1"/>
    </body>
  </worldbody>
</mujoco>
"""


def finger_on_a_plate(folder: Path, floor: float) -> Engine:
    (folder / "plate.xml").write_text(PLATE.format(floor=floor), encoding="utf-8")
    material = GRIP | {"damping_ns_per_m": 2.0, "friction": {"static": STATIC, "kinetic": KINETIC}}
    world = {"model": str(folder / "plate.xml"), "geom": [{"name": "plate", "material": material}]}
    coupling = {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 4.0, "torsional_damping_nms_per_rad": 1e-4}
    tables = {"fingertip": {"radius_m": R}, "rolling": {"method": "midpoint"}}
    return Engine(tables | {"coupling": coupling, "world": world})


def go(engine: Engine, path: Array) -> tuple[Array, Array, Array]:
    """Force (n, 3), mode (n,) and the plate's velocity along x (n,); checks that the plate's force is opposite."""
    force, mode, speed = np.zeros((len(path), 3)), np.zeros(len(path)), np.zeros(len(path))
    for tick, center in enumerate(path):
        records = engine.run(np.array([[*center, 1.0, 0.0, 0.0, 0.0]]))
        force[tick], mode[tick], speed[tick] = records["force"][0], records["contact.mode"][0], engine.data.qvel[0]
        np.testing.assert_allclose(engine.data.xfrc_applied[1, :3], -force[tick], rtol=0.0, atol=1e-12)
    return force, mode, speed


def down(depth: float, ticks: int = 120) -> Array:
    u = np.clip(np.arange(ticks) / (0.5 * ticks), 0.0, 1.0)
    path = np.zeros((ticks, 3))
    path[:, 2] = 2.0 * THIN + R - depth * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    return path


def test_a_dragged_plate_slips_when_its_inertia_exceeds_friction(tmp_path: Path) -> None:
    """Without floor friction, at a = j t = mu_s N / m; afterwards it accelerates with mu_k N / m."""
    engine, jerk, press = finger_on_a_plate(tmp_path, 0.0), 40.0, down(1e-3)
    force, _, _ = go(engine, press)
    normal = force[-1, 2]
    t = DT * np.arange(1, 280)
    path = np.repeat(press[-1:], len(t), axis=0)
    path[:, 0] = jerk * t**3 / 6.0
    force, mode, speed = go(engine, path)
    first = int(np.flatnonzero(mode == SLIDING)[0])
    assert np.max(-force[:first, 0] / force[:first, 2]) == pytest.approx(STATIC, rel=0.01)  # a tick adds 0.5 %
    # The plate swings for some ticks.
    assert jerk * t[first] == pytest.approx(STATIC * normal / MASS, abs=5.0 * jerk * DT)
    after = slice(first + 5, first + 45)
    assert np.all(mode[after] == SLIDING)
    assert np.polyfit(t[after], speed[after], 1)[0] == pytest.approx(KINETIC * normal / MASS, rel=0.01)


def test_a_pushed_plate_resists_by_floor_friction_and_inertia(tmp_path: Path) -> None:
    """mu m g + m a. To 2 %: MuJoCo makes friction convex, and a sliding body hops by micrometres."""
    floor, more, slow, faster = 0.2, 2.0, 400, 150
    engine, limit = finger_on_a_plate(tmp_path, floor), floor * MASS * G
    t = DT * np.arange(slow + faster)
    path = np.zeros((len(t), 3))
    path[:, 0] = -HALF - R + 0.01 * t + 0.5 * more * np.maximum(t - DT * slow, 0.0) ** 2
    path[:, 2] = THIN
    force, _, speed = go(engine, path)
    push = -force[:, 0]
    first = int(np.flatnonzero(push > 0.9 * limit)[0])
    assert np.abs(speed[:first]).max() < 0.2 * 0.01  # it creeps
    assert push[slow - 200 : slow].mean() == pytest.approx(limit, rel=0.02)
    assert speed[slow - 200 : slow].mean() == pytest.approx(0.01, rel=0.02)
    assert push[-50:].mean() == pytest.approx(limit + MASS * more, rel=0.02)
