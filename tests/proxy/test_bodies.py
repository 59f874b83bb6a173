"""MuJoCo bodies pushed by our contacts, compared with closed forms and with MuJoCo."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from helpers.examples import Cases
from references.rotation import Array
from scipy.special import ellipk

from softfinger.config.errors import ConfigError, SafetyStop
from softfinger.config.load import load_scene
from softfinger.proxy.bodies import RigidBodies, compile_bodies
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.jit.pack import unpack
from softfinger.proxy.kernels.numerics.frames import into
from softfinger.proxy.kernels.query.bodies import NO_FAULT, SLOW, SLOW_STEPS, check_budget, step_bodies
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.world import advance, place_all
from softfinger.proxy.kernels.record_writer import unpack_poses
from softfinger.proxy.kernels.shapes import closest_or_bound
from softfinger.proxy.kernels.step import step
from softfinger.proxy.pose_checks import PoseError
from softfinger.proxy.record import FREE, SLIDING
from softfinger.proxy.scene import start_state

pytestmark = pytest.mark.plain

G, R, HALF, MASS, STIFFNESS = 9.81, 0.008, 0.02, 0.1, 500.0
TORSION = 0.05
"""N m/rad, of each finger."""

BOX = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 {gravity}"/>
  <worldbody>
    {floor}
    <body name="box" pos="0 0 {height}">
      <freejoint/>
      <geom name="box" type="box" size="0.02 0.02 0.02" mass="{mass}"/>
    </body>
  </worldbody>
</mujoco>
"""
FLOOR = '<geom name="floor" type="plane" size="1 1 0.1"/>'
RUBBER = {
    "stiffness_n_per_m": STIFFNESS,
    "damping_ns_per_m": 2.0,
    "friction": {"static": 0.8, "kinetic": 0.7},
    "torsion": {"stiffness_nm_per_rad": TORSION, "friction_length_m": 0.004},
}
DAMPED = {"stiffness_n_per_m": STIFFNESS, "damping_ns_per_m": 1.0, "torsional_damping_nms_per_rad": 1.5e-3}
PLAIN_ONLY = pytest.mark.skipif(not PLAIN, reason="calls kernels from Python, which compiled ones do not allow")


def box(folder: Path, mass: float = MASS, gravity: float = -G, floor: str = "", height: float = 0.0) -> str:
    path = folder / "box.xml"
    path.write_text(BOX.format(mass=mass, gravity=gravity, floor=floor, height=height), encoding="utf-8")
    return str(path)


def held_by_two(
    path: str, material: dict[str, Any] = RUBBER, coupling: dict[str, Any] = DAMPED, **world: Any
) -> Engine:
    fingers = [{"name": name, "radius_m": R} for name in ("thumb", "index")]
    tables = {"finger": fingers, "coupling": coupling, "rolling": {"method": "midpoint"}}
    return Engine(tables | {"world": {"model": path, "material": material, **world}})


def pinch(ticks: int, force: float, offset: float = 0.0, height: float = 0.0, press: int = 100) -> dict[str, Array]:
    """Poses of two fingers that press the box along x, each with `force` N after `press` ticks, and then stop."""
    u = np.clip(np.arange(ticks) / press, 0.0, 1.0)
    depth = force / STIFFNESS * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    poses = {}
    for name, side in (("thumb", -1.0), ("index", 1.0)):
        poses[name] = np.zeros((ticks, 7))
        poses[name][:, 0] = side * (HALF + R - depth)
        poses[name][:, 1], poses[name][:, 2], poses[name][:, 3] = offset, height, 1.0
    return poses


def tilt(engine: Engine) -> float:
    w, x = engine.data.qpos[3:5]
    return 2.0 * math.atan2(x, w)


def test_a_box_is_lifted_and_hangs_by_the_torsion_of_two_fingers(tmp_path: Path) -> None:
    """Lifted 8 mm off its centre of mass it turns by theta = m g d cos(theta) / (2 k_z), at most 5 degrees."""
    engine, rise = held_by_two(box(tmp_path, floor=FLOOR, height=HALF)), 1200
    hand_path = pinch(200 + rise + 400, 3.0, offset=0.008, height=HALF)
    u = np.clip((np.arange(len(hand_path["thumb"])) - 200) / rise, 0.0, 1.0)
    for poses in hand_path.values():
        poses[:, 2] += 0.1 * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    most = 0.0
    for first in range(0, len(u), 20):
        engine.run({name: poses[first : first + 20] for name, poses in hand_path.items()})
        most = max(most, abs(tilt(engine)))
    arm = MASS * G * 0.008 / (2.0 * TORSION)
    theta = arm * math.cos(arm)  # the cosine of theta itself changes it by 1e-5
    assert tilt(engine) == pytest.approx(theta, rel=0.01)
    assert math.degrees(most) < 5.0
    sag = MASS * G / (2.0 * STIFFNESS)  # two springs carry it
    soft = 0.2e-3  # MuJoCo's floor is soft: the box was grasped that much lower
    assert engine.data.qpos[2] == pytest.approx(0.12 - sag - 0.008 * math.sin(theta), abs=soft)


def test_without_torsion_it_swings_as_a_pendulum(tmp_path: Path) -> None:
    """Released at 90 degrees, 8 mm off its centre, it has the period of a pendulum: an elliptic integral."""
    material = {name: part for name, part in RUBBER.items() if name != "torsion"}
    engine, arm = held_by_two(box(tmp_path, gravity=0.0), material), 0.008
    hand_path = pinch(2000, 3.0, offset=arm)
    engine.run({name: poses[:200] for name, poses in hand_path.items()})
    engine.model.opt.gravity[2] = -G
    turning = []
    for tick in range(200, 1100, 2):
        engine.run({name: poses[tick : tick + 2] for name, poses in hand_path.items()})
        turning.append(engine.data.qvel[3])
    turns = np.flatnonzero(np.sign(turning[1:]) * np.sign(turning[:-1]) < 0)
    inertia = MASS * ((2 * HALF) ** 2 / 6.0 + arm**2)
    period = 4.0 * math.sqrt(inertia / (MASS * G * arm)) * ellipk(0.5)
    assert 2.0 * turns[0] * 2e-3 == pytest.approx(period, rel=0.02)
    assert abs(tilt(engine)) > 0.5 or len(turns) > 1  # it continues to swing


@pytest.mark.parametrize(
    "model_of_torsion", [pytest.param("independent", marks=pytest.mark.exhaustive), "limit_surface"]
)
def test_it_slips_at_the_limit_of_friction(model_of_torsion: str, tmp_path: Path) -> None:
    """Twisted under 60 % of the cone, it slips at the torsional limit or the limit surface's remainder. To 1 %."""
    press, static, length = 2.0, 0.8, 0.004
    step = 2  # ticks: at the rates below a step is at most 0.4 % of the limit
    material = RUBBER | {
        "friction": {"static": static, "kinetic": static},
        "torsion": {"stiffness_nm_per_rad": TORSION, "friction_length_m": length, "model": model_of_torsion},
    }

    def slips_at(pulled: float, pull_rate: float, twist_rate: float) -> tuple[float, float]:
        """Force on each finger (N) along z and torque (N m) about x when the first contact slips or spins."""
        slow = DAMPED | {"torsional_damping_nms_per_rad": 1e-4}  # at 0.2 rad/s it bears 2e-5 N m
        engine = held_by_two(box(tmp_path, gravity=0.0), material, slow)
        hand_path = pinch(200, press)
        engine.run(hand_path)
        hold = {name: np.repeat(poses[-1:], step, axis=0) for name, poses in hand_path.items()}
        pull = twist = 0.0
        for tick in range(0, 3000, step):
            pull = pulled * min(tick / 200.0, 1.0) + pull_rate * tick * 1e-3
            twist = twist_rate * max(tick - 300, 0) * 1e-3
            engine.data.qfrc_applied[2], engine.data.qfrc_applied[3] = 2.0 * pull, 2.0 * twist
            thumb = engine.run(hold)["thumb"]
            spun = abs(thumb["contact.torsion"][-1]) > 0.999 * length * press
            if thumb["contact.mode"][-1] == SLIDING or spun:
                break
        return pull, twist

    cone = static * press
    assert slips_at(0.0, 3.0, 0.0)[0] == pytest.approx(cone, rel=0.01)
    share = math.sqrt(1.0 - 0.6**2) if model_of_torsion == "limit_surface" else 1.0
    assert slips_at(0.6 * cone, 0.0, 0.01)[1] == pytest.approx(share * length * press, rel=0.01)


def test_body_gets_the_opposite_wrench_of_the_fingers(tmp_path: Path) -> None:
    engine = held_by_two(box(tmp_path, floor=FLOOR, height=HALF))
    hand_path = pinch(160, 3.0, offset=0.006, height=HALF - 0.003)
    pressed = 0
    for tick in range(160):
        center = engine.data.xipos[1].copy()
        rows = engine.run({name: poses[tick : tick + 1] for name, poses in hand_path.items()})
        force, torque = np.zeros(3), np.zeros(3)
        for name, records in rows.items():
            force -= records["force"][0]
            torque -= records["torque"][0] + np.cross(hand_path[name][tick, :3] - center, records["force"][0])
        pressed += bool(force.any() or torque.any())
        np.testing.assert_allclose(engine.data.xfrc_applied[1], [*force, *torque], rtol=0, atol=1e-12)
    assert pressed > 20


REST = pytest.mark.exhaustive
BODIES = [
    (0.01, 1),
    *(pytest.param(*case, marks=REST) for case in ((0.001, 4), (0.03, 1), (0.1, 1), (0.3, 1), (1.0, 1))),
]
"""Masses, kg, and substeps."""


@pytest.mark.parametrize(("mass", "substeps"), BODIES)
@pytest.mark.parametrize("stiffness", [*(pytest.param(stiffness, marks=REST) for stiffness in (200.0, 1000.0)), 3000.0])
def test_a_held_body_comes_to_rest(mass: float, substeps: int, stiffness: float, tmp_path: Path) -> None:
    path = box(tmp_path, mass, gravity=0.0)
    Path(path).write_text(Path(path).read_text().replace('"0.001" integ', f'"{0.001 / substeps}" integ'))
    coupling = DAMPED | {"stiffness_n_per_m": stiffness}
    if mass < 0.1:
        coupling["torsional_damping_nms_per_rad"] = 1e-4
    engine = held_by_two(path, RUBBER | {"stiffness_n_per_m": stiffness}, coupling, substeps=substeps)
    hand_path = pinch(200, 3.0 * STIFFNESS / stiffness, offset=0.004)
    engine.run({name: poses[:150] for name, poses in hand_path.items()})
    engine.data.qvel[:] = [0.01, 0.02, -0.03, 0.5, -0.3, 0.4]
    hold = {name: np.repeat(poses[-1:], 50, axis=0) for name, poses in hand_path.items()}
    fastest = []
    windows = 16 if mass < 0.1 else 40
    for _ in range(windows):
        engine.run(hold)
        fastest.append(np.abs(engine.data.qvel).max())
    assert max(fastest[-windows // 4 :]) < 0.8 * max(fastest[: windows // 4]) < 0.8


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("mass", "stiffness"),
    [(1.0, 3000.0), *(pytest.param(*case, marks=REST) for case in ((1.0, 1000.0), (0.3, 3000.0)))],
)
def test_dampers_that_fit_a_heavy_body_stop_it(mass: float, stiffness: float, tmp_path: Path) -> None:
    """With c = 0.2 sqrt(K m), and sqrt(k_z I) for torsion, a blow decays a thousandfold within two seconds."""
    damping, inertia = 0.2 * math.sqrt(stiffness * mass), mass * (2.0 * HALF) ** 2 / 6.0
    coupling = {"stiffness_n_per_m": stiffness, "damping_ns_per_m": damping}
    coupling["torsional_damping_nms_per_rad"] = math.sqrt(TORSION * inertia)
    material = RUBBER | {"stiffness_n_per_m": stiffness, "damping_ns_per_m": damping}
    engine = held_by_two(box(tmp_path, mass, gravity=0.0), material, coupling)
    hand_path = pinch(200, 3.0 * STIFFNESS / stiffness, offset=0.004)
    engine.run({name: poses[:150] for name, poses in hand_path.items()})
    blow = np.array([0.01, 0.02, -0.03, 0.5, -0.3, 0.4])
    engine.data.qvel[:] = blow
    engine.run({name: np.repeat(poses[-1:], 2000, axis=0) for name, poses in hand_path.items()})
    assert np.abs(engine.data.qvel).max() < 1e-3 * np.abs(blow).max()


def test_the_same_poses_give_the_same_bits(tmp_path: Path) -> None:
    hand_path = pinch(150, 3.0, offset=0.008, height=HALF)
    engine, second_engine = (held_by_two(box(tmp_path, floor=FLOOR, height=HALF)) for _ in range(2))
    first = engine.run(hand_path)["thumb"].copy()
    place = engine.data.qpos.copy()
    engine.set("coupling.damping_ns_per_m", 1.5)
    np.testing.assert_array_equal(engine.data.qpos, place)
    engine.set("coupling.damping_ns_per_m", 1.0)
    with pytest.raises(ConfigError, match="cannot change while"):
        engine.set("world.substeps", 2)
    with pytest.raises(PoseError, match="the bodies of"):
        engine.run(hand_path, 0.002)
    engine.reset()
    for running in (engine, second_engine):
        np.testing.assert_array_equal(running.run(hand_path)["thumb"], first)
        np.testing.assert_array_equal(running.data.qpos, place)


SHAPES = """
<mujoco>
  <option timestep="0.001" gravity="0 0 0"/>
  <asset><mesh name="wedge" vertex="0 0 0 0.04 0 0 0 0.03 0 0 0 0.02 0.02 0.03 0"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.2" euler="5 3 0"/>
    <geom name="fixed mesh" type="mesh" mesh="wedge" pos="0.3 0 0" euler="40 0 10"/>
    <body name="carrier" pos="0.01 0.02 0.03" euler="20 -30 40">
      <freejoint/>
      <geom name="sphere" type="sphere" size="0.02" pos="0.1 0 0"/>
      <geom name="capsule" type="capsule" size="0.01 0.03" pos="0 0.1 0" euler="40 0 0"/>
      <geom name="ellipsoid" type="ellipsoid" size="0.02 0.03 0.015" pos="-0.1 0 0" euler="0 50 0"/>
      <geom name="cylinder" type="cylinder" size="0.015 0.02" pos="0 -0.1 0" euler="10 20 30"/>
      <geom name="box" type="box" size="0.01 0.02 0.03" pos="0 0 0.1" euler="30 0 10"/>
      <geom name="mesh" type="mesh" mesh="wedge" pos="0 0 -0.1" euler="40 0 10"/>
    </body>
    <body name="point" mocap="true"><geom name="point" type="sphere" size="0.001" contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>
"""


@PLAIN_ONLY
def test_geoms_have_the_distances_of_mujoco(tmp_path: Path) -> None:
    path = tmp_path / "shapes.xml"
    path.write_text(SHAPES)
    engine = Engine({"fingertip": {"radius_m": R}, "world": {"model": str(path), "material": RUBBER}})
    engine.data.qvel[:] = [0.3, -0.2, 0.1, 2.0, 3.0, -1.0]
    engine.run([[0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]] * 50)
    world = advance(engine.scene.objects, start_state(engine.scene).world, 1e-3)
    objects = place_all(engine.scene.objects, world)
    random = np.random.default_rng(1)
    for row, entry in enumerate(engine.config.object):
        placed, geom = find_object(objects, float(row)), engine.model.geom(entry.name).id
        for _ in range(20):
            x = engine.data.geom_xpos[geom] + random.uniform(-0.1, 0.1, 3)
            engine.data.mocap_pos[0] = x
            mujoco.mj_kinematics(engine.model, engine.data)
            theirs = mujoco.mj_geomDistance(engine.model, engine.data, geom, engine.model.geom("point").id, 1.0, None)
            ours = closest_or_bound(placed.shape, into(placed.pose, tuple(x)))[0]
            # MuJoCo searches ellipsoids and cylinders to a tolerance of 1e-6 m; inside it measures another distance
            if theirs > 0.0:
                assert ours - 0.001 == pytest.approx(theirs, abs=2e-6), entry.name


ON_BOX = {"kind": "body", "body": "box"}


def test_an_object_replaces_a_geom_and_moves_with_a_body(tmp_path: Path) -> None:
    ring = {"name": "ring", "shape": "torus", "major_radius_m": 0.03, "minor_radius_m": 0.005, "material": RUBBER}
    world = {"model": box(tmp_path, gravity=0.0), "material": RUBBER}
    engine = Engine({"fingertip": {"radius_m": 0.005}, "world": world, "object": [ring | {"motion": ON_BOX}]})
    assert [entry.name for entry in engine.config.object] == ["ring", "box"]
    engine.run([[0.03, 0.0, 0.02 - 1e-4 * k, 1.0, 0.0, 0.0, 0.0] for k in range(120)])
    assert engine.data.qvel[2] < 0.0 and engine.data.qvel[4] > 0.0  # pushed down, and turned by the lever arm


@PLAIN_ONLY
def test_a_diverging_world_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo's warnings of an infinite velocity are counted from the next step on, and no log file is written."""
    monkeypatch.chdir(tmp_path)
    bodies = RigidBodies(load_scene("lift-a-box").world)
    bodies.begin(0.001)
    bodies.data.qvel[0] = math.inf
    assert step_bodies(bodies.kernel((0.0, 1.0))) > 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("substeps", [1, 2])
def test_an_engine_reports_failed_bodies(substeps: int, tmp_path: Path) -> None:
    path = box(tmp_path, floor=FLOOR, height=HALF)
    Path(path).write_text(Path(path).read_text().replace('"0.001" integ', f'"{0.001 / substeps}" integ'))
    engine = held_by_two(path, substeps=substeps)
    hand_path = pinch(5, 1.0, height=HALF, press=5)
    good = engine.run(hand_path)["thumb"].copy()
    solver = engine.model.opt.solver
    for fail in ("a number", "an error", "a number"):
        if fail == "a number":
            engine.data.qvel[0] = math.inf
        else:
            engine.model.opt.solver = 77
        for _ in range(2):
            with pytest.raises(SafetyStop, match=r"huge value in Q|solver") as failed:
                engine.run(hand_path)
        assert "released and no longer move" in str(failed.value) and "damping_ns_per_m" in str(failed.value)
        engine.model.opt.solver = solver
        engine.reset()
        np.testing.assert_array_equal(engine.run(hand_path)["thumb"], good)


def test_full_memory_is_an_error(tmp_path: Path) -> None:
    """MuJoCo only warns and drops all contacts if its memory is full, so boxes would fall through each other."""
    path = tmp_path / "many.xml"
    boxes = "".join(
        f'<body pos="0 0 {0.3 + 0.05 * k}"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>'
        for k in range(20)
    )
    path.write_text(
        f'<mujoco><size memory="60K"/><option timestep="0.001"/><worldbody>'
        f'<geom name="floor" type="plane" size="1 1 1"/>{boxes}</worldbody></mujoco>'
    )
    floor = {"name": "floor", "material": RUBBER}
    engine = Engine({"fingertip": {"radius_m": R}, "world": {"model": str(path), "geom": [floor]}})
    with pytest.raises(SafetyStop, match=r'Insufficient arena memory .*<size memory="\.\.\."/>'):
        engine.run([[0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]] * 600)


@PLAIN_ONLY
def test_bodies_that_failed_are_not_touched(tmp_path: Path) -> None:
    engine = held_by_two(box(tmp_path, gravity=0.0))
    hand_path = pinch(120, 3.0)
    assert np.abs(engine.run(hand_path)["thumb"]["force"][-1]).max() > 1.0
    engine.data.qvel[3] = math.nan
    state = unpack(start_state(engine.scene), engine._state)
    assert step_bodies(engine.scene.bodies) != NO_FAULT
    poses = unpack_poses([poses[-1] for poses in hand_path.values()])
    for _ in range(2):
        state, contacts = step(engine.scene, state, poses, 1e-3)
        assert step_bodies(engine.scene.bodies) != NO_FAULT
        assert all(contact.force == contact.torque == (0.0, 0.0, 0.0) and contact.mode == FREE for contact in contacts)


@PLAIN_ONLY
def test_most_steps_must_be_within_the_budget(tmp_path: Path) -> None:
    world = {"model": box(tmp_path), "budget_us": 50.0, "material": RUBBER}
    owner = compile_bodies(load_scene({"fingertip": {"radius_m": R}, "world": world}))
    owner.begin(0.001)
    bodies = owner.kernel((0.0, 1.0))
    for took_us in [49.0, 51.0, 2000.0, 50.0] * 50:
        check_budget(bodies, round(1e3 * took_us))
    assert owner.failure is None
    for took_us in [51.0, 51.0, 50.0] * SLOW_STEPS:
        check_budget(bodies, round(1e3 * took_us))
    assert "budget_us = 50" in str(owner.failure) and step_bodies(bodies) == SLOW
    owner.begin(0.001)
    assert owner.failure is None and step_bodies(bodies) == NO_FAULT


HEAVY, SOFT = 1.0, 200.0
"""kg and N/m: with 3 N the tips are 15 mm deep in a box of 40 mm."""


def test_a_heavy_body_rolls_on_soft_fingertips_and_comes_to_rest_slowly(tmp_path: Path) -> None:
    """A rotation b across the line of the contacts shears each by (h - d) b, with half width h and depth d.

    The forces N = K d have normals that turn with the body and probes at h + r - d from its middle; they turn it back:
        I b'' + 2 c (h - d)^2 b' + (2 N (h + r - d) + 2 K (h - d)^2) b = 0

    The damping is therefore small if d is close to h, for any c. The shears of the two tips are opposite, so the middle
    does not move.
    """
    inertia, damping = HEAVY * (2.0 * HALF) ** 2 / 6.0, 0.2 * math.sqrt(SOFT * HEAVY)
    coupling = {"stiffness_n_per_m": SOFT, "damping_ns_per_m": damping}
    coupling["torsional_damping_nms_per_rad"] = math.sqrt(TORSION * inertia)
    material = RUBBER | {"stiffness_n_per_m": SOFT, "damping_ns_per_m": damping}
    engine, force = held_by_two(box(tmp_path, HEAVY, gravity=0.0), material, coupling), 3.0
    path = pinch(100, 500.0 / SOFT * force)
    engine.run(path)
    engine.data.qvel[:] = [0.0, 0.0, 0.0, 0.0, 0.2, 0.0]
    hold = {name: np.repeat(poses[-1:], 2, axis=0) for name, poses in path.items()}
    rate = np.zeros(350)
    for tick in range(len(rate)):
        engine.run(hold)
        rate[tick] = engine.data.qvel[4]
    depth = force / SOFT
    lever = HALF - depth
    stiff = 2.0 * force * (HALF + R - depth) + 2.0 * SOFT * lever**2
    decay = damping * lever**2 / inertia
    angular = math.sqrt(stiff / inertia - decay**2)
    turns = np.flatnonzero(np.diff(np.sign(rate)))
    crossings = turns + rate[turns] / (rate[turns] - rate[turns + 1])
    halves = [np.abs(rate[a:b]).max() for a, b in pairwise(turns)]
    # Error of second order in a tick of 0.018 rad; a swing of 0.01 rad is a sine to 1e-4.
    assert math.pi / np.diff(crossings).mean() == pytest.approx(2e-3 * angular, rel=2e-3)
    assert math.log(halves[0] / halves[-1]) == pytest.approx(decay * math.pi / angular * (len(halves) - 1), rel=0.01)


@pytest.mark.scaled
def test_a_held_and_rolled_body_does_not_creep(tmp_path: Path, cases: Cases) -> None:
    """Grasped 8 mm off its middle, after a roll of 0.03 rad. Dampers reduce the swing tenfold every 0.25 s; the
    remainder is rounding of 0.1 m, 1e-17 m a tick. An encoder's step is 1e-6 m."""
    engine = held_by_two(box(tmp_path))
    path = pinch(100, 3.0, offset=0.008)
    engine.run(path)
    angle = 0.5 * 0.03
    hold = {name: np.repeat(poses[-1:], 500, axis=0) for name, poses in path.items()}
    for poses in hold.values():
        poses[:, 3:] = [math.cos(angle), 0.0, math.sin(angle), 0.0]
    for _ in range(cases(4, 6)):
        engine.run(hold)
    before = engine.data.qpos.copy()
    half_seconds = cases(1, 20)
    for _ in range(half_seconds):
        records = engine.run(hold)
    swing = 1e-8 if half_seconds == 1 else 1e-11  # m, after 2 s and after 3 s
    assert np.abs(engine.data.qpos - before).max() < swing
    assert records["thumb"]["contact.tangential_force"][-1] > 0.4 * MASS * G  # the body hangs by friction
