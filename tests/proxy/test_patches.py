"""One contact patch per object that touches the fingertip: friction, torsion and rolling in grooves and in
pinches, compared with closed forms.

Finger 10 mm, K = 1000 N/m, mu .6/.5. Pressed 1 mm into a 90 degree groove, each wall bears f = 1 N / sqrt 2.
"""

import numpy as np
import pytest
from helpers import touching
from references.rotation import quaternion

from softfinger.proxy.record import AT

pytestmark = pytest.mark.plain

R = 0.01
SQRT2 = 2.0**0.5
F = 1.0 / SQRT2
"""Normal force on each wall of the groove, N."""
GRIP = {"static": 0.6, "kinetic": 0.5}
LATE = {"static": 0.2, "kinetic": 0.1}
FAST = GRIP | {"viscous_s_per_m": 4.0}
LIMP = {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004}
STRONG = {"stiffness_nm_per_rad": 0.05, "friction_length_m": 1.0}
WALLS = (np.array([1.0, 0.0, 1.0]) / SQRT2, np.array([-1.0, 0.0, 1.0]) / SQRT2)
ORDERS = ((0, 1), (1, 0))
SOFT = {"fingertip": {"radius_m": R, "patch": {"shear_modulus_pa": 45e3, "rolling_loss": 0.4}}}
"""Fingertip with a Hertzian patch: radius (3 f R / 16 G)^(1/3) and spin stiffness f R under a load f."""


def material(friction=GRIP, torsion=None, **keys):
    return (
        {"stiffness_n_per_m": 1000.0}
        | ({"friction": friction} if friction else {})
        | ({"torsion": torsion} if torsion else {})
        | keys
    )


def wall(name, normal, stuff=None, offset=0.0, **keys):
    return touching.wall(name, normal, stuff or material(), offset, **keys)


def groove(order=(0, 1), stuff=(None, None), angle=None):
    """Two planes that intersect in the y axis, in this order; normals at 45 degrees or `angle` rad from z."""
    normals = WALLS if angle is None else [(s * np.sin(angle), 0.0, np.cos(angle)) for s in (1.0, -1.0)]
    return [wall(f"wall {i}", normals[i], stuff[i]) for i in order]


def engine(*objects, **tables):
    return touching.engine(*objects, **{"rolling": {"method": "rotation_vector"}} | tables)


def poses(points, vectors=None):
    return touching.posed(points, None if vectors is None else quaternion(vectors))


def turning(axis, angle, ticks):
    """Return the rotation vectors (ticks, 3) of a turn about a coordinate axis."""
    return np.outer(np.linspace(0.0, angle, ticks + 1)[1:], np.eye(3)[axis])


def line(start, end, ticks):
    return np.linspace(start, end, ticks + 1)[1:]


def pressing(goal, ticks=20):
    above = np.add(goal, [0.0, 0.0, 0.003])
    return np.vstack([above, line(above, goal, ticks)])


IN_GROOVE = np.array([0.0, 0.0, SQRT2 * R - 0.001])
ABOVE = np.add(IN_GROOVE, [0.0, 0.0, 0.003])
PRESS = pressing(IN_GROOVE, 100)


def in_groove(running, points, vectors=None):
    running.run(poses(PRESS))
    return running.run(poses(points, vectors))


@pytest.mark.parametrize(
    ("laws", "peak", "expected"),
    [
        ((GRIP, GRIP), 1.2 * F, 1.0 * F),
        ((GRIP, None), 0.6 * F, 0.5 * F),
        ((None, GRIP), 0.6 * F, 0.5 * F),
        ((GRIP, LATE), 0.7 * F, 0.6 * F),
        ((FAST, FAST), 1.4 * F, 1.4 * F),  # at 0.05 m/s kinetic friction is above static friction
    ],
)
def test_friction_along_a_groove_is_the_sum_of_both_laws(laws, peak, expected):
    """Friction along the groove is mu_d1 f1 + mu_d2 f2 in either order: 0.354 N if one wall is frictionless, 0.424 N
    for 0.5 and 0.1. It peaks when a contact breaks loose."""
    running = engine(*groove(stuff=[material(law) for law in laws]))
    force = in_groove(running, line(IN_GROOVE, np.add(IN_GROOVE, [0.0, 0.02, 0.0]), 400))["force"]
    assert -force[:, 1].min() == pytest.approx(peak, abs=1e-9)
    # Dragged by 20 mm; the component across decays by a factor e per 0.7 mm of slip.
    np.testing.assert_allclose(force[-1], [0.0, -expected, 1.0], atol=1e-9)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("shifted", [-1e-5, 1e-5])
def test_a_drag_does_not_depend_on_the_first_wall_touched(order, shifted):
    running = engine(*groove(order, [material(None), material()]))
    begin = np.add(ABOVE, [shifted, 0.0, 0.0])
    running.run(poses(np.vstack([begin, line(begin, IN_GROOVE, 100)])))
    force = running.run(poses(line(IN_GROOVE, np.add(IN_GROOVE, [0.0, 0.02, 0.0]), 400)))["force"]
    np.testing.assert_allclose(force[-1, 1], -0.5 * F, atol=1e-9)


def test_each_patch_is_in_the_record():
    running = engine(*groove(stuff=[material(), material(LATE)]))
    record = in_groove(running, line(IN_GROOVE, np.add(IN_GROOVE, [0.0, 0.02, 0.0]), 400))[-1:]
    for i in (0, 1):
        number = int(record[f"contacts{i}.object"][0])
        rubbing, n = (0.5, 0.1)[number], WALLS[number]
        np.testing.assert_allclose(record[f"contacts{i}.normal"][0], n, atol=1e-15)
        np.testing.assert_allclose(record[f"contacts{i}.force"][0], F * n - [0.0, rubbing * F, 0.0], atol=1e-9)
        np.testing.assert_allclose(record[f"contacts{i}.point"][0] @ n, 0.0, atol=1e-15)
        assert record[f"contacts{i}.mode"][0] == 2.0
    assert {record[f"contacts{i}.object"][0] for i in range(3)} == {0.0, 1.0, -1.0}
    both = record["contacts0.force"] + record["contacts1.force"]
    np.testing.assert_allclose(both, record["force"], atol=1e-15)


@pytest.mark.parametrize("order", ORDERS)
def test_the_first_patch_has_the_largest_load(order):
    running = engine(*groove(order, [material(stiffness_n_per_m=3000.0), material()]))
    record = in_groove(running, np.tile(IN_GROOVE, (3, 1)))[-1:]
    for i in (0, 1):
        number = int(record[f"contacts{i}.object"][0])
        force = np.linalg.norm(record[f"contacts{i}.force"])
        assert order[number] == i and force == pytest.approx((3.0, 1.0)[i] * F, rel=1e-12)


def test_equal_walls_give_no_moment_about_the_bisector():
    records = in_groove(engine(*groove()), line(IN_GROOVE, np.add(IN_GROOVE, [0.0, 0.02, 0.0]), 400))
    assert np.abs(records["torque"][:, 2]).max() < 1e-15
    # About the axis across: both friction forces act r sin 45 below the centre.
    np.testing.assert_allclose(records["torque"][-1], [-R * F / SQRT2, 0.0, 0.0], atol=1e-12)


def test_a_spin_about_the_bisector_gives_no_force_along_the_groove():
    """By symmetry the tangential forces cancel, and the torques add."""
    running = engine(*groove())
    records = in_groove(running, np.tile(IN_GROOVE, (400, 1)), turning(2, 1.0, 400))
    assert np.abs(records["force"][:, :2]).max() < 1e-12
    # Each patch rubs with mu_d f at a distance r sin 45 from the bisector.
    np.testing.assert_allclose(records["torque"][-1], [0.0, 0.0, -2.0 * 0.5 * F * R / SQRT2], atol=1e-9)


def test_rotation_about_the_groove_rubs_on_both_walls():
    """As for a shaft in a V-block, the friction of each wall loads the other: they bear F (1 + mu) / (1 + mu^2) and F
    (1 - mu) / (1 + mu^2). The torque is r mu_d (f1 + f2) = 5.66 mN m; the force is that of the proxy's spring."""
    running = engine(*groove())
    records = in_groove(running, np.tile(IN_GROOVE, (400, 1)), turning(1, 1.0, 400))
    np.testing.assert_allclose(records["torque"][-1], [0.0, -R * 0.5 * 2.0 * F / 1.25, 0.0], atol=1e-12)
    np.testing.assert_allclose(records["force"][-1], [0.0, 0.0, 1.0], atol=1e-12)


def test_object_indices_follow_the_scene_file():
    """A plane between nine spheres; kernels process eight or more in a row."""
    ball = {"shape": "sphere", "radius_m": 0.005, "material": material()}
    objects = [ball | {"name": f"ball {i}", "position_m": [0.03 * i, 0.0, 0.05]} for i in range(9)]
    running = engine(*objects[:4], wall("floor", (0, 0, 1)), *objects[4:])
    for number, x in zip([*range(4), *range(5, 10)], 0.03 * np.arange(9), strict=True):
        record = running.run(poses(pressing([x, 0.0, 0.064])))[-1]
        assert record[AT.contact_object] == record[AT.contacts0_object] == number
        np.testing.assert_allclose(record[AT.force : AT.force + 3], [0.0, 0.0, 1.0], atol=1e-12)
        running.reset()
    assert running.run(poses(pressing([0.0, 0.05, 0.009])))[-1, AT.contact_object] == 4.0


def test_weight_shifted_between_walls_hands_the_moment_on():
    """When the load shifts between walls, the torque changes no faster than the shift of the load."""
    running = engine(*groove(stuff=[material(GRIP, STRONG)] * 2))
    spin = turning(2, 0.4, 300)
    in_groove(running, np.tile(IN_GROOVE, (300, 1)), spin)
    aside = 0.0009 * np.sin(np.linspace(0.0, 4.0 * np.pi, 2001))[1:]
    points = IN_GROOVE + np.stack([aside, np.zeros(2000), np.zeros(2000)], axis=1)
    torque = running.run(poses(points, np.tile(spin[-1], (2000, 1))))["torque"]
    # A wall's share changes by the sideways motion of the probe over the depth, 1 mm; the moment is at most k_z phi and
    # r mu_s f.
    moved = np.abs(np.diff(aside))
    slope = 2.0 * (0.05 * 0.4 + R * 0.6 * SQRT2)
    assert (np.linalg.norm(np.diff(torque, axis=0), axis=1) <= slope * moved / 0.001 + 1e-12).all()


@pytest.mark.parametrize("law", [{}, {"exponent": 0.3}, {"model": "soft_finger_proxy"}], ids=str)
def test_each_wall_winds_its_share_of_the_torsional_spring(law):
    """Spun by phi about the bisector, each of two equal walls winds k_z / 2 by phi cos 45 about its normal."""
    running = engine(*groove(stuff=[material(None, STRONG | law)] * 2), rolling=None)
    spin = turning(2, 0.05, 50)
    records = in_groove(running, np.tile(IN_GROOVE, (50, 1)), spin)
    # A rotation of 1 mrad about an axis 45 degrees off projects exactly up to a relative error of 1e-6 / 24.
    np.testing.assert_allclose(records["torque"][:, 2], -0.05 * 0.5 * spin[:, 2], rtol=1e-7)


def test_a_wound_spin_is_projected_onto_the_normal_of_the_next_wall():
    """Half of it at 60 degrees between the normals; the first wall retains the full angle."""
    normals = np.array([[0.5, 0.0, 0.75**0.5], [-0.5, 0.0, 0.75**0.5]])
    running = engine(*groove(angle=np.pi / 6.0, stuff=[material(None, STRONG)] * 2), rolling=None)
    on_one, on_both = (np.linalg.solve(normals[:, [0, 2]], gaps) for gaps in ([R - 0.001, R + 0.001], [R - 0.001] * 2))
    on_one, on_both = (np.array([x, 0.0, z]) for x, z in (on_one, on_both))
    running.run(poses(pressing(on_one)))
    spin = np.linspace(0.0, 0.05, 51)[1:, None] * normals[0]
    assert running.run(poses(np.tile(on_one, (50, 1)), spin))[-1, AT.contacts1_object] == -1.0
    record = running.run(poses(line(on_one, on_both, 50), np.tile(spin[-1], (50, 1))))[-1]
    spins = {float(record[f"contacts{i}.object"]): record[f"contacts{i}.spin"] for i in (0, 1)}
    # Sums of a hundred angles.
    assert spins == {0.0: pytest.approx(0.05, rel=1e-12), 1.0: pytest.approx(0.025, rel=1e-12)}


def test_weight_shifted_between_walls_keeps_the_moment_against_rolling():
    """The moment 3/16 alpha r (f1 + f2) phi and its stored energy are constant while the load shifts between walls."""
    running = engine(*groove(stuff=[material(None)] * 2), rolling=None, **SOFT)
    turn = turning(1, 0.02, 20)
    in_groove(running, np.tile(IN_GROOVE, (20, 1)), turn)
    aside = 0.0009 * np.sin(np.linspace(0.0, 4.0 * np.pi, 401))[1:]
    points = IN_GROOVE + np.stack([aside, np.zeros(400), np.zeros(400)], axis=1)
    torque = running.run(poses(points, np.tile(turn[-1], (400, 1))))["torque"]
    # Four hundred roots and products, each rounded.
    np.testing.assert_allclose(torque[:, 1], -3.0 / 16.0 * 0.4 * R * 2.0 * F * 0.02, rtol=1e-11)


BALL, DEEP, ARC = 0.05, 0.001, 0.4
"""Radius of a ball and penetration depth, m, and an angle on the ball, rad; sticking, an error of depth x angle would
be 0.4 N."""

STUCK = material({"static": 5.0, "kinetic": 4.0})
FAR = wall("far", (0.0, 0.0, 1.0), offset=-5.0)


def over_the_ball(angles, turned):
    """Records of a path over the ball by `angles` (n,) about y; the fingertip turns by `turned` (n,)."""
    running = engine({"name": "ball", "shape": "sphere", "radius_m": BALL, "material": STUCK}, FAR)
    out = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=1)
    running.run(poses(pressing((0.0, 0.0, BALL + R - DEEP))))
    return running.run(poses((BALL + R - DEEP) * out, np.outer(turned, (0.0, 1.0, 0.0))))


def test_a_followed_roll_over_a_curve_winds_nothing():
    """The probe moves by (R + r - d) d(phi), less than the centre, which is not a slip."""
    angles = ARC * np.sin(np.linspace(0.0, np.pi, 1201))
    records = over_the_ball(angles, (BALL + R) / R * angles)
    assert records["contact.rolled"][-1] == pytest.approx(2.0 * (BALL + R) / R * ARC, rel=1e-3)  # out and back
    assert records["contact.tangential_force"].max() < 1e-5


def test_a_drag_over_a_curve_is_wound_by_the_motion_of_the_probe():
    """The sticking surface point has a constant normal: K_t times the displacement of the probe along it."""
    angles = 0.08 * np.sin(np.linspace(0.0, np.pi, 1201))  # within the cone, 5 N
    records = over_the_ball(angles, 0.0 * angles)
    wound = 1000.0 * (BALL + R - DEEP) * np.sin(angles)
    assert records["contact.tangential_force"] == pytest.approx(wound, abs=1e-6)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("along", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_a_wall_that_slides_past_adds_its_friction(order, along):
    """The wall's 0.25 N add along a fixed floor; upwards they unload the floor by the same amount."""
    motion = {"kind": "sinusoid", "translation_m": [0.0, 0.0, 0.0], "frequency_hz": 0.1}
    slides = wall("wall", (1, 0, 0)) | {"motion": motion}
    # The motion is given in the wall's frame: z is the normal, x is -z of the world, y is y.
    slides["motion"]["translation_m"] = [0.0, 0.1 * along[1], 0.0] if along[1] else [-0.1, 0.0, 0.0]
    objects = [wall("floor", (0, 0, 1)), slides]
    running = engine(*[objects[i] for i in order])
    records = running.run(poses(np.tile(np.array([R - 0.0005, 0.0, R - 0.001]), (500, 1))))
    expected = np.array([0.5, 0.25 * along[1], 1.0])
    np.testing.assert_allclose(records["force"][-1], expected, atol=1e-12)
    borne = {records[f"contacts{i}.object"][-1]: records[f"contacts{i}.force"][-1] for i in (0, 1)}
    on_wall = np.array([0.5, 0.0, 0.0]) + 0.25 * np.array(along)
    np.testing.assert_allclose(borne[float(order.index(1))], on_wall, atol=1e-12)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("order", ORDERS)
def test_a_wall_that_moves_in_has_its_damping(order):
    stuff = material(None, damping_ns_per_m=20.0)
    turning = {"kind": "sinusoid", "translation_m": [0.0, 0.0, 0.05], "frequency_hz": 1.0 / (2.0 * np.pi) / 5.0}
    objects = [wall("floor", (0, 0, 1), material(None)), wall("wall", (1, 0, 0), stuff) | {"motion": turning}]
    running = engine(*[objects[i] for i in order], rolling=None)
    records = running.run(poses(np.tile(np.array([R + 0.001, 0.0, R - 0.001]), (601, 1))))
    time = records["timestamp"] + 0.001
    depth = 0.05 * np.sin(time / 5.0) - 0.001
    speed = np.diff(depth) / 0.001
    expected = np.minimum(1000.0 * depth[1:] + 20.0 * speed, 2000.0 * depth[1:])
    late = depth[1:] > 1e-4
    assert late.sum() > 400
    np.testing.assert_allclose(records["force"][1:][late, 0], expected[late], atol=1e-9)


def test_a_shallow_valley_is_nearly_a_plane():
    half = np.radians(0.5)
    running = engine(*groove(angle=half))
    start, end = np.array([-0.005, 0.0, R - 0.001]), np.array([0.005, 0.0, R - 0.001])
    running.run(poses(pressing(start)))
    force = running.run(poses(line(start, end, 800)))["force"]
    plane = engine(wall("plane", (0, 0, 1)))
    plane.run(poses(pressing(start)))
    # A slope of half a degree tilts a force of 1 N by 9 mN; its depth is 44 um larger at the ends, which is 44 mN;
    # friction adds half of both. After 0.7 mm both contacts slide.
    assert np.abs(force - plane.run(poses(line(start, end, 800)))["force"])[56:].max() < 0.07
    # A tick of 12.5 um, two of which cross the crease: friction can change by at most 2 mu sin(1 degree) f.
    assert np.abs(np.diff(force[56:], axis=0)).max() < 2.0 * 0.5 * np.sin(2.0 * half) * 1.05


def test_forces_of_a_pinch_add():
    """Floor 1 mm deep, ceiling 3 mm deep: 1 N up, 3 N down, and friction on each."""
    gap = 2.0 * R - 0.004
    running = engine(*[wall("floor", (0, 0, 1)), wall("ceiling", (0, 0, -1), offset=-gap)])
    at = np.array([0.0, 0.0, R - 0.001])
    records = running.run(poses(np.vstack([np.tile(at, (10, 1)), line(at, np.add(at, [0.01, 0.0, 0.0]), 500)])))
    np.testing.assert_allclose(records["force"][5], [0.0, 0.0, -2.0], atol=1e-12)
    np.testing.assert_allclose(records["force"][-1], [-0.5 * 4.0, 0.0, -2.0], atol=1e-9)


JAWS = [np.array([np.cos(a), np.sin(a), 0.0]) for a in 2.0 * np.pi / 3.0 * np.arange(3)]
CLOSING = 0.003
"""Travel of each jaw from 1 mm clearance, m."""


def jaws():
    motion = {"kind": "sinusoid", "translation_m": [0.0, 0.0, CLOSING], "frequency_hz": 0.5}
    stuff = material(GRIP, STRONG)
    return engine(*(wall(f"jaw {i}", n, stuff, -R - 0.001) | {"motion": motion} for i, n in enumerate(JAWS)))


def test_three_jaws_centre_the_finger():
    """Closed by t, each jaw bears K t with zero net force; at an offset s from the centre they act as a spring K. While
    there is room only the nearest jaw does, and the force is continuous where the room ends."""
    running, aside = jaws(), 0.0004
    records = running.run(poses(np.tile([-aside, 0.0, 0.0], (500, 1))))
    t = CLOSING * np.sin(np.pi * (records["timestamp"] + 0.001)) - 0.001
    force = records["force"]
    closed, away = t > 0.0, t < -aside
    assert closed.sum() > 300 and away.sum() > 50
    # Rounding of about 10 mm times 1000 N/m. The hand is at rest, so friction is zero.
    np.testing.assert_allclose(force[closed], np.tile([1000.0 * aside, 0.0, 0.0], (closed.sum(), 1)), atol=1e-11)
    np.testing.assert_allclose(force[away], 0.0, atol=1e-11)
    fastest = 2.0 * np.pi * 0.5 * CLOSING * 0.001  # travel of a jaw in a tick, m
    assert np.linalg.norm(np.diff(force, axis=0), axis=1).max() < 1000.0 * fastest
    for i in range(3):
        on = records[closed][:, [AT.contacts0_object, AT.contacts1_object, AT.contacts2_object]] == i
        forces = [records[f"contacts{k}.force"][closed] for k in range(3)]
        pressing = sum(on[:, k] * (forces[k] @ JAWS[i]) for k in range(3))
        deep = t[closed] + (aside if i == 0 else 0.0)
        np.testing.assert_allclose(pressing, 1000.0 * deep, atol=1e-11)


def test_three_jaws_resist_a_twist_and_a_tilt():
    """Spun about their axis, each jaw rubs with mu_d K t at r; tilted, it winds by the tilt about its normal. Each has
    a third of the springs: k_z about a normal n, K r^2 across. The mean of n n^T is 1/2 in the plane of the jaws."""
    running, angle = jaws(), 0.01
    np.testing.assert_allclose(running.run(poses(np.zeros((500, 3))))["force"][-1], 0.0, atol=1e-11)
    vectors = turning(0, angle, 10)
    tilted = running.run(poses(np.zeros((10, 3)), vectors))["torque"]
    # A roll in steps of 1 mrad about an axis that no patch rotates about: exact up to second order.
    np.testing.assert_allclose(tilted[-1], [-0.5 * (0.05 + 1000.0 * R**2) * angle, 0.0, 0.0], atol=1e-9)
    running.reset()
    running.run(poses(np.zeros((500, 3))))
    vectors = turning(2, 1.5, 200)
    spun = running.run(poses(np.zeros((200, 3)), vectors))["torque"]
    # The jaws are opening again, 0.7 s after they started to close.
    load = 3.0 * 1000.0 * (CLOSING * np.sin(0.7 * np.pi) - 0.001)
    np.testing.assert_allclose(spun[-1], [0.0, 0.0, -R * 0.5 * load], atol=1e-9)


def test_each_wall_has_the_contact_patch_of_its_own_load():
    """Spun by phi about the bisector, each patch winds by phi / sqrt 2 with stiffness f R, up to mu_s 3 pi / 16 a f."""
    running = engine(*groove(stuff=[material(GRIP, LIMP)] * 2), **SOFT)
    spin = turning(2, 1.0, 300)
    records = in_groove(running, np.tile(IN_GROOVE, (300, 1)), spin)
    a = (3.0 * F * R / (16.0 * 45e3)) ** (1.0 / 3.0)
    limit = 0.6 * 3.0 * np.pi / 16.0 * a * F
    wound = np.minimum(spin[:, 2] / SQRT2, limit / (F * R))
    assert wound[0] < wound[-1] < spin[-1, 2] / SQRT2  # it winds, and it slips
    np.testing.assert_allclose(records["contact.patch_radius"], a, rtol=1e-9)
    for column in ("contacts0.spin", "contacts1.spin", "contact.spin"):
        np.testing.assert_allclose(records[column], wound, rtol=1e-9)
    np.testing.assert_allclose(records["contact.torsion"], -F * R * wound, rtol=1e-9)


def test_each_wall_resists_rolling_by_its_own_load():
    """Rotated about the groove's axis without friction, each wall resists with 3/16 alpha a f once it slips."""
    running = engine(*groove(stuff=[material(None)] * 2), rolling=None, **SOFT)
    turn = turning(1, 1.0, 300)
    records = in_groove(running, np.tile(IN_GROOVE, (300, 1)), turn)
    a = (3.0 * F * R / (16.0 * 45e3)) ** (1.0 / 3.0)
    moment = 2.0 * np.minimum(3.0 / 16.0 * 0.4 * R * F * turn[:, 1], 3.0 / 16.0 * 0.4 * a * F)
    np.testing.assert_allclose(records["torque"][:, 1], -moment, rtol=1e-9)
