"""Fingertip on a plane: cases with results worked out by hand, and a NumPy reference of one tick in random motion.

The plane of conftest.paper_mapping: r = 10 mm, K_n = K_t = k_tau = 1000 N/m, pressed 1 mm so that f_N = 1 N, mu 0.6 /
0.5, k_z = 0.05 N m/rad, mu_t = 4 mm, no damping, 1 kHz. EXACT covers the rounding of a few hundred additions of forces.
"""

import numpy as np
import pytest
from conftest import paper_scene
from helpers.examples import Cases
from references.contact_reference import Parameters, ReferenceContact
from references.hand import Hand, on_plane, plane_engine, pressed
from references.rolling_reference import zxz_roll
from references.rotation import matrix, quaternion, rodrigues

from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import CAUSE_NAMES, ROLLING, SLIDING

pytestmark = pytest.mark.plain

R, EXACT = 0.01, 1e-12


@pytest.mark.parametrize("ticks", [1, 10, 200])
def test_roll_at_a_fixed_position_winds_the_coupling(ticks: int) -> None:
    """A roll of 0.05 rad moves the proxy by r times as much, and the coupling pulls the probe towards it."""
    trace = on_plane(pressed().go(ticks, turn=[0.05, 0, 0]))
    last = trace.steps[-1]
    assert last.force == pytest.approx([0, -0.5, 1], abs=EXACT)
    assert last.torque == pytest.approx([-0.005, 0, 0], abs=EXACT)
    assert last.proxy_position == pytest.approx([0, -0.5e-3, R], abs=EXACT)
    assert last.point == pytest.approx([0, -0.5e-3, 0], abs=EXACT)
    assert last.finger_point == pytest.approx([0, -R * np.sin(0.05), -R * np.cos(0.05)], abs=EXACT)
    assert last.rolled == pytest.approx(0.05, abs=EXACT) and last.spin == pytest.approx(0, abs=EXACT)
    assert last.mode == ROLLING
    assert trace.events == [(1, "touch")]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("k_tau", "angle"), [(None, 0.06), (250.0, 0.24)])
def test_roll_past_theta_max_slides(k_tau: float | None, angle: float) -> None:
    """A roll at a fixed position slides at theta_max = mu_s f_N / (k_tau r): peak mu_s f_N, then mu_d f_N."""
    trace = on_plane(pressed().go(501, turn=[0.5, 0, 0]), rolling={"torque_stiffness_n_per_m": k_tau})
    assert trace.causes == ["touch", "theta_max"]
    tick = trace.events[1][0]
    # 501 ticks for 0.5 rad: theta_max is between two ticks.
    assert tick == 1 + int(np.ceil(angle * 501 / 0.5))
    assert trace.tangential.max() == pytest.approx(0.6, rel=EXACT)
    assert trace.tangential[tick] == pytest.approx(0.6, rel=EXACT)
    assert trace.force[tick + 1 :] == pytest.approx(np.tile([0, -0.5, 1], (501 - tick + 1, 1)), abs=EXACT)
    assert (trace.mode[tick:] == SLIDING).all()


def test_roll_with_the_probe_following() -> None:
    trace = on_plane(pressed().go(1000, move=[0, -R, 0], turn=[1, 0, 0]))
    assert trace.tangential.max() < 1e-12 and trace.proxy[-1] == pytest.approx([0, -R, R], abs=EXACT)
    assert trace.steps[-1].rolled == pytest.approx(1.0, abs=EXACT) and trace.events == [(1, "touch")]


def test_drag_stop_and_drag_again() -> None:
    """Both drags peak at mu_s f_N and slide at mu_d f_N, with the proxy 0.5 mm behind; the stop sticks."""
    trace = on_plane(pressed().go(500, move=[0.025, 0, 0]).go(300).go(500, move=[0.025, 0, 0]))
    _, first_end, second_start, last = trace.ends
    assert trace.causes == ["touch", "drag", "stop", "drag"]
    slips = [tick for tick, cause in trace.events if cause == "drag"]
    for slip, start, end in zip(slips, [1, second_start], [first_end, last], strict=True):
        assert trace.tangential[start : end + 1].max() == pytest.approx(0.6, rel=EXACT)
        assert trace.tangential[slip] == pytest.approx(0.6, rel=EXACT)
        assert trace.force[slip + 1 : end + 1, 0] == pytest.approx(-0.5, rel=EXACT)
        lag = trace.poses[slip + 1 : end + 1, 0] - trace.proxy[slip + 1 : end + 1, 0]
        assert lag == pytest.approx(0.5e-3, rel=1e-10)
    # The stop does not release the stored force.
    assert trace.force[first_end:second_start, 0] == pytest.approx(-0.5, rel=EXACT)


def test_drag_then_reverse() -> None:
    trace = on_plane(pressed().go(500, move=[0.025, 0, 0]).go(500, move=[-0.025, 0, 0]))
    turn = trace.ends[1]
    assert trace.causes == ["touch", "drag", "reverse", "drag"]
    assert trace.force[: turn + 1, 0].min() == pytest.approx(-0.6, rel=EXACT)
    assert trace.force[turn:, 0].max() == pytest.approx(0.6, rel=EXACT)
    # The force on the hand rises from -0.5 N by K times the distance moved back, until the peak.
    peak = int(trace.force[:, 0].argmax())
    assert np.diff(trace.force[turn:peak, 0]) == pytest.approx(1000 * 50e-6, abs=1e-10)
    # Only the 0.5 mm stored by the drag unwind; after that the force opposes the motion.
    assert (trace.force[turn + 11 :, 0] > 0).all()
    # Work of the hand against the coupling: it never gets back more than it has put in.
    work = -np.cumsum(trace.force[1:, 0] * np.diff(trace.poses[:, 0]))
    assert work.min() > -1e-12
    stored = 0.5 * 1000 * (0.5e-3) ** 2
    assert work[turn:].min() >= work[turn - 1] - stored


def test_spin_and_back() -> None:
    """The anchor follows the slip at the torsional limit: 0.16 rad back reaches the limit in the other direction."""
    trace = on_plane(pressed().go(500, turn=[0, 0, 0.5]).go(160, turn=[0, 0, -0.16]))
    assert trace.steps[-1].torque == pytest.approx([0, 0, 0.004], abs=EXACT)


def test_roll_and_back() -> None:
    trace = on_plane(pressed().go(200, turn=[0.05, 0, 0]).go(200, turn=[-0.05, 0, 0]))
    assert trace.tangential[-1] < 1e-12 and trace.causes == ["touch"]


def test_roll_then_drag_against_it() -> None:
    """A roll of 0.03 rad uses half of the cone: a drag that adds to it slides after 0.3 mm."""
    trace = on_plane(pressed().go(100, turn=[0.03, 0, 0]).go(143, move=[0, 1e-3, 0]))
    assert trace.causes == ["touch", "drag"]
    tick, start = trace.events[1][0], trace.ends[1]
    # 143 ticks for 1 mm: 0.3 mm is between two ticks.
    assert tick - start == int(np.ceil(0.3 * 143))
    assert trace.tangential.max() == pytest.approx(0.6, rel=EXACT)
    assert trace.tangential[tick + 1 :] == pytest.approx(0.5, rel=EXACT)


def test_tiny_counter_tilt_does_not_disable_sliding() -> None:
    for tilt in ([0, 1e-6, 0], [0, -1e-6, 0], [1e-6, 0, 0]):
        trace = on_plane(pressed().go(1, turn=tilt).go(497, move=[0.025, 0, 0]))
        assert trace.causes == ["touch", "drag"] and trace.tangential.max() == pytest.approx(0.6, rel=EXACT)
        assert trace.tangential[-1] == pytest.approx(0.5, rel=EXACT)


@pytest.mark.parametrize("time_constant", [0.0, 0.002])
@pytest.mark.parametrize("speed", [0.05, 0.1, 0.4])
def test_withdraw_under_damping_releases_once(speed: float, time_constant: float) -> None:
    hand = pressed(0.002).go(50).go(int(0.004 / speed * 1000), move=[0, 0, 0.004])
    damped, probe = {"damping_ns_per_m": 3.0}, {"velocity_time_constant_s": time_constant}
    trace = on_plane(hand, material=damped, coupling=damped, probe=probe)
    assert trace.causes == ["touch", "release"]
    out = trace.events[1][0]
    assert trace.poses[out, 2] >= R > trace.poses[out - 1, 2] and trace.normal_force.min() >= 0.0
    assert trace.force[:, 2].min() >= 0.0
    # While the finger moves out, damping reduces K delta by B v, but not below zero.
    if time_constant == 0.0:
        start = trace.ends[1]
        depth = R - trace.poses[start + 1 : out, 2]
        assert trace.normal_force[start + 1 : out] == pytest.approx(np.maximum(1000 * depth - 3 * speed, 0), abs=1e-9)


def test_sliding_under_ripple_does_not_stick() -> None:
    """A slide at 50 mm/s whose f_N varies by 20 % at 20 Hz does not stick; the force is mu_d times the current f_N."""
    hand = pressed().go(100, move=[0.005, 0, 0])
    for i in range(1, 501):
        depth = 0.001 * (1 + 0.2 * np.sin(2 * np.pi * 20 * i / 1000))
        hand.go_to(1, [0.005 + 50e-6 * i, 0, R - depth])
    trace = on_plane(hand)
    assert trace.causes == ["touch", "drag"] and trace.normal_force[200:].max() == pytest.approx(1.2, rel=1e-3)
    assert trace.tangential[102:] == pytest.approx(0.5 * trace.normal_force[102:], rel=EXACT)


DT = 1e-3


def random_case(rng: np.random.Generator) -> tuple[Scene, Parameters]:
    """A scene of one plane at a random pose, with materials over some decades, and the reference's parameters."""
    k_n, k_t = 10 ** rng.uniform(2, 4, 2)
    k_tau = k_t * rng.choice([1.0, rng.uniform(0.1, 1.0)])
    mu_s = rng.uniform(0.1, 1.5)
    mu_d = mu_s * rng.uniform(0.3, 1.0)
    orientation = rng.normal(size=4)
    q = Parameters(
        radius=10 ** rng.uniform(-3, -1),
        k_n=k_n,
        k_t=k_t,
        k_tau=k_tau,
        damping=rng.choice([0.0, rng.uniform(0, 5)]),
        b_t=rng.choice([0.0, rng.uniform(0, 5)]),
        mu_s=mu_s,
        mu_d=mu_d,
        k_z=10 ** rng.uniform(-3, 0),
        mu_t=10 ** rng.uniform(-4, -2),
        resolution=rng.choice([0.0, 1e-5]),
        origin=rng.normal(0, 0.1, 3),
        normal=matrix(orientation)[:, 2],
    )
    scene = paper_scene(
        fingertip={"radius_m": q.radius},
        rolling={"torque_stiffness_n_per_m": q.k_tau},
        coupling={"stiffness_n_per_m": q.k_t, "damping_ns_per_m": q.b_t},
        probe={"position_resolution_m": q.resolution},
        table={"position_m": list(q.origin), "orientation_wxyz": list(orientation)},
        material={
            "stiffness_n_per_m": q.k_n,
            "damping_ns_per_m": q.damping,
            "friction": {"static": q.mu_s, "kinetic": q.mu_d},
            "torsion": {"stiffness_nm_per_rad": q.k_z, "friction_length_m": q.mu_t},
        },
    )
    return scene, q


def random_motion(rng: np.random.Generator, q: Parameters) -> Hand:
    """About 600 ticks of pressing, dragging, rolling (followed, in place, against a drag), spinning and rest."""
    depth = 1e-3
    # Length over which a contact at this depth sticks: motions around it cause every transition.
    stick = q.mu_s * q.k_n * depth / q.k_t
    hand = Hand(q.origin + (q.radius + depth) * q.normal)
    hand.go_to(1, q.origin + (q.radius - depth) * q.normal)
    while hand.at < 600:
        tangent = np.cross(rng.normal(size=3), q.normal)
        lift = rng.choice([0.0, 0.0, rng.uniform(-1.5, 1.0) * depth])
        height = q.normal @ (hand.x - q.origin) - q.radius + lift
        lift -= min(max(height - depth, 0.0), lift) if lift > 0 else min(height + 3 * depth, 0.0)
        move, turn = lift * q.normal, np.zeros(3)
        kind = rng.integers(0, 6)
        if kind == 0:
            move = move + stick * rng.uniform(0, 4) * tangent
        elif kind in (1, 2, 3):
            turn = stick / q.radius * rng.uniform(0, 3) * tangent
            follow = (1.0, 0.0, -rng.uniform(0, 1))[kind - 1]
            move = move + follow * q.radius * np.cross(turn, q.normal)
            turn = turn + rng.choice([0.0, 1.0]) * rng.normal(0, 0.3) * q.normal
        elif kind == 4:
            move, turn = move + stick * rng.normal(0, 1) * tangent, rng.normal(0, 0.3, 3)
        # Otherwise it rests, or only changes its depth.
        hand.go(int(rng.integers(1, 90)), move, turn)
        if rng.random() < 0.25:
            hand.go(60)
    return hand.go_to(3, q.origin + (q.radius + depth) * q.normal)


SEEDS = range(12)
FEW = 6
"""Number of seeds in `make test`."""


@pytest.mark.parametrize("seed", [s if s < FEW else pytest.param(s, marks=pytest.mark.exhaustive) for s in SEEDS])
def test_engine_equals_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene, q = random_case(rng)
    engine, reference = Engine(scene), ReferenceContact(q)
    # Positions are rounded by some 1e-16 m, which accumulates over 600 ticks and is multiplied by the stiffness, or by
    # the damping over the time step.
    length = 1e-12
    force = max(q.k_n, q.k_t, (q.damping + q.b_t) / DT) * length
    for tick, pose in enumerate(random_motion(rng, q).poses):
        got, expected = engine.step(pose[:3], pose[3:], DT), reference.tick(pose[:3], pose[3:], DT)
        where = f"tick {tick}"
        assert (got.mode, got.cause) == (expected.mode, expected.cause), where
        assert got.proxy_position == pytest.approx(expected.center, abs=length), where
        assert got.force == pytest.approx(expected.force, abs=force), where
        assert got.torque == pytest.approx(expected.torque, abs=q.radius * force + q.k_z * 1e-11 + 1e-12), where
        assert got.rolled == pytest.approx(expected.rolled, abs=1e-10), where
        assert got.spin == pytest.approx(expected.spin, abs=1e-10), where


@pytest.mark.scaled
def test_random_motion_meets_every_transition(cases: Cases) -> None:
    counts: dict[str, int] = {}
    for seed in SEEDS[: cases(FEW, len(SEEDS))]:
        rng = np.random.default_rng(seed)
        scene, q = random_case(rng)
        records = Engine(scene).run(np.array(random_motion(rng, q).poses), DT)
        for cause in records["contact.cause"]:
            counts[CAUSE_NAMES[int(cause)]] = counts.get(CAUSE_NAMES[int(cause)], 0) + 1
    of_one_object = set(CAUSE_NAMES) - {"restart"}  # restarts occur only on meshes
    assert all(counts.get(cause, 0) >= 5 for cause in of_one_object), counts


def test_large_rotations_in_one_tick() -> None:
    friction = {"friction": {"static": 1000.0, "kinetic": 1000.0}}
    torsion = {"torsion": {"stiffness_nm_per_rad": 1e-3, "friction_length_m": 0.01}}
    engine = plane_engine(material=friction | torsion)
    rng, normal = np.random.default_rng(2), np.array([0.0, 0.0, 1.0])
    for _ in range(200):
        axis = rng.normal(size=3)
        w = rng.choice([rng.uniform(0, np.pi), np.pi - 1e-6, 1e-9]) * axis / np.linalg.norm(axis)
        engine.reset()
        engine.step([0, 0, 0.009], [1, 0, 0, 0])
        step = engine.step([0, 0, 0.009], quaternion(w))
        roll, _, spin = zxz_roll(rodrigues(w), normal)
        # Near half a turn the angles amplify rounding by 1e2, of lengths of pi times 1e-2 m.
        assert step.point == pytest.approx(0.01 * np.cross(roll, normal), abs=1e-12)
        assert step.spin == pytest.approx(spin, abs=1e-10)
