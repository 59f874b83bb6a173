"""Penetration depth in the record, `contact.penetration`, for random motions on all shapes with all laws."""

from pathlib import Path

import numpy as np
import pytest
from helpers.examples import Cases
from helpers.touching import Array, R, posed, spun
from test_contact_in_company import SHAPES, make_table

from softfinger.config.load import load_scene
from softfinger.proxy.engine import Engine

pytestmark = pytest.mark.plain

ROOM = {"shape": "box", "size_m": [0.05, 0.05, 0.05], "inside": True}
NORMAL = (
    {"damping_ns_per_m": 1.0},
    {"normal": {"exponent": 1.5}},
    {"normal": {"exponent": 2.0, "damping_s_per_m": 1.0}},
)
FRICTION = ({"friction": {"static": 10.0, "kinetic": 9.0}}, {"friction": {"static": 0.6, "kinetic": 0.5}}, {})


def random_poses(rng: np.random.Generator, ticks: int) -> Array:
    """Poses (ticks, 7) in and out of an object at the origin, by up to 5 mm and 0.2 rad per tick."""
    t = 0.001 * np.arange(ticks)[:, None]
    rates, phases = rng.uniform(2.0, 40.0, (3, 3)), rng.uniform(0.0, 6.0, (3, 3))
    points = sum(np.sin(rates[k] * t + phases[k]) for k in range(3)) * rng.uniform(0.002, 0.02) + [0.0, 0.0, 0.012]
    angles = np.cumsum(rng.normal(0.0, 0.05, (ticks, 1)), axis=0)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    return posed(points, spun(axis, 2.0 * angles[:, 0]))


@pytest.mark.sampled(6)
@pytest.mark.scaled
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("shape", [*SHAPES, "room", "heightmap", "mesh ball"])
def test_the_depth_is_never_negative(shape: str, count: int, cases: Cases, tmp_path: Path) -> None:
    """With a second object, and with friction that displaces the proxy far from the probe."""
    rng, touched = np.random.default_rng(len(shape)), 0
    for number in range(cases(3, 300)):
        stuff = {"stiffness_n_per_m": 1000.0} | NORMAL[number % 3] | FRICTION[(number // 3 + number) % 3]
        it = ROOM | {"material": stuff} if shape == "room" else make_table(shape, tmp_path, stuff)
        objects = [it | {"name": f"it {k}", "position_m": [0.004 * k, 0.0, 0.001 * k]} for k in range(count)]
        scene = load_scene({"fingertip": {"radius_m": R}, "object": objects})
        records = Engine(scene).run(random_poses(rng, cases(100, 150)))
        depth, force = records["contact.penetration"], records["contact.normal_force"]
        assert (depth >= 0.0).all(), (number, depth.min())
        assert (depth[records["contact.mode"] == 0] == 0.0).all()
        if count == 1:  # a second object may bear all of the force
            assert (depth[force > 0.0] > 0.0).all()
        touched += int((force > 0.0).sum())
    assert touched >= 20
