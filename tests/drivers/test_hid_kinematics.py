"""Kinematics of the three-joint arm: published values, inverse, Jacobian, wrist."""

import numpy as np
import pytest
from emulators.woodenhaptics import TABLE, Arm
from helpers.hid_devices import RIGS, rig_options
from scipy.spatial.transform import Rotation

from softfinger.drivers.kinematics import chain
from softfinger.drivers.kinematics.options import Chain

pytestmark = pytest.mark.plain


def arm_of(rig: str) -> chain.Chain:
    kinematics = rig_options(rig).kinematics
    assert isinstance(kinematics, Chain)
    return chain.make_chain(kinematics)


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
    assert isinstance(kinematics, Chain)
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
