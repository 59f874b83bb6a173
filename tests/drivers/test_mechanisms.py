"""Paddle, pantograph, delta and three-joint arm: closed forms, published values, derivatives, power, singular poses."""

from collections.abc import Callable
from functools import partial
from math import acos, atan2, hypot, pi, radians, sqrt
from typing import Any

import numpy as np
import pytest
from emulators.woodenhaptics import TABLE, Arm
from helpers.hid_devices import RIGS, rig_options
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from softfinger.config.load import build, load_rig
from softfinger.drivers.fields import table
from softfinger.drivers.hid.device import Options as HidOptions
from softfinger.drivers.kinematics import chain, delta, mechanism, options, pantograph
from softfinger.drivers.kinematics.mechanism import FULL, SINGULAR

pytestmark = pytest.mark.plain

EXACT: Any = {"rtol": 0, "atol": 1e-12}
"""m, m/rad and N m of devices within 0.3 m: a thousand times rounding."""

ARM = build(HidOptions, load_rig("woodenhaptics-2019").device.options, "woodenhaptics-2019").kinematics
MECHANISMS: dict[str, options.Kinematics] = {
    "paddle": options.Paddle(length_m=0.07, torque_max_nm=9.0),
    "pantograph": options.Pantograph(
        base_m=0.038, inner_m=0.07, outer_m=0.09, origin_m=(0.019, 0.1, 0.0), torque_max_nm=9.0
    ),
    "motors on one axis": options.Pantograph(base_m=0.0, inner_m=0.07, outer_m=0.09, torque_max_nm=9.0),
    "delta": options.Delta(
        base_m=0.06, end_m=0.03, arm_m=0.08, rod_m=0.17, origin_m=(0.0, 0.0, 0.2), torque_max_nm=9.0
    ),
    "delta with legs elsewhere": options.Delta(
        base_m=0.05, end_m=0.02, arm_m=0.1, rod_m=0.2, legs_deg=(10.0, 125.0, 250.0), torque_max_nm=9.0
    ),
    "chain": ARM,
    "chain of unlike joints": replace(ARM, body_m=(0.16, 0.12, 0.09), torque_constant_nm_per_a=(0.03, 0.05, 0.02)),
}  # fmt: skip


def pose(name: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return joint angles (rad) in the middle of a device's workspace; counts of a chain's encoders."""
    if name == "paddle":
        return (rng.uniform(-0.6, 0.6), 0.0, 0.0)
    if name.startswith("chain"):
        a, b, c = rng.uniform(-2000.0, 2000.0, 3)
        return (a, b, c)
    return (rng.uniform(radians(120.0), radians(165.0)), rng.uniform(radians(15.0), radians(60.0)), 0.0)


class MechanismProbe:
    def __init__(self, kinematics: options.Kinematics) -> None:
        self.kind, self.mechanism = mechanism.find_kind(kinematics, False), mechanism.make_mechanism(kinematics, 5.0)
        self.values, self.last = np.zeros(table.SENSED_SIZE), np.array(self.mechanism.delta.home)

    def end(self, joints: Any) -> np.ndarray:
        self.values[table.COUNTS : table.COUNTS + 3] = joints
        position, orientation, how = mechanism.forward_kinematics(self.kind, self.mechanism, self.values, self.last)
        assert how == FULL
        assert orientation == (1.0, 0.0, 0.0, 0.0)
        return np.array(position)

    def torques(self, joints: Any, force: Any) -> tuple[int, np.ndarray]:
        """Return the status of the force, and torques (N m), or currents (A) of a chain."""
        self.end(joints)
        torques = np.zeros(table.COMMANDED_SIZE)
        how = mechanism.compute_command(self.kind, self.mechanism, self.values, self.last, tuple(force), torques)
        at = table.CURRENT if self.mechanism.chain != mechanism.NO_MECHANISM.chain else table.TORQUE
        return how, torques[at : at + 3]


def along(of: Callable[[Any], np.ndarray], at: Any, direction: Any, t: float) -> np.ndarray:
    return of(at + t * direction)


def derivative(of: Callable[[float], np.ndarray], h: float) -> np.ndarray:
    """Return the derivative at 0 by central differences of order 8: error h^8 of the 9th derivative, rounding / h."""
    weights = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
    return sum(w * (of(k * h) - of(-k * h)) for k, w in enumerate(weights, 1)) / h


@pytest.mark.parametrize("name", [name for name in MECHANISMS if not name.startswith("delta")])
def test_power_out_is_power_in(name: str) -> None:
    """f . v = tau . q' with v by differences of the forward kinematics: checks each column of the Jacobian."""
    kinematics = MECHANISMS[name]
    rng, ask, per, step, size = np.random.default_rng(31), MechanismProbe(kinematics), np.ones(3), 2e-3, 1.0
    if isinstance(kinematics, options.Chain):  # of its motors tau q' is k I 2 pi n' / N
        per = np.array(kinematics.torque_constant_nm_per_a) * 2 * pi / kinematics.counts_per_turn
        step, size = 2.0, 0.3  # counts; no current beyond the maximum
    for _ in range(200):
        joints, turning = np.array(pose(name, rng)), rng.normal(size=3) * ([1, 0, 0] if name == "paddle" else [1, 1, 1])
        if "pantograph" in name or "one axis" in name:
            turning[2] = 0.0
        force = rng.normal(size=3) * size
        speed = derivative(partial(along, ask.end, joints, turning), step)
        how, torque = ask.torques(joints, force)
        assert how == FULL
        np.testing.assert_allclose(np.dot(torque * per, turning), np.dot(force, speed), **EXACT)


@pytest.mark.parametrize("name", ["delta", "delta with legs elsewhere"])
def test_power_of_a_delta(name: str) -> None:
    """The same, with the legs' speeds by differences of the inverse kinematics, which is in closed form."""
    rng, ask = np.random.default_rng(34), MechanismProbe(MECHANISMS[name])
    d = ask.mechanism.delta
    for _ in range(200):
        p = rng.uniform((-0.02, -0.02, -0.03), (0.02, 0.02, 0.0)) + d.home
        speed, force = rng.normal(size=3), rng.normal(size=3)
        turning = derivative(
            partial(along, lambda at: np.array(delta.compute_leg_angles(d, tuple(at))[0]), p, speed), 2e-4
        )
        how, torque = ask.torques(delta.compute_leg_angles(d, tuple(p))[0], force)
        assert how == FULL
        # eps / h of angles of 1 rad is 1e-12, and h^8 of a derivative that grows by 1 / 0.03 with each order
        np.testing.assert_allclose(np.dot(torque, turning), np.dot(force, speed), rtol=0, atol=1e-11)


def test_a_paddle_moves_on_its_circle() -> None:
    ask, r = MechanismProbe(MECHANISMS["paddle"]), 0.07
    assert ask.end((0.0, 0.0, 0.0)).tolist() == [0.0, 0.0, 0.0]
    for a in np.linspace(-1.0, 1.0, 21):
        x, y, z = ask.end((a, 0.0, 0.0))
        assert y == 0.0
        np.testing.assert_allclose((hypot(x, z + r), atan2(x, z + r)), (r, a), **EXACT)


@pytest.mark.parametrize("name", ["pantograph", "motors on one axis"])
def test_a_pantograph_inverts_two_triangles(name: str) -> None:
    """Angles by the law of cosines for a position give that position, so the outer links have their length."""
    kinematics, rng = MECHANISMS[name], np.random.default_rng(32)
    ask = MechanismProbe(kinematics)
    for _ in range(500):
        x, y = rng.uniform(-0.04, 0.04) + 0.5 * kinematics.base_m, rng.uniform(0.06, 0.13)
        joints = [0.0, 0.0, 0.0]
        for k, (from_x, side) in enumerate(((0.0, 1.0), (kinematics.base_m, -1.0))):
            far = hypot(x - from_x, y)
            bent = acos((kinematics.inner_m**2 + far**2 - kinematics.outer_m**2) / (2 * kinematics.inner_m * far))
            joints[k] = atan2(y, x - from_x) + side * bent
        np.testing.assert_allclose(ask.end(joints) + kinematics.origin_m, (x, y, 0.0), **EXACT)


def test_the_published_pantograph() -> None:
    ask = MechanismProbe(MECHANISMS["pantograph"])
    joints = (radians(168.0), radians(12.0), 0.0)
    half = 0.019 + 0.07 * np.cos(radians(12.0))
    height = 0.07 * np.sin(radians(12.0)) + sqrt(0.09**2 - half**2)
    np.testing.assert_allclose(ask.end(joints) + np.array((0.019, 0.1, 0.0)), (0.019, height, 0.0), **EXACT)
    how, torque = ask.torques(joints, (0.0, 1.0, 0.0))
    assert how == FULL
    np.testing.assert_allclose(torque[0], -torque[1], **EXACT)


@pytest.mark.parametrize("name", ["delta", "delta with legs elsewhere"])
def test_a_delta_inverts_its_triangles(name: str) -> None:
    config, rng = MECHANISMS[name], np.random.default_rng(33)
    ask = MechanismProbe(config)
    for _ in range(200):
        p = rng.uniform((-0.02, -0.02, -0.03), (0.02, 0.02, 0.0)) + ask.mechanism.delta.home
        joints = []
        for degrees in config.legs_deg:
            c, s = np.cos(radians(degrees)), np.sin(radians(degrees))
            across, z = -s * p[0] + c * p[1], p[2]
            out = c * p[0] + s * p[1] + config.end_m - config.base_m  # from the motor's axis, in the leg's plane
            far, rod = hypot(out, z), sqrt(config.rod_m**2 - across**2)
            bent = acos((config.arm_m**2 + far**2 - rod**2) / (2 * config.arm_m * far))
            joints.append(atan2(z, out) - bent)
        np.testing.assert_allclose(ask.end(joints) + config.origin_m, p, **EXACT)


def test_aligned_links_give_no_force() -> None:
    kinematics = options.Pantograph(base_m=0.2, inner_m=0.07, outer_m=0.12, torque_max_nm=1e9)
    ask, force = MechanismProbe(kinematics), (0.3, 1.0, 0.0)
    results = set()
    last = None
    for a in np.linspace(radians(80.0), radians(140.0), 8000):
        joints = (a, pi - a, 0.0)
        *_, sine = pantograph.compute_jacobian(ask.mechanism.pantograph, a, pi - a)
        how, torque = ask.torques(joints, force)
        results.add(how)
        if sine <= pantograph.SINE_NONE:
            assert how == SINGULAR and not torque.any()
        elif sine < pantograph.SINE_FULL:
            assert how == SINGULAR
        else:
            assert how == FULL
        assert np.abs(torque).max() <= 0.07 * np.hypot(0.3, 1.0) / pantograph.SINE_NONE
        if last is not None:  # no step over 0.0075 degrees: it grows to 0.7 N m and falls to 0 in between
            assert np.abs(torque - last).max() < 0.02
        last = torque
    assert results == {FULL, SINGULAR}
    np.testing.assert_allclose(ask.end((pi, 0.0, 0.0)), (0.1, 0.0, 0.0), **EXACT)
    both = MechanismProbe(options.Pantograph(base_m=0.0, inner_m=0.07, outer_m=0.09, torque_max_nm=1.0))
    assert np.isfinite(both.end((1.0, 1.0, 0.0))).all()  # coincident elbows
    assert both.torques((1.0, 1.0, 0.0), force)[0] == SINGULAR


def test_a_delta_out_of_reach_has_no_pose() -> None:
    kinematics = MECHANISMS["delta"]
    ask = MechanismProbe(kinematics)
    home = ask.mechanism.delta.home
    angles = delta.compute_leg_angles(ask.mechanism.delta, home)[0]
    # legs and rods in one line, all alike: base + (arm + rod) cos a = end
    in_line = acos((kinematics.end_m - kinematics.base_m) / (kinematics.arm_m + kinematics.rod_m))
    for joints in ((0.0, 0.0, 3.0), (in_line,) * 3):
        ask.values[table.COUNTS : table.COUNTS + 3] = joints
        position, _, how = mechanism.forward_kinematics(ask.kind, ask.mechanism, ask.values, ask.last)
        assert how == SINGULAR and np.isnan(position).all()
        np.testing.assert_allclose(ask.end(angles), np.subtract(home, kinematics.origin_m), **EXACT)


def test_a_delta_gives_no_force_near_a_singular_pose() -> None:
    d = mechanism.make_mechanism(
        options.Delta(base_m=0.12, end_m=0.02, arm_m=0.1, rod_m=0.17, torque_max_nm=9.0), 5.0
    ).delta
    results = set()
    # on the axis all rods are flat where base + arm cos a = end + rod; the end is then as high as the elbows
    flat = 0.1 * sqrt(1.0 - ((0.02 + 0.17 - 0.12) / 0.1) ** 2)
    for height in np.linspace(d.home[2], flat, 1000):
        torque, able = delta.compute_torques(d, (0.0, 0.0, float(height)), (0.0, 0.0, 1.0))
        _, rows = delta.compute_leg_angles(d, (0.0, 0.0, float(height)))
        det = abs(np.linalg.det(rows)) * d.arm**3
        results.add(able)
        assert able == (det > delta.DET_MIN)
        assert able or torque == (0.0, 0.0, 0.0)
    assert results == {True, False}


@pytest.mark.parametrize(
    ("name", "kind", "joints"),
    [("paddle", mechanism.PADDLE, (0.2, 0.0, 0.0)), ("pantograph", mechanism.PANTOGRAPH, (2.4, 0.7, 0.0))],
)
def test_limited_torques_preserve_the_direction(name: str, kind: int, joints: tuple[float, float, float]) -> None:
    ask = MechanismProbe(MECHANISMS[name])
    assert ask.kind == kind
    _, whole = ask.torques(joints, (1.0, 0.5, 0.0))
    ask.mechanism = ask.mechanism._replace(torque_max=0.01)
    how, cut = ask.torques(joints, (1.0, 0.5, 0.0))
    assert how == mechanism.LIMITED
    assert np.abs(cut).max() == pytest.approx(0.01, abs=1e-15)
    np.testing.assert_allclose(cut * np.abs(whole).max(), whole * 0.01, rtol=1e-12, atol=1e-18)


def arm_of(rig: str) -> chain.Chain:
    return chain.make_chain(rig_options(rig).kinematics)


def test_published_positions_and_currents() -> None:
    arm = arm_of("woodenhaptics-2019")
    angles = chain.compute_angles(arm, (500.0, -800.0, 1200.0))
    half = 0.5e-5  # of the last digit
    np.testing.assert_allclose(chain.forward(arm, angles), (-0.18707, 0.00324, -0.03249), rtol=0, atol=half)
    along_x, along_z = (chain.compute_currents(arm, angles, f)[0] for f in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    np.testing.assert_allclose(along_x, (-0.00063, 0.27578, 0.32046), rtol=0, atol=half)
    np.testing.assert_allclose(along_z, (0.0, 0.05890, 0.10463), rtol=0, atol=half)


@pytest.mark.parametrize("rig", RIGS)
def test_rigs_contain_the_published_table(rig: str) -> None:
    """Each rig's numbers equal the emulator's table, which was written independently."""
    capstan, link, body, origin, constants, counts, calibration, aligned = TABLE[RIGS[rig]]
    kinematics = rig_options(rig).kinematics
    assert kinematics.capstan_m == pytest.approx([d * 1e-3 for d in capstan], abs=1e-12)  # mm converted to m
    assert kinematics.body_m == pytest.approx([d * 1e-3 for d in body], abs=1e-12)
    assert (kinematics.link_m, kinematics.origin_m) == (link, origin)
    assert (kinematics.torque_constant_nm_per_a, kinematics.counts_per_turn) == (constants, counts)
    assert (kinematics.calibration_counts, kinematics.aligned) == (calibration, tuple(map(bool, aligned)))


@pytest.mark.sampled(3)
@pytest.mark.parametrize("rig", RIGS)
def test_forward_inverts_an_independent_inverse(rig: str) -> None:
    """20 000 random points of each workspace are recovered to 1e-9 m from angles computed with triangles."""
    arm, independent = arm_of(rig), Arm(RIGS[rig])
    radius = rig_options(rig).workspace_radius_m
    generator = np.random.default_rng(5)
    points = generator.normal(size=(30_000, 3))
    points *= (radius * generator.random(len(points)) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    # points out of reach of the two links are not in this arm's workspace
    la, lb, lc = independent.link
    x, y, z = (points + independent.origin).T
    reach = np.hypot(np.hypot(x, y), z - la)
    points = points[(reach < lb + lc) & (reach > abs(lb - lc))][:20_000]
    assert len(points) == 20_000
    worst = max(
        max(abs(u - v) for u, v in zip(chain.forward(arm, independent.angles(point)), point, strict=True))
        for point in map(tuple, points.tolist())
    )
    assert worst < 1e-9


@pytest.mark.sampled(3)
@pytest.mark.parametrize("rig", RIGS)
def test_jacobian_is_the_derivative(rig: str) -> None:
    arm = arm_of(rig)
    generator, h = np.random.default_rng(6), 1e-5
    for angles in generator.uniform(-1.2, 1.2, (200, 3)):
        columns = np.array(chain.compute_jacobian(arm, tuple(angles)))
        for joint in range(3):
            step = np.eye(3)[joint] * h
            ahead, behind = (chain.forward(arm, tuple(angles + s)) for s in (step, -step))
            # h^2/6 of the third derivative, at most the arm's length, and rounding over 2 h
            np.testing.assert_allclose(columns[joint], np.subtract(ahead, behind) / (2 * h), atol=1e-10)
        force = generator.normal(size=3)
        current, cut = chain.compute_currents(arm._replace(current_max=1e9), tuple(angles), tuple(force))
        np.testing.assert_allclose(current, columns @ force * arm.per_torque, rtol=1e-12, atol=1e-14)
        assert not cut


def test_limited_currents_preserve_the_direction() -> None:
    arm = arm_of("woodenhaptics-2019")
    angles = chain.compute_angles(arm, (500.0, -800.0, 1200.0))
    whole, cut = chain.compute_currents(arm, angles, (5.0, 1.0, 2.0))
    assert not cut
    much, cut = chain.compute_currents(arm, angles, (50.0, 10.0, 20.0))
    assert cut
    assert max(map(abs, much)) == pytest.approx(2.0, abs=1e-15)
    np.testing.assert_allclose(np.array(much) / much[2], np.array(whole) / whole[2], rtol=1e-14)


def test_wrist_turns_as_published() -> None:
    """R = Rz(A) Ry(pi/2 - C) Rx(D) Ry(E) Rx(F) equals scipy's composition of axis rotations."""
    arm = arm_of("woodenhaptics-polhem-v1")
    generator = np.random.default_rng(8)
    for a, b, c, d, e, f in generator.uniform(-3, 3, (100, 6)):
        per_count = 2 * np.pi / 1024
        counts = (-d / per_count, e / per_count, -f / per_count)  # D and F turn against their counts
        w, x, y, z = chain.compute_orientation(arm, (a, b, c), counts)
        expected = Rotation.identity()
        for axis, angle in (("z", a), ("y", np.pi / 2 - c), ("x", d), ("y", e), ("x", f)):
            expected = expected * Rotation.from_euler(axis, angle)
        np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), expected.as_matrix(), atol=1e-13)
