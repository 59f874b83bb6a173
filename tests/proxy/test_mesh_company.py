"""Several meshes, shapes and fingers in one scene."""

import numpy as np
import pytest
from helpers import meshes
from helpers.hostile_meshes import bar
from helpers.surface_hand import hand
from helpers.touching import SMOOTH, R, engine, make_object, visit, wander, write_part
from references.brute_force import balls_of, brute_distances

pytestmark = [pytest.mark.plain, pytest.mark.scaled]
OUTSIDE = R * (1.0 - 1e-9)
FINGERS = [{"name": name, "radius_m": R, "coupling": {"stiffness_n_per_m": 1000.0}} for name in ("thumb", "index")]


def test_two_fingers_on_one_mesh_are_independent(tmp_path, cases):
    bumpy, ticks = meshes.bumpy_sphere(cases(8, 24), 0.05, height=0.06), cases(120, 1500)
    part = make_object("part", "mesh", file=write_part(tmp_path, *bumpy))
    poses = {name: hand(bumpy, ticks, R, np.random.default_rng(seed)) for seed, name in ((5, "thumb"), (26, "index"))}
    together = engine(part, fingertip=None, coupling=None, finger=FINGERS).run(poses)
    for name, path in poses.items():
        alone = engine(part, fingertip=None, coupling=None, finger=[f for f in FINGERS if f["name"] == name])
        expected = alone.run({name: path})[name]
        assert (expected["contact.mode"] > 0).mean() > 0.2
        np.testing.assert_array_equal(np.asarray(together[name]), np.asarray(expected))


def test_meshes_and_shapes_in_one_scene(tmp_path, cases):
    """A mesh box on a plane, a mesh sphere, a sphere; forces as of the equivalent shapes, median to 30 mN."""
    box, ball = bar(0.03, 0.03, 0.02), meshes.moved(meshes.geodesic(cases(10, 24), 0.03), (0.075, 0.0, 0.01))
    floor = make_object("floor", "plane", position_m=[0.0, 0.0, -0.02], material=SMOOTH)
    sphere = make_object("other", "sphere", radius_m=0.02, position_m=[0.0, 0.06, 0.0], material=SMOOTH)
    parts = [
        make_object(name, "mesh", file=write_part(tmp_path, *made, name=f"{name}.ply"), material=SMOOTH)
        for name, made in (("box", box), ("ball", ball))
    ]
    shapes = [
        make_object("box", "box", size_m=[0.06, 0.06, 0.04], material=SMOOTH),
        make_object("ball", "sphere", radius_m=0.03, position_m=[0.075, 0.0, 0.01], material=SMOOTH),
    ]
    first, last = cases(750, 0), cases(1250, 6000)  # over the edge of the box, onto the sphere
    points = wander(3, 6000, 0.06)
    points[:, 2] = 0.02 + 0.3 * points[:, 2]
    points = np.concatenate([np.linspace((0.0, 0.0, 0.2), points[first], 2 * (last - first) // 5), points[first:last]])
    mesh, solid = (visit(engine(*those, floor, sphere, rolling=None), points) for those in (parts, shapes))
    proxies = mesh["proxy.position"]
    for made in (box, ball):
        assert brute_distances(balls_of(*made), proxies).min() >= OUTSIDE
    assert proxies[:, 2].min() >= R * (1.0 - 1e-9) - 0.02
    assert np.linalg.norm(proxies - (0.0, 0.06, 0.0), axis=1).min() >= (R + 0.02) * (1.0 - 1e-9)
    assert len(np.unique(mesh["contact.object"][mesh["contact.mode"] > 0])) >= 2
    # A facet of the sphere is 2.5 mm long and up to 25 um below its sphere: 25 mN. The proxy takes ticks round an edge.
    apart = np.linalg.norm(mesh["force"] - solid["force"], axis=1)
    assert np.median(apart) < 0.03
