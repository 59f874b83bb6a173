"""Invariants of contacts with several objects: 15 random cases each, 10 000 in the full profile."""

import functools

import numpy as np
import pytest
from helpers.examples import examples
from helpers.touching import facing
from hypothesis import given
from hypothesis import strategies as st
from references.laws import axis_angles, work_of_the_hand
from references.rotation import matrix
from test_invariants import cycle, numbers, visit
from test_patches import GRIP, LATE, LIMP, SOFT, WALLS, R, engine, material, wall
from test_seams import tile

pytestmark = [pytest.mark.plain, pytest.mark.scaled]

STUFF = material(GRIP, LIMP)
EVEN = material({"static": 0.5, "kinetic": 0.5}, LIMP)
"""Equal static and kinetic friction, because a drop between them is a jump of the force."""
YIELDING = material(LATE, {"stiffness_nm_per_rad": 0.02, "friction_length_m": 0.002}, stiffness_n_per_m=300.0)
SHARP = (np.array([0.9, 0.0, np.sqrt(0.19)]), np.array([-0.9, 0.0, np.sqrt(0.19)]))

PLANES = {
    "groove": ([(n, 0.0) for n in WALLS], (0.0, 0.0, np.sqrt(2.0) * R)),
    "sharp groove": ([(n, 0.0) for n in SHARP], (0.0, 0.0, R / np.sqrt(0.19))),
    "valley": ([((s * 0.0087, 0.0, 1.0), 0.0) for s in (1.0, -1.0)], (0.0, 0.0, R)),
    "corner": ([((1, 0, 0), 0.0), ((0, 1, 0), 0.0), ((0, 0, 1), 0.0)], (R, R, R)),
    "slot": ([((1, 0, 0), -R - 0.0003), ((-1, 0, 0), -R - 0.0003), ((0, 0, 1), 0.0)], (0.0, 0.0, R)),
    "pinch": ([((0, 0, 1), 0.001 - R), ((0, 0, -1), 0.001 - R)], (0.0, 0.0, 0.0)),
}
"""Normals and offsets of planes, and the position at which the proxy just or nearly fits between them."""
BALL = 0.02
"""Radius of a sphere, m."""
BALLS = {"two balls": [(-BALL, 0.0, 0.0), (BALL, 0.0, 0.0)], "ball on floor": [(0.0, 0.0, BALL)]}
"""Centres of the spheres; the single one is on a floor z = 0."""
KINDS = [*PLANES, "seam"]
SYMMETRIC = ["groove", "sharp groove", "valley", "slot", "seam", "two balls"]
"""Scenes that are their own mirror image in x."""
RIGHT_ANGLED = ["groove", "corner", "slot", "pinch"]
"""Perpendicular or opposite walls: normal forces of unequal walls have a potential too."""
BEGIN = {"slot": (0.0, 0.0, 0.003), "pinch": (0.0, 0.0, 0.0)}
"""Start of a path relative to the place, m, if it cannot start in free space above."""
PLACES = {kind: np.array(place) for kind, (_, place) in PLANES.items()} | {
    "seam": np.array([0.0, 0.0, R]),
    "two balls": np.array([0.0, 0.0, np.sqrt((BALL + R) ** 2 - BALL**2)]),
    "ball on floor": np.array([np.sqrt((BALL + R) ** 2 - (BALL - R) ** 2), 0.0, R]),
}


def objects_of(kind, stuff, turned=None):
    if kind == "seam":
        return [tile("left", -0.05, stuff=stuff), tile("right", 0.05, stuff=stuff)]
    turn = np.eye(3) if turned is None else matrix(turned)
    if kind in BALLS:
        balls = [
            {"name": f"ball {i}", "shape": "sphere", "radius_m": BALL, "position_m": (turn @ at).tolist()}
            | {"material": stuff}
            for i, at in enumerate(BALLS[kind])
        ]
        return balls + ([wall("floor", turn @ [0.0, 0.0, 1.0], stuff)] if kind == "ball on floor" else [])
    return [wall(f"wall {i}", turn @ n, stuff, offset) for i, (n, offset) in enumerate(unit(kind))]


def unit(kind):
    return [(np.asarray(n, float) / np.linalg.norm(n), offset) for n, offset in PLANES[kind][0]]


@functools.cache
def make_engine(kind, even=False, back=False, unequal=False):
    objects = objects_of(kind, EVEN if even else STUFF)
    if unequal:
        objects[-1] = objects[-1] | {"material": YIELDING}
    return engine(*(objects[::-1] if back else objects))


def handling(kind, draws, count):
    """Poses of a path to goals within some mm of a place and back; free at its ends, except in a pinch."""
    # Offset from the point at which both walls are touched exactly, where rounding decides.
    goals = PLACES[kind] + [0.00011, -0.00007, -0.00031] + 0.002 * draws[:count, :3]
    return cycle(PLACES[kind] + BEGIN.get(kind, (0.002, 0.002, 0.006)), goals, 0.3 * draws[:count, 3:])


MOTIONS = (numbers(4, 6), st.integers(1, 4))
WALLS_OF_CYCLES = [*((kind, False) for kind in KINDS), *((kind, True) for kind in RIGHT_ANGLED)]
"""Scenes, and whether the walls have unequal materials."""


@examples(25)
@given(st.sampled_from(WALLS_OF_CYCLES), *MOTIONS)
def test_closed_cycle_gives_no_energy(case, draws, count):
    kind, unequal = case
    engine_of = make_engine(kind, unequal=unequal)
    engine_of.reset()
    work = work_of_the_hand(engine_of.run(handling(kind, draws, count)))
    # Rounding of sums of up to forty terms of up to 1e-2 J.
    assert (work[-1] if kind == "pinch" else work.min()) > -1e-14


@functools.cache
def soft_engine(kind):
    return engine(*objects_of(kind, STUFF), **SOFT)


@examples(15)
@given(st.sampled_from(["groove", "sharp groove", "valley", "seam"]), numbers(4, 6), st.integers(1, 4))
def test_spin_of_contact_patches_gives_no_energy(kind, draws, count):
    """The work of spin is never less than the energy f R phi^2 / 2 stored in all patches, under changing loads. The
    tolerance is the change of the load within a tick, because the record contains the load at its end."""
    engine_of, path = soft_engine(kind), handling(kind, draws, count)
    engine_of.reset()
    records = engine_of.run(path)
    turned = np.vstack([np.zeros(3), axis_angles(path[:, 3:])])
    work = np.zeros(len(path))
    stored, missed = np.zeros(len(path)), np.zeros(len(path))
    for i in range(3):
        normal, spin = records[f"contacts{i}.normal"], records[f"contacts{i}.spin"]
        stiffness = R * np.sum(records[f"contacts{i}.force"] * normal, axis=1)
        work += stiffness * spin * np.sum(turned * normal, axis=1)
        stored += 0.5 * stiffness * spin**2
        missed += np.abs(np.diff(stiffness, prepend=0.0) * spin) * np.linalg.norm(turned, axis=1)
    # Rounding of sums of up to forty terms of up to 1e-3 J.
    assert (np.cumsum(work) - stored + np.cumsum(missed)).min() > -1e-17


@examples(15)
@given(st.sampled_from(list(BALLS)), *MOTIONS)
def test_curved_bodies_give_no_energy(kind, draws, count):
    """As on planes, with a tolerance for the turn of the normals. Per tick the proxy and the roll move two patches by l
    each, and the normals turn by l / D: see test_closed_cycle_on_a_ball_with_friction_gives_no_energy."""
    engine_of = make_engine(kind)
    engine_of.reset()
    records = engine_of.run(handling(kind, draws, count))
    at, turn = records["proxy.position"], axis_angles(records["probe.orientation"])
    probe = records["probe.position"]
    length = np.linalg.norm(np.diff(at, axis=0), axis=1) + np.linalg.norm(np.diff(probe, axis=0), axis=1)
    length += R * np.linalg.norm(turn, axis=1)
    force = np.linalg.norm(records["force"], axis=1)
    deviation = length**2 / (BALL + R)
    missed = np.cumsum(2.0 * (force[1:] + force[:-1]) * deviation + 0.5 * 1000.0 * deviation**2)
    assert (work_of_the_hand(records)[1:] + missed).min() > -1e-14


SWAY = np.array([0.0002, -0.0003, 0.0004])
"""Amplitude of a moving wall, m, with a period of sixteen ticks, in its frame: its normal is z."""


@functools.cache
def swaying(kind):
    objects = objects_of(kind, STUFF)
    motion = {"kind": "sinusoid", "translation_m": SWAY.tolist(), "frequency_hz": 62.5}
    objects[-1] = objects[-1] | {"motion": motion}
    return engine(*objects)


@examples(15)
@given(st.sampled_from(["groove", "corner", "slot"]), *MOTIONS)
def test_moving_object_gives_no_more_energy_than_its_work(kind, draws, count):
    engine_of = swaying(kind)
    engine_of.reset()
    records = engine_of.run(handling(kind, draws, count))
    normal, last = unit(kind)[-1][0], len(unit(kind)) - 1
    phase = 2.0 * np.pi * 62.5 * (records["timestamp"] + 0.001)
    went = np.outer(np.diff(np.sin(phase)), matrix(facing(normal)) @ SWAY)
    force = np.zeros((len(records), 3))
    for i in range(3):
        force += (records[f"contacts{i}.object"] == last)[:, None] * records[f"contacts{i}.force"]
    work = work_of_the_hand(records)
    work[1:] += np.cumsum(np.sum(force[1:] * went, axis=1))
    assert work.min() > -1e-14


@examples(15)
@given(st.sampled_from(SYMMETRIC), *MOTIONS)
def test_order_of_touches_changes_nothing(kind, draws, count):
    poses = handling(kind, draws, count)
    a = visit(make_engine(kind), poses)
    b = visit(make_engine(kind), poses * [-1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    np.testing.assert_allclose(b["force"], a["force"] * [-1.0, 1.0, 1.0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(b["torque"], a["torque"] * [1.0, -1.0, -1.0], rtol=0, atol=1e-13)


@examples(15)
@given(st.sampled_from(KINDS + list(BALLS)), *MOTIONS)
def test_order_of_bodies_changes_nothing(kind, draws, count):
    poses = handling(kind, draws, count)
    a, b = visit(make_engine(kind), poses), visit(make_engine(kind, back=True), poses)
    # Rounding of lengths of 10 mm times 1000 N/m, summed over forty ticks.
    np.testing.assert_allclose(a["force"], b["force"], rtol=0, atol=1e-11)
    np.testing.assert_allclose(a["torque"], b["torque"], rtol=0, atol=1e-13)


@examples(15)
@given(st.sampled_from(KINDS + list(BALLS)), *MOTIONS)
def test_force_is_continuous(kind, draws, count):
    """From tick to tick, by no more than stiffness times motion, also if the contact changes object. A step s changes
    the depth in a wall by at most s / sin(half the angle between two walls), and normal forces by K times that.
    Friction changes with its springs, with mu times the normal forces and with the shares transferred."""
    poses = handling(kind, draws, count)
    records = visit(make_engine(kind, even=True), poses)
    travel = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    travel += R * np.linalg.norm(axis_angles(poses[:, 3:]), axis=1)
    jumps = np.linalg.norm(np.diff(records["force"], axis=0), axis=1)
    # 70 degrees between sphere and floor, 84 between two spheres, less the turn of the normals in 3 mm of depth.
    steepest = 1.0 / np.sqrt(0.19) if kind == "sharp groove" else 2.0 if kind in BALLS else np.sqrt(2.0)
    assert (jumps <= 4.0 * steepest * 1000.0 * travel + 1e-12).all()
