"""Several fingers in one servo: separate guards and contacts, and zero for all on every shutdown path."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.called import read_stdout
from helpers.faulty_device import FaultyDevice, Options, acts
from helpers.two_fingers import NAMES, SCENE, two_fingers
from helpers.waits import until

from softfinger.config.errors import RecordingError
from softfinger.config.load import build, load_rig
from softfinger.config.schema import Scene
from softfinger.drivers.base import HELD, IGNORED_WRENCH_MAX_S, LOST, WITHHELD
from softfinger.drivers.poses import load_poses
from softfinger.drivers.replay.device import Options as ReplayOptions
from softfinger.drivers.replay.device import Replay
from softfinger.drivers.resample import resample
from softfinger.proxy.kernels.jit.pack import packed
from softfinger.proxy.record import AT, FREE, RECORD_SIZE, list_columns
from softfinger.server.loop import servo_thread as s
from softfinger.server.loop import shutdown
from softfinger.server.loop.fault_detection import JUMPING, NO_FORCE_MAX_S, NO_POSE
from softfinger.server.loop.guard import POSE_FROZEN, POSE_JUMPED, POSE_REFUSED
from softfinger.server.loop.tick import make_start_memory
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import run_ticks, simulate
from softfinger.server.recording.results import read_results

GUARD = load_rig("replay", {"guard.ramp_s": 0.01}).guard
CLOCKED = [AT.timestamp, AT.servo_late, AT.servo_exec, AT.servo_missed, AT.servo_busy]
"""Columns that depend on the machine."""


def run_servo(*devices: Any, ticks: int | None = None, **limits: float) -> tuple[s.LoopEnd, np.ndarray]:
    """Run a servo with two devices and changed guard limits; return its end and records (n, fingers, RECORD_SIZE)."""
    tuning = make_tuning(two_fingers(), GUARD)
    tuning = tuning._replace(guards=tuple(guard._replace(**limits) for guard in tuning.guards))
    servo = s.ServoThread(devices, tuning, 1000.0, ticks)
    servo.compile()
    servo.start()
    ended = servo.join(60.0)
    assert ended is not None
    out = np.empty((8192, servo.width))
    records = out[: servo.records.take(out)].reshape(-1, len(devices), RECORD_SIZE)
    servo.close()
    return ended, records


def make_two_devices(**of_index: Any) -> tuple[FaultyDevice, FaultyDevice]:
    """Return two devices that press, the second with a fault; both have a nominal clock."""
    return FaultyDevice(Options(own_clock=True)), FaultyDevice(Options(own_clock=True, **of_index))


def drop_clocked(records: np.ndarray) -> np.ndarray:
    """Return records without the columns that depend on the machine."""
    return np.delete(records, CLOCKED, axis=-1)


def test_two_replays_equal_simulate() -> None:
    recordings = ("press-roll-spin-drag", "tap")
    devices = [Replay(ReplayOptions(recording=name, loop=False), 1000.0) for name in recordings]
    ended, records = run_servo(*devices)
    poses = [resample(load_poses(name), 1000.0) for name in recordings]
    count = min(map(len, poses))
    assert (ended.ending, ended.finger, len(records)) == (s.FINISHED, 1, count)
    simulated = simulate(make_tuning(two_fingers(), GUARD), np.stack([pose[:count] for pose in poses], axis=1), 1000.0)
    np.testing.assert_array_equal(drop_clocked(records), drop_clocked(simulated))
    for place, device in enumerate(devices):
        assert np.linalg.norm(records[:, place, AT.force : AT.force + 3], axis=1).max() > 0.4
        np.testing.assert_array_equal(device.forces()[:count], records[:, place, AT.force : AT.force + 6])
        assert not device.forces()[-1].any()
        device.close()


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize(
    ("fault", "ending", "status"),
    [
        ("lost", shutdown.READ_FAILED, -1),
        ("timeout", shutdown.READ_FAILED, -2),
        ("write_lost", shutdown.WRITE_FAILED, -1),
    ],
)
def test_one_device_that_fails_zeroes_both(place: int, fault: Any, ending: int, status: int) -> None:
    devices = [FaultyDevice(Options(fault=fault if k == place else "none", at=300)) for k in range(2)]
    ended, _ = run_servo(*devices, ticks=400)
    assert (ended.ending, ended.status, ended.finger) == (ending, status, place)
    for device in devices:
        assert np.abs(device.wrenches[-10:-2]).max() > 0.1 and not device.wrenches[-1].any()
        assert acts(device) == ["arm", "stop"] and device.acts[0][2] == 0  # armed before the first tick
    failure = shutdown.describe_failure(devices[ended.finger], ended, NAMES[ended.finger])
    assert failure is not None and f"faulty, finger '{NAMES[place]}'" in str(failure)


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize("fault", ["lost_hang", "write_lost_hang"])
def test_a_failed_device_whose_write_hangs_does_not_delay_the_zero_of_the_other(place: int, fault: Any) -> None:
    """The other device gets zero from the loop itself, not only from a supervisor, which this servo does not have."""
    devices = [FaultyDevice(Options(fault=fault if k == place else "none", at=300)) for k in range(2)]
    other = devices[1 - place]
    with ThreadPoolExecutor() as pool:
        run = pool.submit(run_servo, *devices)
        try:
            until(lambda: len(other.wrenches) > 290 and not other.wrenches[-1].any())
            assert "stop" not in acts(other) and other.wrenches[-2].any()
        finally:
            devices[place].release()
        ended, _ = run.result()
    assert (ended.status, ended.finger) == (LOST, place)


def test_a_refused_arming_leaves_the_first_device_at_zero() -> None:
    first, second = make_two_devices(refuses_to_arm=True)
    ended, records = run_servo(first, second, ticks=100)
    assert ended.ending == s.CRASHED and "force button" in str(ended.error) and len(records) == 0
    assert [act for act, *_ in first.acts] == ["arm", "stop"] and not first.wrenches.any()


@pytest.mark.parametrize("place", [0, 1])
def test_a_failed_stop_does_not_prevent_zero_on_the_other_device(place: int) -> None:
    devices = [FaultyDevice(Options(stop_fails=k == place)) for k in range(2)]
    ended, _ = run_servo(*devices, ticks=200)
    assert ended.ending == s.CRASHED and "could not be stopped" in str(ended.error)
    for device in devices:
        assert device.acts[-1][0] == "stop" and device.wrenches[:-1].any() and not device.wrenches[-1].any()


@pytest.fixture(scope="module")
def undisturbed_records() -> np.ndarray:
    return run_servo(*make_two_devices(), ticks=600)[1]


@pytest.mark.parametrize("fault", ["nan", "withheld_read", "withheld_write", "held"])
def test_a_fault_of_one_device_changes_only_its_finger(fault: Any, undisturbed_records: np.ndarray) -> None:
    devices = make_two_devices(fault=fault, at=300, count=20)
    ended, records = run_servo(*devices, ticks=600)
    assert ended.ending == s.FINISHED
    np.testing.assert_array_equal(drop_clocked(records[:, 0]), drop_clocked(undisturbed_records[:, 0]))
    index = records[:, 1]
    np.testing.assert_array_equal(drop_clocked(index[:300]), drop_clocked(undisturbed_records[:300, 1]))
    force, during = AT.force + 2, slice(300, 320)
    largest = undisturbed_records[during, 1, force].max() * (1.0 + 1e-12)  # rounding
    assert undisturbed_records[during, 1, force].min() > 0.4 and np.isfinite(records).all()
    if fault == "nan":
        assert (index[during, AT.servo_guard] == POSE_REFUSED).all() and (index[during, AT.contact_mode] == FREE).all()
        assert not index[during, AT.contact_budget].any()
    else:
        wanted = HELD if fault == "held" else WITHHELD
        assert (index[:, AT.servo_device] == wanted).nonzero()[0].tolist() == list(range(300, 320))
    if fault == "held":
        assert (index[during, AT.force : AT.force + 3] == index[299, AT.force : AT.force + 3]).all()
        # It has moved deeper by then, so the slew limit applies, from the force that the device holds.
        change = np.linalg.norm(np.diff(index[:, AT.force : AT.force + 3], axis=0), axis=1)
        assert change[319] == pytest.approx(GUARD.force_slew_n_per_s * 1e-3) == change.max()
    elif fault == "withheld_read":  # the read leaves the first tick of the ramp, a tenth, to the write
        assert index[during, force].max() <= 0.1 * largest
    else:
        assert not index[during, force].any()
    np.testing.assert_array_equal(devices[1].wrenches[:600], index[:, AT.force : AT.force + 6])
    if fault != "held":  # that device has moved deeper by then
        assert index[320, force] <= 0.2 * largest and index[-1, force] == undisturbed_records[-1, 1, force]


@pytest.mark.parametrize(("fault", "bit"), [("jump", POSE_JUMPED), ("frozen", POSE_FROZEN)])
def test_a_jumping_or_frozen_pose_zeroes_only_its_finger(fault: Any, bit: int, undisturbed_records: np.ndarray) -> None:
    devices = make_two_devices(fault=fault, at=300, count=100)
    ended, records = run_servo(*devices, ticks=600, speed_max=10.0, turn_max=100.0, frozen=0.0505)
    assert ended.ending == s.FINISHED
    np.testing.assert_array_equal(drop_clocked(records[:, 0]), drop_clocked(undisturbed_records[:, 0]))
    doubted = (records[:, 1, AT.servo_guard].astype(int) == bit).nonzero()[0]
    assert doubted.tolist() == ([300, 400] if fault == "jump" else list(range(351, 400)))
    assert not devices[1].wrenches[doubted].any() and (records[doubted, 1, AT.contact_mode] == FREE).all()
    after = devices[1].wrenches[doubted + 1, 2] if fault == "jump" else devices[1].wrenches[doubted[-1:] + 1, 2]
    assert (after > 0.0).all() and (after <= 0.1 * devices[1].wrenches[299, 2]).all()  # a tenth: the start of the ramp
    assert np.abs(records[:, 1, AT.probe_velocity : AT.probe_velocity + 3]).max() < 0.2  # 0.1 m/s without a jump


@pytest.mark.parametrize(
    ("fault", "ending", "lasted"),
    [
        ("jumps", JUMPING, 5),
        ("nan", NO_POSE, round(NO_FORCE_MAX_S * 1e3)),
        ("held", shutdown.WRITE_FAILED, round(IGNORED_WRENCH_MAX_S * 1e3)),
    ],
)
def test_faults_that_last_end_the_run_and_name_the_finger(fault: Any, ending: int, lasted: int) -> None:
    devices = make_two_devices(fault=fault, at=100, count=100_000)
    ended, records = run_servo(*devices, ticks=3000, speed_max=10.0)
    assert (ended.ending, ended.finger) == (ending, 1)
    assert abs(len(records) - 100 - lasted) <= (2 if fault == "nan" else 0)  # sums of 0.001
    assert not devices[0].wrenches[-1].any() and devices[0].wrenches.any() and not devices[1].wrenches[-1].any()


@pytest.mark.parametrize("both", [True, False])
def test_time_is_nominal_if_all_devices_have_a_nominal_clock(both: bool) -> None:
    stalling = FaultyDevice(Options(own_clock=True, fault="stall", at=100, stall_us=5_500))
    _, records = run_servo(stalling, FaultyDevice(Options(own_clock=both)), ticks=200)
    dt = records[:, :, AT.dt]
    assert (dt[:, 0] == dt[:, 1]).all()
    assert (dt == 0.001).all() if both else dt.max() >= 0.005  # a stall of 5.5 periods skips five deadlines


@pytest.mark.plain
def test_motion_during_refused_poses_causes_no_force_peak() -> None:
    """After NaN poses on a table that tilts about x, f_N = K d + B v with the table's present velocity."""
    turn, hertz, y, period = 0.05, 2.0, 0.02, 0.001
    tilts = {"kind": "sinusoid", "rotation_rad": turn, "axis": [1.0, 0.0, 0.0], "frequency_hz": hertz}
    material = {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 2.0}
    table = {"name": "table", "shape": "plane", "motion": tilts, "material": material}
    tables = {"fingertip": {"radius_m": 0.01}, "object": [table]}
    tuning = make_tuning(build(Scene, tables, "tilting"), GUARD)
    # Half a cycle after the start the table is level, at its largest rate.
    back = round(0.5 / hertz / period) - 1  # the first tick is one period after the start
    poses = np.tile([0.0, y, 0.009, 1.0, 0.0, 0.0, 0.0], (back + 1, 1))
    poses[back - 20 : back, 0] = np.nan
    start = make_start_memory(tuning.scene)
    records = np.zeros((len(poses), 1, RECORD_SIZE))
    dts = np.full(len(poses), period)
    run_ticks(packed(tuning), packed(start), poses[:, None], dts, period, 0, records)
    speed = -turn * 2.0 * np.pi * hertz * y  # of the table there, downwards
    normal_force = records[back, 0, AT.contact_normal_force]
    # The velocity is a difference over a tick: off by (2 pi f dt)^2 / 6 of it, 1e-4 of 0.025 N; the tilt at y by less.
    assert normal_force == pytest.approx(1000.0 * 0.001 + 2.0 * speed, abs=1e-5) and abs(2.0 * speed) > 0.02


@pytest.mark.sampled(1)
@pytest.mark.parametrize("ending", [".csv", ".npz", ".mcap"])
def test_simulate_reads_and_writes_each_finger(ending: str, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    out = tmp_path / f"out{ending}"
    words = ["simulate", "--scene", str(tmp_path / "scene.toml"), "--out", str(out), "--plot", str(tmp_path / "p.png")]
    output = read_stdout(*words, "--poses", "thumb=press-roll-spin-drag", "--poses", "index=tap")
    assert "thumb: 2281 ticks" in output and "index: 2281 ticks" in output
    names = ("press-roll-spin-drag", "tap")
    poses = np.stack([resample(load_poses(name), 1000.0)[:2281] for name in names], axis=1)
    records = simulate(make_tuning(two_fingers(), load_rig("replay").guard), poses, 1000.0)
    for place, name in enumerate(NAMES):
        np.testing.assert_array_equal(read_results(out, name), records[:, place])
        assert (tmp_path / f"p-{name}.png").stat().st_size > 1000
    for unknown in ("", "ring"):
        with pytest.raises(RecordingError):
            read_results(out, unknown)
    if ending == ".csv":
        header = out.read_text("ascii").partition("\n")[0].split(",")
        assert header == [f"{name}.{column}" for name in NAMES for column in list_columns()]
    elif ending == ".npz":
        with np.load(out) as saved:
            np.testing.assert_array_equal(saved["index.force"], records[:, 1, AT.force : AT.force + 3])
