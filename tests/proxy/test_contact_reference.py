"""Engine compared with a slow NumPy reference of one tick, on random scenes and random motion."""

import numpy as np
import pytest
from conftest import paper_scene
from helpers.examples import Cases
from references.contact_reference import Parameters, ReferenceContact
from references.hand import Hand, plane_engine
from references.rolling_reference import zxz_roll
from references.rotation import matrix, quaternion, rodrigues

from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import CAUSE_NAMES

pytestmark = pytest.mark.plain

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
