"""Meshes that nobody should have made, in a hand that does not know: one clear error, or forces that are safe.

It compiles one type of scene, a mesh with friction, torsion and rolling, which takes half a minute; all other files of
compiled meshes have the same."""

import numpy as np
import pytest
from helpers import hostile_meshes, meshes
from helpers.surface_hand import hand
from helpers.touching import SLIPPERY, R, engine, field, go, saved, thing, wander
from mesh_truth import ask
from references.brute_force import balls_of, brute_distances

from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels.contact.first_pose import GRAZE
from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.record import AT

TICKS = 3000
STIFFNESS = 1000.0
STATIC = 0.6
"""Of the friction."""
OUTSIDE = R * (1.0 - 1e-9)
LANES = 8
"""Of the last node of a query, which are asked though its budget is used up."""


def smooth_and_rough(tmp_path, made, **keys):
    """An engine without friction, which says how deep the probe is, and one with friction, torsion and rolling."""
    file = saved(tmp_path, *made)
    smooth = engine(thing("part", "mesh", file=file, material=SLIPPERY, **keys))
    return smooth, engine(thing("part", "mesh", file=file, **keys))


def is_outside(made, records):
    """Whether the proxy is in every tick, of all triangles asked."""
    return brute_distances(balls_of(*made), records["proxy.position"]).min() >= OUTSIDE


def asked_most(running, points):
    """Nodes and triangles asked for the nearest one, at most."""
    shape = running.scene.objects.body.shape
    found = np.zeros((len(points), 3))
    ask(shape, flatten(shape), np.ascontiguousarray(points), BUDGET, found)
    return found[:, 2].max()


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", hostile_meshes.MADE)
def test_it_is_touched_safely(tmp_path, name):
    """Pressed, dragged and lifted at random: outside of every triangle in every tick. Without friction the force is at
    most the stiffness times the way from probe to proxy; friction displaces the proxy, and adds what its cone allows,
    for each of three patches. No question asks more than its budget."""
    made = hostile_meshes.MADE[name]()
    smooth, rough = smooth_and_rough(tmp_path, made)
    poses = hand(made, TICKS, R, np.random.default_rng(4))
    even, rubbed = smooth.run(poses), rough.run(poses)
    assert (even["contact.mode"] > 0).any()
    for records in (even, rubbed):
        assert np.isfinite(np.asarray(records)).all() and is_outside(made, records)
    depth = np.linalg.norm(even["proxy.position"] - even["probe.position"], axis=1)
    rounding = 1e-9 * (1.0 + np.abs(made.vertices).max())
    assert (np.linalg.norm(even["force"], axis=1) <= STIFFNESS * (depth + rounding)).all()
    behind = np.linalg.norm(rubbed["proxy.position"] - rubbed["probe.position"], axis=1)
    assert (
        rubbed["contact.normal_force"] <= STIFFNESS * (behind + rounding) + rubbed["contact.tangential_force"]
    ).all()
    patches = (AT.contacts0_force, AT.contacts1_force, AT.contacts2_force)
    loads = sum(np.linalg.norm(field(rubbed, at), axis=1) for at in patches)
    assert (rubbed["contact.tangential_force"] <= STATIC * loads * (1.0 + 1e-9)).all()
    assert asked_most(smooth, np.concatenate([even["proxy.position"], poses[:, :3]])) <= BUDGET + LANES


def test_what_is_mended_is_felt_as_the_whole(tmp_path):
    """A ball with triangles twice, inverted and without area: where it is touched it is the ball."""
    ball, poses = meshes.geodesic(12, 0.05), hand(meshes.geodesic(12, 0.05), TICKS, R, np.random.default_rng(5))
    whole, _ = smooth_and_rough(tmp_path, ball)
    mended, _ = smooth_and_rough(tmp_path, hostile_meshes.messy_ball(12, 0.05))
    expected, found = whole.run(poses), mended.run(poses)
    assert (expected["contact.mode"] > 0).mean() > 0.3
    # Which of two triangles holds it at their edge is by their order, and a tick's way round an edge by what holds it.
    np.testing.assert_allclose(found["force"], expected["force"], rtol=0.0, atol=0.02)
    np.testing.assert_allclose(np.median(np.abs(found["force"] - expected["force"])), 0.0, atol=1e-9)


@pytest.mark.scaled
@pytest.mark.parametrize("room", [1e-6, 0.01, 0.3])
def test_the_middle_of_a_socket(tmp_path, cases, room):
    """Of a hollow ball by a share `room` wider than the fingertip, which begins in its centre: outside, whatever the
    hand does, held whenever the hand is beyond the wall, and pushed back no harder than by the depth.

    Where it fits exactly, no search tells whether it touches: that is said in every tick, and it is not felt.
    """
    made = hostile_meshes.socket(R * (1.0 + room))
    smooth, rough = smooth_and_rough(tmp_path, made, inside=True)
    way = np.concatenate([np.zeros((20, 3)), wander(6, 1000, 2.0 * R)])
    ways = (way - way[20]) * np.minimum(np.arange(len(way)) / 200.0, 1.0)[:, None]
    even, rubbed = go(smooth, ways), go(rough, ways)
    for records in (even, rubbed):
        assert np.isfinite(np.asarray(records)).all()
        behind = np.linalg.norm(records["proxy.position"] - ways, axis=1)
        limit = STIFFNESS * (behind + 1e-9) + records["contact.tangential_force"]
        assert (records["contact.normal_force"] <= limit).all()
        if room < GRAZE:
            assert records["contact.budget"].all() and not records["contact.mode"].any()
            continue
        assert is_outside(made, records[:: cases(6, 1)])
        held = records["contact.mode"] > 0
        assert held[np.linalg.norm(ways, axis=1) > 1.001 * room * R].all()


@pytest.mark.parametrize("room", [0.1, 0.3])
def test_a_fingertip_in_a_socket_goes_where_the_hand_is(tmp_path, room):
    """Without friction the proxy comes to the side of the hand, whichever it was on, though all are about as near."""
    smooth, _ = smooth_and_rough(tmp_path, hostile_meshes.socket(R * (1.0 + room)), inside=True)
    for side in np.concatenate([np.eye(3), -np.eye(3), hostile_meshes.directions(7, 10)]):
        reach = R * (room + 0.2)
        records = go(smooth, np.repeat(reach * side[None], 300, axis=0))
        # It rests on a facet, whose tangent is a facet's angle off, or in an edge between two.
        assert records["proxy.position"][-1] @ side > 0.99 * room * R
        assert not records["contact.budget"][-1]


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e300, 2000.0])
def test_a_vertex_that_is_nowhere_is_refused(tmp_path, wrong):
    """In one line that names the object and the file."""
    made = meshes.geodesic(4, 0.05)
    vertices = made.vertices.copy()
    vertices[7, 1] = wrong
    file = saved(tmp_path, vertices, made.triangles)
    with pytest.raises(ConfigError, match="object 'part': file: ") as refused:
        engine(thing("part", "mesh", file=file))
    assert file in str(refused.value) and "\n" not in str(refused.value)


def test_an_ellipsoid_is_refused_by_name(tmp_path):
    """A fingertip that is no ball has no closed form on a triangle: one line names the mesh and the ellipsoid."""
    part = thing("part", "mesh", file=saved(tmp_path, *meshes.geodesic(4, 0.05)))
    with pytest.raises(ConfigError, match="ellipsoid") as refused:
        engine(part, fingertip={"radii_m": [0.01, 0.008, 0.006]})
    assert "\n" not in str(refused.value) and "mesh" in str(refused.value)


@pytest.mark.parametrize("name", ["star", "messy", "crossing"])
def test_a_proxy_that_is_late_does_not_let_the_force_jump(tmp_path, name):
    """A hand that goes deep, up to six radii, and fast: the proxy takes its time round the object, and the force does
    not change by more than the stiffness times what probe and proxy went."""
    made = hostile_meshes.MADE[name]()
    smooth, _ = smooth_and_rough(tmp_path, made)
    start = np.abs(made.vertices).max() + 2.0 * R
    ways = np.concatenate([np.linspace([0.0, 0.0, start], [0.0, 0.0, 0.0], 150), wander(9, TICKS, 6.0 * R)])
    records = go(smooth, ways)
    deep = np.linalg.norm(records["proxy.position"] - ways, axis=1)
    assert deep.max() > 2.0 * R
    went = np.linalg.norm(np.diff(ways, axis=0), axis=1)
    went += np.linalg.norm(np.diff(records["proxy.position"], axis=0), axis=1)
    jumps = np.linalg.norm(np.diff(records["force"], axis=0), axis=1)
    # The lift of a proxy among many facets is below a ten-thousandth of the radius, and so is what a pinch shares out.
    assert (jumps <= STIFFNESS * (went + 2e-4 * R)).all()
