"""A probe that is clear of a moving body and retreats gets zero force, for each kind of geom."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers.touching import GRIP, Array

from softfinger.proxy.engine import Engine

pytestmark = pytest.mark.plain

R, SIZE, STEP = 0.006, 0.02, 0.001
"""m: radius of the fingertip, largest distance of a geom's surface from its middle, path of the probe per tick."""
RUBBER = GRIP | {"damping_ns_per_m": 2.0, "friction": {"static": 0.8, "kinetic": 0.6}}
HILLS = 'hfield name="hills" nrow="5" ncol="5" size="0.04 0.04 0.004 0.01" elevation="{}"'
ELEVATIONS = "0 1 0 2 1  1 2 1 0 0  0 3 2 1 1  1 0 0 2 3  2 1 0 1 0"
GEOMS = {
    "sphere": 'type="sphere" size="0.02"',
    "capsule": 'type="capsule" size="0.008 0.012"',
    "ellipsoid": 'type="ellipsoid" size="0.02 0.012 0.008"',
    "cylinder": 'type="cylinder" size="0.012 0.016"',
    "box": 'type="box" size="0.01 0.012 0.012"',
    "mesh": 'type="mesh" mesh="blob"',
    "hfield": 'type="hfield" hfield="hills"',
}


def make_engine(folder: Path, kind: str) -> Engine:
    """Engine with the geom on a free weightless body, far above a floor; the model's file is in `folder`."""
    assets = {"hfield": f"<{HILLS.format(ELEVATIONS)}/>", "mesh": '<mesh name="blob" file="blob.stl"/>'}
    blob = trimesh.creation.icosphere(subdivisions=1, radius=1.0)
    blob.apply_scale([0.02, 0.014, 0.01])
    blob.export(folder / "blob.stl")
    (folder / "one.xml").write_text(
        f'<mujoco><option timestep="0.001" gravity="0 0 0"/><asset>{assets.get(kind, "")}</asset><worldbody>'
        '<geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -1"/><body name="one"><freejoint/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="0.0003 0.0003 0.0003"/>'
        f'<geom name="one" {GEOMS[kind]}/></body></worldbody></mujoco>'
    )
    scene: dict[str, Any] = {"fingertip": {"radius_m": R}, "rolling": {"method": "midpoint"}}
    scene["coupling"] = {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 1.0}
    return Engine(scene | {"world": {"model": str(folder / "one.xml"), "material": RUBBER}})


def visit(random: np.random.Generator, above: bool) -> Array:
    """Poses (n, 7) to 4 to 7 mm from the body's middle, with drag and roll, and away; if `above`, from +z."""
    start = random.normal(size=3)
    if above:
        start[2] = abs(start[2]) + 2.0
    start /= np.linalg.norm(start)
    near, far = random.uniform(0.004, 0.007), 2.5 * (R + SIZE)
    corners = [start * far, start * near]
    aside = np.cross(start, random.normal(size=3))
    corners.append(corners[-1] + 0.006 * aside / np.linalg.norm(aside))
    leaving = start + 0.8 * aside / np.linalg.norm(aside)
    corners.append(corners[-1] + 2.0 * far * leaving / np.linalg.norm(leaving))
    legs = [np.linspace(a, b, max(int(np.linalg.norm(b - a) / STEP), 2), endpoint=False) for a, b in pairwise(corners)]
    places = np.concatenate(legs)
    turned = np.cumsum(np.full((len(places), 1), 1e-3), axis=0) * random.normal(size=3)
    quaternions = np.hstack([np.ones((len(places), 1)), 0.5 * turned])
    return np.hstack([places, quaternions / np.linalg.norm(quaternions, axis=1)[:, None]])


@pytest.mark.sampled(2)
@pytest.mark.scaled
@pytest.mark.parametrize("kind", GEOMS)
def test_a_probe_clear_of_a_body_gets_zero_force(kind: str, tmp_path: Path, cases: Any) -> None:
    """Clear means farther from the geom's middle than geom and fingertip reach, or above a height field's maximum."""
    random, engine = np.random.default_rng(7), make_engine(tmp_path, kind)
    for _ in range(cases(2, 40)):
        engine.reset()
        engine.data.qvel[:] = [*random.uniform(-0.05, 0.05, 3), *random.uniform(-1.0, 1.0, 3)]
        pressed = False
        for pose in visit(random, kind == "hfield"):
            at, axes = engine.data.geom("one").xpos.copy(), engine.data.geom("one").xmat.reshape(3, 3).copy()
            record = engine.run([pose])[0]
            away = pose[:3] - at
            clear = (axes.T @ away)[2] > 0.004 + R if kind == "hfield" else np.linalg.norm(away) > 1.001 * SIZE + R
            pressed = pressed or record["contact.normal_force"] > 0.0
            if clear:
                assert not record["force"].any() and not record["torque"].any() and record["contact.mode"] == 0, away
        assert clear and pressed
