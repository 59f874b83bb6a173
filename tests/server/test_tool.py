"""Tool on the handle: pose of the tip, wrench at the handle, and limits of the guard at the handle."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.examples import examples
from helpers.faulty_device import FaultyDevice, Options
from hypothesis import given
from hypothesis import strategies as st
from references.rotation import matrix, quaternion
from scipy.spatial.transform import Rotation
from test_servo import finish

from softfinger.config import schema
from softfinger.config.load import build, describe, load_rig, load_scene
from softfinger.drivers.base import HELD
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.kernels.model import Pose
from softfinger.proxy.kernels.numerics.tool import about_handle, about_tip, make_tool, tip_of
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.guard import TORQUE_CLAMPED, Guard
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tick import Tuning, make_start_memory, run_tick
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import simulate, simulate_devices
from softfinger.server.offline.summary import summarize_rig

DT = 1e-3
SLOW_HZ = 100.0
"""Rate for recordings whose intermediate ticks show nothing else."""
FREE_HAND = Guard(40.0, 2.0, 1e6, 1e6, 0.0, 1.0)
"""Limits of force, torque and their rates that are never reached, and no ramp."""
EPS = float(np.finfo(float).eps)

numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers)
turns = st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: float(np.linalg.norm(q)) > 0.1)


def ticks(tuning: Tuning, handles: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return wrenches (n, 6) for the device, and records, of handle poses (n, 7)."""
    start = memory = make_start_memory(tuning.scene)
    wrenches, records = [], np.zeros((len(handles), RECORD_SIZE))
    for number, (handle, record) in enumerate(zip(np.asarray(handles, float), records, strict=True)):
        memory = run_tick(tuning, start, memory, (handle,), DT, DT, number, (record,))
        guarded = memory.fingers[0].guard_state
        wrenches.append([*guarded.force, *guarded.torque])
    return np.array(wrenches), records


def tune_scene(scene: str, tool: schema.Tool | None, guard: Guard = FREE_HAND) -> Tuning:
    return make_tuning(load_scene(scene), schema.Guard(), tools=[tool])._replace(guards=(guard,))


@pytest.mark.plain
def test_press_at_the_end_of_a_stylus_turns_the_handle_by_its_arm() -> None:
    tuning = tune_scene("frictionless-plane", schema.Tool(offset_m=(0.1, 0.0, 0.0)))
    half = np.sqrt(0.5)
    down = quaternion(np.array([0.0, np.pi / 4.0, 0.0]))
    handles = [[0.0, 0.0, 0.009, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.009 + 0.1 * half, *down]]
    wrenches, records = ticks(tuning, handles)
    expected = [[0.0, 0.0, 1.0, 0.0, -0.1, 0.0], [0.0, 0.0, 1.0, 0.0, -0.1 * half, 0.0]]
    # 1000 N/m times the rounding of coordinates of 0.1 m.
    np.testing.assert_allclose(wrenches, expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(records[:, AT.probe_position], [0.1, 0.1 * half], rtol=0.0, atol=1e-16)
    np.testing.assert_allclose(records[:, AT.torque : AT.torque + 3], 0.0, atol=1e-12)  # about the fingertip


@pytest.mark.plain
@examples(100, 300)
@given(offset=vectors, turn=turns, position=vectors, handle=turns, force=vectors, torque=vectors, v=vectors, w=vectors)
def test_power_is_equal_at_tip_and_handle(offset, turn, position, handle, force, torque, v, w):
    """F . v_tip + tau_tip . w = F . v_handle + tau_handle . w for every pose, twist and wrench, in both directions."""
    tool, unit = make_tool(offset, turn), tuple(np.array(handle) / np.linalg.norm(handle))
    tip = tip_of(tool, Pose(position, unit))
    away = matrix(np.array(unit)) @ offset
    np.testing.assert_allclose(np.subtract(tip.position, position), away, rtol=0.0, atol=20.0 * EPS)
    turned = matrix(np.array(unit)) @ matrix(np.array(turn) / np.linalg.norm(turn))
    np.testing.assert_allclose(matrix(np.array(tip.orientation)), turned, rtol=0.0, atol=20.0 * EPS)
    carried = about_handle(tool, tip.orientation, force, torque)
    at_tip = np.dot(force, np.add(v, np.cross(w, away))) + np.dot(torque, w)
    # Some thirty products of numbers up to about 2.
    assert abs(np.dot(force, v) + np.dot(carried, w) - at_tip) < 100.0 * EPS
    np.testing.assert_allclose(about_tip(tool, tip.orientation, force, carried), torque, rtol=0.0, atol=40.0 * EPS)


@pytest.mark.plain
def test_limits_apply_at_the_device() -> None:
    largest, change = 0.05, 4.0
    guard = FREE_HAND._replace(torque_max=largest, torque_slew=change)
    offset = (0.1, 0.02, -0.05)
    tuning = tune_scene("paper-plane", schema.Tool(offset_m=offset), guard)
    handles = resample(load_poses("press-roll-spin-drag"), 1000.0)[:2500]
    handles[:, :3] -= np.array([matrix(q) @ offset for q in handles[:, 3:7]])
    wrenches, records = ticks(tuning, handles[:, :7])
    torques = wrenches[:, 3:]
    sizes = np.linalg.norm(torques, axis=1)
    assert sizes.max() <= largest * (1.0 + 4.0 * EPS) and (sizes > 0.999 * largest).any()
    assert (records[:, AT.servo_guard].astype(int) & TORQUE_CLAMPED).any()
    steps = np.linalg.norm(np.diff(torques, axis=0), axis=1)
    assert steps.max() <= change * DT * (1.0 + 1e-12)
    away = np.array([matrix(q) @ offset for q in handles[:, 3:7]])
    about = torques - np.cross(away, wrenches[:, :3])
    np.testing.assert_allclose(records[:, AT.torque : AT.torque + 3], about, rtol=0.0, atol=100.0 * EPS)


@pytest.mark.plain
def test_a_tool_of_no_length_changes_no_bit() -> None:
    poses = np.ascontiguousarray(resample(load_poses("press-roll-spin-drag"), SLOW_HZ)[:, :7])
    without, having = (simulate(tune_scene("paper-plane", tool), poses, SLOW_HZ) for tool in (None, schema.Tool()))
    np.testing.assert_array_equal(having, without)


@pytest.mark.plain
def test_the_contact_is_that_of_the_tip() -> None:
    tips = np.ascontiguousarray(resample(load_poses("press-roll-spin-drag"), SLOW_HZ)[:, :7])
    turn = np.array([0.8, 0.0, 0.6, 0.0])
    tool = schema.Tool(offset_m=(0.0, -0.03, 0.15), orientation_wxyz=(0.8, 0.0, 0.6, 0.0))
    rotations = [matrix(q) @ matrix(turn).T for q in tips[:, 3:]]
    back = np.array([1.0, -1.0, -1.0, -1.0]) * turn
    handles = tips.copy()
    handles[:, :3] -= np.array([rotation @ tool.offset_m for rotation in rotations])
    turned = Rotation.from_quat(tips[:, 3:], scalar_first=True) * Rotation.from_quat(back, scalar_first=True)
    handles[:, 3:] = turned.as_quat(scalar_first=True)
    expected = simulate(tune_scene("paper-plane", None), tips, SLOW_HZ)
    records = simulate(tune_scene("paper-plane", tool), handles, SLOW_HZ)
    for name, size in (("probe_position", 3), ("force", 3), ("torque", 3), ("contact_mode", 1), ("contact_rolled", 1)):
        at = getattr(AT, name)
        # 1000 N/m times the rounding of 0.15 m, summed over hundreds of ticks of rolling.
        np.testing.assert_allclose(records[:, at : at + size], expected[:, at : at + size], rtol=0.0, atol=1e-9)
    assert np.ptp(expected[:, AT.force]) > 0.1 and np.ptp(expected[:, AT.torque]) > 1e-3


@pytest.mark.parametrize("fault", ["none", "held", "withheld_write"])
def test_the_servo_writes_the_wrench_at_the_handle(fault: Any) -> None:
    device = FaultyDevice(Options(fault=fault, at=300, count=20, own_clock=True))
    arm = (0.05, 0.0, 0.0)  # the device does not turn its handle
    servo = ServoThread([device], tune_scene("paper-plane", schema.Tool(offset_m=arm)), 1000.0, 600)
    servo.compile()
    _, records = finish(servo)
    wrenches = device.wrenches[:600]
    force = records[:, AT.force : AT.force + 3]
    np.testing.assert_array_equal(wrenches[:, :3], force)
    carried = records[:, AT.torque : AT.torque + 3] + np.cross(arm, force)
    np.testing.assert_allclose(wrenches[:, 3:], carried, rtol=0.0, atol=4.0 * EPS)
    assert np.abs(np.cross(arm, force)).max() > 0.02
    assert (records[:, AT.servo_device] == HELD).sum() == (20 if fault == "held" else 0)
    device.close()


@pytest.mark.plain
def test_a_rig_gives_its_device_a_tool(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(
        '[device]\ndriver = "simulated"\n\n[device.tool]\noffset_m = [0.0, 0.0, -0.1]\n'
        "orientation_wxyz = [0.0, 2.0, 0.0, 0.0]\n"
    )
    rig = load_rig(file)
    assert rig.device.options == {} and build(schema.Rig, describe(rig), "again") == rig
    text = "tip at [0.0, 0.0, -0.1] m of the handle, turned by [0.0, 1.0, 0.0, 0.0]"
    assert dict(summarize_rig(rig))["  tool"] == text
    replay_rig = load_rig(file, {"device.driver": "replay", "device.recording": "tap"})
    assert replay_rig.device.tool is None  # the tool belongs to the other device
    scene = load_scene("paper-plane")
    bare = load_rig(file, {"device.tool": {}})
    having, without = (np.concatenate([*simulate_devices(scene, variant, 0.002)])[:, 0] for variant in (rig, bare))
    position, orientation = (slice(at, at + size) for at, size in ((AT.probe_position, 3), (AT.probe_orientation, 4)))
    handle = matrix(without[0, orientation])
    expected = without[0, position] + handle @ [0.0, 0.0, -0.1]
    np.testing.assert_allclose(having[0, position], expected, rtol=0.0, atol=4.0 * EPS)
    turned = handle @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(matrix(having[0, orientation]), turned, rtol=0.0, atol=8.0 * EPS)
