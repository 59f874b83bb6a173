"""Energy of contacts with moving bodies: a closed cycle returns none to the hands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.record import AT
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import simulate

pytestmark = [
    pytest.mark.plain,
    pytest.mark.skipif(not PLAIN, reason="would compile two loops for minutes; `make test` runs it"),
]

R, HALF, MASS, STIFFNESS, PRESS = 0.008, 0.02, 0.1, 500.0, 3.0
BOX = f"""
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="box" pos="0 0 {HALF}">
      <freejoint/><geom name="box" type="box" size="0.02 0.02 0.02" mass="{MASS}"/>
    </body>
  </worldbody>
</mujoco>
"""
SCENE: dict[str, Any] = {
    "finger": [{"name": name, "radius_m": R} for name in ("thumb", "index")],
    "coupling": {
        "stiffness_n_per_m": STIFFNESS, "damping_ns_per_m": 1.0, "torsional_damping_nms_per_rad": 1.5e-3,
    },
    "rolling": {"method": "midpoint"},
    "passivity": {"mode": "observe"},
}  # fmt: skip
MATERIAL = {
    "stiffness_n_per_m": STIFFNESS,
    "damping_ns_per_m": 2.0,
    "friction": {"static": 0.8, "kinetic": 0.7},
    "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
}
RISE = 0.05


def make_transition(ticks: NDArray[np.int64], first: int, length: int) -> NDArray[np.float64]:
    """Return a transition from 0 to 1 with continuous acceleration."""
    u = np.clip((ticks - first) / length, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def test_lowering_a_box_and_a_closed_cycle_generate_no_contact_energy(tmp_path: Path) -> None:
    (tmp_path / "box.xml").write_text(BOX)
    scene = load_scene(SCENE | {"world": {"model": str(tmp_path / "box.xml"), "material": MATERIAL}})
    ticks = np.arange(1200)
    poses = np.zeros((len(ticks), 2, 7))
    depth = PRESS / STIFFNESS * (make_transition(ticks, 0, 100) - make_transition(ticks, 1000, 100))
    for finger, side in enumerate((-1.0, 1.0)):
        poses[:, finger, 0], poses[:, finger, 3] = side * (HALF + R + 1e-3 - depth * (1.0 + 1e-3 / depth.max())), 1.0
        poses[:, finger, 2] = HALF + RISE * (make_transition(ticks, 200, 300) - make_transition(ticks, 600, 300))
    records = simulate(make_tuning(scene, load_rig("replay", {"guard.ramp_s": 0.01}).guard), poses, 1000.0)
    observed, force = records[:, :, AT.passivity_energy], records[:, :, AT.force : AT.force + 3]
    by_hands = -np.einsum("tfi,tfi->tf", force[:-1], np.diff(poses[:, :, :3], axis=0)).cumsum(axis=0)
    weight = 0.5 * MASS * 9.81 * RISE
    lifted, lowered = by_hands[550] - by_hands[150], by_hands[950] - by_hands[550]
    np.testing.assert_allclose(lifted, weight, rtol=0.05)  # plus the work of the dampers
    np.testing.assert_allclose(lowered, -weight, rtol=0.05)
    assert np.ptp(observed[150:950], axis=0).max() < 0.05 * weight  # the sag is 0.4 mJ, the dampers take 0.5 mJ
    assert observed.min() > -1e-9
    assert (by_hands[-1] > 0.0).all() and not force[-1].any()
