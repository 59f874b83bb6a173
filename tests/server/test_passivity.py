"""Passivity observer against independent work, also of an elastic object, and controller against the energy it owes."""

from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, describe, load_rig, load_scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.kernels.jit.pack import packed
from softfinger.proxy.kernels.model import Pose
from softfinger.proxy.kernels.numerics.tool import make_tool, tip_of
from softfinger.proxy.record import FREE, NAMED, RECORD_SIZE, ROLLING
from softfinger.server.loop import passivity
from softfinger.server.loop.guard import GuardState
from softfinger.server.loop.passivity import NO_ENERGY, Energy, HandMotion, Passivity, keep_passive
from softfinger.server.loop.tick import Tuning, begin
from softfinger.server.loop.tuning import DAMPING_MAX_NS_PER_M, make_tuning
from softfinger.server.offline.simulate import run_ticks, simulate

pytestmark = pytest.mark.plain

T = 0.001
SLOW_HZ = 250.0
"""Rate for a whole recording: the energy is a sum over ticks of any length."""
PUSH = (0.0, 0.0, 2.0)
NONE = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def move(*displacement):
    """Return a motion without rotation."""
    return HandMotion(Pose(NONE, LEVEL), Pose(displacement, LEVEL), None)


def hold(force=NONE, torque=NONE):
    return GuardState(force, torque, 1.0)


def column(records, name, size=1):
    at = NAMED[name].at
    return records[:, at : at + size] if size > 1 else records[:, at]


def compute_works(records, turns=1.0):
    """Return the work (n - 1,) J of the hand against the wrench of each tick; `turns` 0 omits the torque."""
    turned = Rotation.from_quat(column(records, "probe.orientation", 4), scalar_first=True)
    turn = (turned[1:] * turned[:-1].inv()).as_rotvec()
    steps = np.diff(column(records, "probe.position", 3), axis=0)
    force, torque = column(records, "force", 3)[:-1], column(records, "torque", 3)[:-1]
    return -np.sum(force * steps, axis=1) - np.sum(torque * turns * turn, axis=1)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("mode", ["observe", "control"])
def test_energy_is_the_work_against_the_commanded_wrench(mode):
    scene = msgspec.structs.replace(load_scene("paper-plane"), passivity=schema.Passivity(mode=mode))
    tuning = make_tuning(scene, load_rig("replay").guard)
    records = simulate(tuning, resample(load_poses("press-roll-spin-drag"), SLOW_HZ), SLOW_HZ)
    work, expected = 0.0, []
    works = compute_works(records)
    for n, touching in enumerate(column(records, "contact.mode") != FREE):
        if n:
            work += works[n - 1]
        if not touching:
            work = min(work, 0.0)
        expected.append(work)
    # Thousands of additions of terms around 1e-5 J.
    np.testing.assert_allclose(column(records, "passivity.energy"), expected, rtol=0, atol=1e-15)
    assert max(expected) > 1e-4  # the press takes f^2 / 2K = 0.5 mJ
    if mode == "observe":
        assert not column(records, "passivity.damping").any()


def test_a_scene_without_the_table_has_no_observer():
    assert make_tuning(load_scene("paper-plane"), load_rig("replay").guard).passivity is None
    assert keep_passive(None, NO_ENERGY, hold(PUSH), move(1.0, 1.0, 1.0), float(ROLLING), PUSH, T) == (NO_ENERGY, PUSH)


def test_a_deficit_is_dissipated_in_one_tick_at_the_same_speed():
    moved, owed = (0.0, 3e-5, 4e-5), 2e-7
    energy, force = keep_passive(Passivity(1e4), Energy(-owed, 0.0), hold(), move(*moved), float(ROLLING), NONE, T)
    assert energy.work == -owed
    # Three products and their sum.
    assert -np.dot(force, moved) == pytest.approx(owed, rel=1e-14)
    assert energy.damping == pytest.approx(owed * T / np.dot(moved, moved), rel=1e-14)


def test_damping_is_bounded_for_a_slow_hand():
    for step in (0.0, 1e-300, 1e-160, 1e-9):
        motion = move(step, 0.0, 0.0)
        energy, force = keep_passive(Passivity(20.0), Energy(-1.0, 0.0), hold(), motion, float(ROLLING), PUSH, T)
        assert energy.damping == 20.0
        assert force == (-20.0 / T * step, 0.0, 2.0)


def test_energy_of_a_sampled_torsional_spring():
    k, largest, n = 0.05, 0.3, 200
    axis = np.array([0.6, 0.0, 0.8])
    angles = largest / n * np.concatenate((np.arange(n + 1), np.arange(n)[::-1]))
    energy, works = NO_ENERGY, []
    for before, now in pairwise(angles):
        poses = [Pose(NONE, (np.cos(0.5 * a), *(np.sin(0.5 * a) * axis))) for a in (before, now)]
        spring = hold(torque=tuple(-k * before * axis))
        energy, _ = keep_passive(Passivity(0.0), energy, spring, HandMotion(*poses, None), float(ROLLING), NONE, T)
        works.append(energy.work)
    # Four hundred additions of terms around 1e-5 J, with angles rounded by 1e-16 / 1e-3.
    assert works[n - 1] == pytest.approx(0.5 * k * largest**2 * (1.0 - 1.0 / n), rel=1e-11)
    assert works[-1] == pytest.approx(-k * largest**2 / n, rel=1e-9)


def test_work_of_a_rotating_tool_is_equal_at_both_ends():
    """If the handle turns on the spot, the force does no work although the tip moves, and the torque does all of it."""
    tool = make_tool((0.03, 0.0, -0.1), LEVEL)
    poses = [Pose((0.1, 0.2, 0.3), (np.cos(0.5 * a), 0.0, np.sin(0.5 * a), 0.0)) for a in (0.2, 0.5)]
    motion = HandMotion(*(tip_of(tool, pose) for pose in poses), tool)
    pulling = hold((3.0, 4.0, 5.0), (0.1, 0.2, 0.3))
    assert passivity.compute_work_on_hand(pulling, motion) == pytest.approx(0.2 * 0.3, rel=1e-13)  # rounding of 0.1 m
    assert passivity.compute_work_on_hand(pulling, HandMotion(motion.now, motion.now, tool)) == 0.0


def run_cycle(fingertip, height, n, turns=1.0, **tables):
    """Return records and energy (J) of a closed path of 1 mm and 0.18 rad with sticking friction, in 4 n steps."""
    material = {"stiffness_n_per_m": 1000.0, "friction": {"static": 5.0, "kinetic": 5.0}}
    table = {"fingertip": fingertip, "coupling": {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 0.0}} | tables
    table |= {
        "object": [{"name": "a", "shape": "plane", "material": material}], "passivity": {"mode": "observe"},
    }  # fmt: skip
    u, zero, ones = np.arange(1, n + 1) / n, np.zeros(n), np.ones(n)
    x = 0.001 * np.concatenate((np.zeros(50), u, ones, 1.0 - u, zero))
    tilt = 0.18 * np.concatenate((np.zeros(50), zero, u, ones, 1.0 - u))
    poses = np.column_stack((x, 0.0 * x, 0.0 * x + height, np.cos(0.5 * tilt), 0.0 * x, np.sin(0.5 * tilt), 0.0 * x))
    guard = schema.Guard(torque_max_nm=1.0, ramp_s=0.01)
    tuning = make_tuning(build(schema.Scene, table, "here"), guard)
    tuning = tuning._replace(guards=(tuning.guards[0]._replace(displays_torque=turns),))
    records = simulate(tuning, poses, 1000.0)
    energy = column(records, "passivity.energy")
    assert (column(records, "contact.mode") == ROLLING).all()
    np.testing.assert_allclose(np.diff(energy), compute_works(records, turns), rtol=0, atol=1e-15)
    return records, energy[-1] - energy[49]


def test_without_rolling_a_cycle_generates_the_work_of_the_torque():
    """The torque r K x turns without a spring: K r x theta = 1.8 mJ in a cycle, and K x^2 / n of sampling."""
    n = 100
    records, energy = run_cycle({"radius_m": 0.01}, 0.009, n)
    assert energy == pytest.approx(-(1000.0 * 0.01 * 0.001 * 0.18 + 1000.0 * 0.001**2 / n), rel=1e-9)
    force, steps = column(records, "force", 3)[49:-1], np.diff(column(records, "probe.position", 3)[49:], axis=0)
    assert -np.sum(force * steps) == pytest.approx(-1000.0 * 0.001**2 / n, rel=1e-9)


def test_a_torque_that_is_not_displayed_does_no_work():
    _, energy = run_cycle({"radius_m": 0.01}, 0.009, 100, turns=0.0)
    assert energy == pytest.approx(-1000.0 * 0.001**2 / 100, rel=1e-9)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("fingertip", [{"radius_m": 0.01}, {"radii_m": [0.008, 0.007, 0.012]}])
def test_with_rolling_a_cycle_generates_only_sampling_energy(fingertip):
    height = 0.009 if "radius_m" in fingertip else 0.011
    (_, coarse), (_, fine) = (run_cycle(fingertip, height, n, rolling={"method": "midpoint"}) for n in (100, 200))
    assert coarse / fine == pytest.approx(2.0, rel=0.01)  # first order in the step
    assert -1e-4 < coarse < 0.0


def test_release_forgets_what_was_taken_and_keeps_what_is_owed():
    motion = move(1e-5, 0.0, 0.0)
    for before, after in ((0.5, 0.0), (-0.5, -0.5)):
        energy, _ = keep_passive(Passivity(20.0), Energy(before, 0.0), hold(), motion, float(FREE), PUSH, T)
        assert energy.work == after and (energy.damping > 0.0) == (after < 0.0)


def test_a_tick_of_no_length_has_no_damping():
    owed = Energy(-1.0, 0.0)
    assert keep_passive(Passivity(20.0), owed, hold(), move(1e-5, 0.0, 0.0), float(ROLLING), PUSH, 0.0) == (owed, PUSH)


def test_largest_damping_is_only_for_control():
    guard = load_rig("replay").guard
    material = {"stiffness_n_per_m": 1000.0}
    table = {"fingertip": {"radius_m": 0.01}, "object": [{"name": "a", "shape": "plane", "material": material}]}
    with pytest.raises(ConfigError, match=r"passivity.damping_max_ns_per_m = 5.0: applies to mode"):
        build(schema.Scene, table | {"passivity": {"mode": "observe", "damping_max_ns_per_m": 5.0}}, "here")
    for mode, damping in (("control", DAMPING_MAX_NS_PER_M), ("observe", 0.0)):
        scene = build(schema.Scene, table | {"passivity": {"mode": mode}}, "here")
        assert make_tuning(scene, guard).passivity == Passivity(damping)


def test_the_guard_limits_the_force_of_the_controller():
    control = schema.Passivity(mode="control", damping_max_ns_per_m=1000.0)
    scene = msgspec.structs.replace(load_scene("paper-plane"), passivity=control)
    guard = schema.Guard(force_max_n=3.0, force_slew_n_per_s=1000.0, ramp_s=0.01)
    poses = np.zeros((400, 7))
    poses[:, 3] = 1.0
    # Fast release and press at up to 0.75 m/s return more energy than was stored.
    poses[:, 2] = 0.009 + 0.003 * np.sin(0.25 * np.arange(400))
    records = simulate(make_tuning(scene, guard), poses, 1000.0)
    damper = column(records, "passivity.damping") * np.gradient(poses[:, 2]) / T
    force = column(records, "force", 3)
    assert np.abs(damper).max() > 10.0  # N: far beyond both limits
    assert np.linalg.norm(force, axis=1).max() <= 3.0 * (1 + 1e-12)  # rounding of a norm
    assert np.linalg.norm(np.diff(force, axis=0), axis=1).max() <= 1.0 * (1 + 1e-9)


RATE_HZ = 1000.0
STIFFNESS = 1000.0
RADIUS = 0.01
INSIDE = (0.002, 0.0045)
"""x, y, m, in a facet of the pad, 2 mm from its edges."""


def tune_pad(mode: str = "observe", **elastic: float) -> Tuning:
    """Return the frictionless pad (its top is z = 0) with a guard that limits nothing after 10 ticks."""
    scene = describe(load_scene("press-a-pad"))
    pad = scene["object"][0]
    pad["elastic"] |= {"damping_s": 0.0} | elastic
    pad["material"] = {"stiffness_n_per_m": STIFFNESS}
    return tune_scene(pad, mode)


def tune_scene(surface: dict[str, Any], mode: str) -> Tuning:
    table = {"object": [surface], "fingertip": {"radius_m": RADIUS}, "passivity": {"mode": mode}}
    return make_tuning(build(schema.Scene, table, "here"), schema.Guard(ramp_s=0.01, force_slew_n_per_s=1e5))


def tune_plane(mode: str, stiffness: float) -> Tuning:
    table = {"shape": "plane", "name": "a", "material": {"stiffness_n_per_m": stiffness}}
    return tune_scene(table, mode)


def make_poses(x: Any, y: Any, depth: Any) -> Any:
    track = np.zeros((len(depth), 7))
    track[:, 0], track[:, 1], track[:, 2], track[:, 3] = x, y, RADIUS - depth, 1.0
    return track


def test_a_closed_path_generates_the_energy_of_sampling_alone() -> None:
    turn = np.concatenate([np.zeros(50), np.linspace(0.0, 2.0 * np.pi, 401)])
    track = make_poses(INSIDE[0] + 0.0005 * np.sin(turn), INSIDE[1], 0.001 + 0.0005 * (1.0 - np.cos(turn)))
    records = simulate(tune_pad(), track, RATE_HZ)[49:]
    force, energy = column(records, "force", 3), column(records, "passivity.energy")
    sampling = 0.5 * np.sum(np.diff(force, axis=0) * np.diff(track[49:, :3], axis=0))
    assert np.ptp(energy) > 5e-4 and sampling < -1e-7
    assert energy[-1] - energy[0] == pytest.approx(sampling, abs=1e-9)


def test_a_damped_press_dissipates_the_work_of_its_time_constant() -> None:
    """A cycle of amplitude a takes pi a^2 Im K, K = 1 / (1/k + C / (1 + i w T)), i w by the difference of two ticks."""
    time, ticks, amplitude = 0.02, 100, 0.0003
    turn = 2.0 * np.pi * np.arange(5 * ticks + 1) / ticks
    track = make_poses(*INSIDE, 0.001 + amplitude * np.sin(turn))
    still, moving = (simulate(tune_pad(damping_s=damping_s), track, RATE_HZ)[-ticks - 1 :] for damping_s in (0.0, time))
    force, depth = column(still, "force", 3)[:, 2], RADIUS - track[-ticks - 1 :, 2]
    compliance = amplitude / (0.5 * np.ptp(force)) - 1.0 / STIFFNESS
    rate = (1.0 - np.exp(-1j * turn[1])) * RATE_HZ
    stiffness = 1.0 / (1.0 / STIFFNESS + compliance / (1.0 + rate * time))
    dissipated = [
        column(records, "passivity.energy")[-1]
        - column(records, "passivity.energy")[0]
        - 0.5 * np.sum(np.diff(column(records, "force", 3)[:, 2]) * -np.diff(depth))  # of sampling
        for records in (still, moving)
    ]
    assert abs(dissipated[0]) < 1e-9
    assert dissipated[1] == pytest.approx(np.pi * amplitude**2 * stiffness.imag, rel=0.03)


def press_and_release(tunings: list[Tuning], depth: Any) -> Any:
    """Return the records (2, n) of a press under the first tuning and of the same path back under the second."""
    track = make_poses(*INSIDE, depth)[:, None]
    records, memory = np.zeros((2, len(track), 1, RECORD_SIZE)), packed(begin(tunings[0].scene))
    for stage, part, rows in zip(tunings, (track, track[::-1]), records, strict=True):
        dts = np.full(len(part), 1.0 / RATE_HZ)
        run_ticks(packed(stage), memory, np.ascontiguousarray(part), dts, 1.0 / RATE_HZ, 0, rows)
    return records[:, :, 0]


def test_energy_of_a_stiffness_that_rises_in_contact() -> None:
    n, depth = 500, 0.001
    depths = depth * np.concatenate([np.zeros(100), np.arange(1, n + 1) / n])
    _, back = press_and_release([tune_plane("observe", k) for k in (500.0, 1000.0)], depths)
    # Sampling adds K d^2 / 2n in each direction; the energy is that of one step before release.
    energy = column(back, "passivity.energy")[n - 1]
    assert energy == pytest.approx(-0.5 * 500.0 * depth**2 * (1.0 + 3.0 / n), rel=0.01)


def test_the_energy_of_a_modulus_that_rises_in_contact_is_dissipated_as_on_a_rigid_object() -> None:
    n, depth = 200, 0.002
    depths = depth * np.concatenate([np.full(50, -1.0 / n), np.arange(1, n + 1) / n])
    energies = []
    for mode in ("observe", "control"):
        soft, stiff = press_and_release([tune_pad(mode, youngs_pa=modulus) for modulus in (5e4, 1e5)], depths)
        rigid = [tune_plane(mode, column(rows, "contact.normal_force").max() / depth) for rows in (soft, stiff)]
        _, back = press_and_release(rigid, depths)
        energies.append([column(rows, "passivity.energy")[n - 1] for rows in (stiff, back)])
        assert energies[-1][0] == pytest.approx(energies[-1][1], rel=0.03)
    assert energies[0][0] < -2e-4 and energies[1][0] > 0.7 * energies[0][0]
