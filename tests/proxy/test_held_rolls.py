"""A body between two soft fingertips rolls on them, decays as in its closed form, and does not creep."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers.examples import Cases
from test_bodies import HALF, MASS, RUBBER, TORSION, G, R, box, held_by_two, pinch

pytestmark = pytest.mark.plain
HEAVY, SOFT = 1.0, 200.0
"""kg and N/m: with 3 N the tips are 15 mm deep in a box of 40 mm."""


def test_a_heavy_body_rolls_on_soft_fingertips_and_comes_to_rest_slowly(tmp_path: Path) -> None:
    """A rotation b across the line of the contacts shears each by (h - d) b, with half width h and depth d.

    The forces N = K d have normals that turn with the body and probes at h + r - d from its middle; they turn it back:
        I b'' + 2 c (h - d)^2 b' + (2 N (h + r - d) + 2 K (h - d)^2) b = 0

    The damping is therefore small if d is close to h, for any c. The shears of the two tips are opposite, so the middle
    does not move.
    """
    inertia, damping = HEAVY * (2.0 * HALF) ** 2 / 6.0, 0.2 * math.sqrt(SOFT * HEAVY)
    coupling = {"stiffness_n_per_m": SOFT, "damping_ns_per_m": damping}
    coupling["torsional_damping_nms_per_rad"] = math.sqrt(TORSION * inertia)
    material = RUBBER | {"stiffness_n_per_m": SOFT, "damping_ns_per_m": damping}
    engine, force = held_by_two(box(tmp_path, HEAVY, gravity=0.0), material, coupling), 3.0
    path = pinch(100, 500.0 / SOFT * force)
    engine.run(path)
    engine.data.qvel[:] = [0.0, 0.0, 0.0, 0.0, 0.2, 0.0]
    hold = {name: np.repeat(poses[-1:], 2, axis=0) for name, poses in path.items()}
    rate = np.zeros(350)
    for step in range(len(rate)):
        engine.run(hold)
        rate[step] = engine.data.qvel[4]
    depth = force / SOFT
    lever = HALF - depth
    stiff = 2.0 * force * (HALF + R - depth) + 2.0 * SOFT * lever**2
    decay = damping * lever**2 / inertia
    angular = math.sqrt(stiff / inertia - decay**2)
    turns = np.flatnonzero(np.diff(np.sign(rate)))
    crossings = turns + rate[turns] / (rate[turns] - rate[turns + 1])
    halves = [np.abs(rate[a:b]).max() for a, b in pairwise(turns)]
    # Error of second order in a tick of 0.018 rad; a swing of 0.01 rad is a sine to 1e-4.
    assert math.pi / np.diff(crossings).mean() == pytest.approx(2e-3 * angular, rel=2e-3)
    assert math.log(halves[0] / halves[-1]) == pytest.approx(decay * math.pi / angular * (len(halves) - 1), rel=0.01)


@pytest.mark.scaled
def test_a_held_and_rolled_body_does_not_creep(tmp_path: Path, cases: Cases) -> None:
    """Grasped 8 mm off its middle, after a roll of 0.03 rad. Dampers reduce the swing tenfold every 0.25 s; the
    remainder is rounding of 0.1 m, 1e-17 m a tick. An encoder's step is 1e-6 m."""
    engine = held_by_two(box(tmp_path))
    path = pinch(100, 3.0, offset=0.008)
    engine.run(path)
    angle = 0.5 * 0.03
    hold = {name: np.repeat(poses[-1:], 500, axis=0) for name, poses in path.items()}
    for poses in hold.values():
        poses[:, 3:] = [math.cos(angle), 0.0, math.sin(angle), 0.0]
    for _ in range(cases(4, 6)):
        engine.run(hold)
    before = engine.data.qpos.copy()
    half_seconds = cases(1, 20)
    for _ in range(half_seconds):
        records = engine.run(hold)
    swing = 1e-8 if half_seconds == 1 else 1e-11  # m, after 2 s and after 3 s
    assert np.abs(engine.data.qpos - before).max() < swing
    assert records["thumb"]["contact.tangential_force"][-1] > 0.4 * MASS * G  # the body hangs by friction
