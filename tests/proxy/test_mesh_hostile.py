"""Malformed meshes give one clear error, or safe forces. All files of compiled meshes have one type of scene, with
friction, torsion and rolling, which compiles for half a minute."""

import numpy as np
import pytest
from helpers import hostile_meshes
from helpers.surface_hand import hand
from helpers.touching import SLIPPERY, R, engine, make_object, visit, wander, write_part
from mesh_truth import ask
from references.brute_force import balls_of, brute_distances

from softfinger.proxy.kernels.contact.first_pose import OVERLAP_TOLERANCE
from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.kernels.shapes.budget import BUDGET

TICKS, STIFFNESS = 3000, 1000.0
STATIC = 0.6
"""Friction coefficient."""
OUTSIDE = R * (1.0 - 1e-9)
LANES = 8
"""Triangles of the last node of a query, which are tested although the budget is exhausted."""


def smooth_and_rough(tmp_path, made, **keys):
    file = write_part(tmp_path, *made)
    smooth = engine(make_object("part", "mesh", file=file, material=SLIPPERY, **keys))
    return smooth, engine(make_object("part", "mesh", file=file, **keys))


def is_outside(made, records):
    return brute_distances(balls_of(*made), records["proxy.position"]).min() >= OUTSIDE


def largest_query(running, points):
    shape = running.scene.objects.body.shape
    results = np.zeros((len(points), 3))
    ask(shape, flatten(shape), np.ascontiguousarray(points), BUDGET, results)
    return results[:, 2].max()


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", hostile_meshes.MADE)
def test_it_is_touched_safely(tmp_path, name):
    """Without friction the force is at most the stiffness times the distance from probe to proxy; friction adds at most
    its cone for each of three patches. No query exceeds its budget."""
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
    limit = STIFFNESS * (behind + rounding) + rubbed["contact.tangential_force"]
    assert (rubbed["contact.normal_force"] <= limit).all()
    loads = sum(np.linalg.norm(rubbed[f"contacts{i}.force"], axis=1) for i in range(3))
    assert (rubbed["contact.tangential_force"] <= STATIC * loads * (1.0 + 1e-9)).all()
    assert largest_query(smooth, np.concatenate([even["proxy.position"], poses[:, :3]])) <= BUDGET + LANES


@pytest.mark.scaled
@pytest.mark.parametrize("room", [1e-6, 0.01, 0.3])
def test_a_fingertip_in_the_centre_of_a_socket(tmp_path, cases, room):
    """The hollow is wider than the fingertip by a fraction `room`. If it fits exactly, no search can decide on contact:
    `contact.budget` is set in every tick, and there is no force."""
    made = hostile_meshes.socket(R * (1.0 + room))
    smooth, rough = smooth_and_rough(tmp_path, made, inside=True)
    path = np.concatenate([np.zeros((20, 3)), wander(6, 1000, 2.0 * R)])
    ways = (path - path[20]) * np.minimum(np.arange(len(path)) / 200.0, 1.0)[:, None]
    even, rubbed = visit(smooth, ways), visit(rough, ways)
    for records in (even, rubbed):
        assert np.isfinite(np.asarray(records)).all()
        behind = np.linalg.norm(records["proxy.position"] - ways, axis=1)
        limit = STIFFNESS * (behind + 1e-9) + records["contact.tangential_force"]
        assert (records["contact.normal_force"] <= limit).all()
        if room < OVERLAP_TOLERANCE:
            assert records["contact.budget"].all() and not records["contact.mode"].any()
            continue
        assert is_outside(made, records[:: cases(6, 1)])
        touching = records["contact.mode"] > 0
        assert touching[np.linalg.norm(ways, axis=1) > 1.001 * room * R].all()


@pytest.mark.parametrize("room", [0.1, 0.3])
def test_a_fingertip_in_a_socket_moves_to_the_side_of_the_hand(tmp_path, room):
    """Without friction, though all triangles are equally close, and the search finishes."""
    smooth, _ = smooth_and_rough(tmp_path, hostile_meshes.socket(R * (1.0 + room)), inside=True)
    for side in np.concatenate([np.eye(3), -np.eye(3), hostile_meshes.directions(7, 100)]):
        last = visit(smooth, np.repeat(R * (room + 0.2) * side[None], 60, axis=0))[-1]
        # It rests on a facet, whose tangent deviates by the angle of a facet, or in an edge between two.
        assert last["contact.budget"] == 0 and last["proxy.position"] @ side > 0.99 * room * R


@pytest.mark.parametrize("name", ["star", "messy", "crossing"])
def test_a_delayed_proxy_does_not_let_the_force_jump(tmp_path, name):
    """Up to six radii deep: at most the stiffness times the motion of probe and proxy."""
    made = hostile_meshes.MADE[name]()
    smooth, _ = smooth_and_rough(tmp_path, made)
    start = np.abs(made.vertices).max() + 2.0 * R
    ways = np.concatenate([np.linspace([0.0, 0.0, start], [0.0, 0.0, 0.0], 150), wander(9, TICKS, 6.0 * R)])
    records = visit(smooth, ways)
    assert np.linalg.norm(records["proxy.position"] - ways, axis=1).max() > 2.0 * R
    went = np.linalg.norm(np.diff(ways, axis=0), axis=1)
    went += np.linalg.norm(np.diff(records["proxy.position"], axis=0), axis=1)
    # Lifting a proxy among many facets changes the force by less than 1e-4 of the radius, as does the distribution in a
    # pinch.
    assert (np.linalg.norm(np.diff(records["force"], axis=0), axis=1) <= STIFFNESS * (went + 2e-4 * R)).all()
