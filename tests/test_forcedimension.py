"""Force Dimension's devices on a stand-in for the maker's library: contract, header, frames, faults, closed loop."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from driver_contract import RATE_HZ, DriverContract, Servo
from drd_stub import COMPILER, NO_COMPILER, Stub, StubBench, plugged_in, stub, stub_library

from softfinger.config.errors import (
    ConfigError,
    DeviceBusy,
    DeviceError,
    DeviceLost,
    DeviceNotFound,
    DevicePermission,
    DeviceTimeout,
    HapticError,
    SafetyStop,
)
from softfinger.config.load import build, load_rig, load_scene, shipped
from softfinger.config.schema import Rig
from softfinger.drivers import forcedimension
from softfinger.drivers.base import FORCE_OFF, LOST, OK, STALE, TIMEOUT
from softfinger.drivers.forcedimension import exchange, library
from softfinger.drivers.forcedimension.models import MODELS
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.atomics import call_device
from softfinger.proxy.kernels.jit import entry
from softfinger.proxy.state import MODE_NAMES, OFFSET, RECORD_SIZE
from softfinger.server import servo as s
from softfinger.server.app import Daemon
from softfinger.server.guard import POSE_REFUSED
from softfinger.server.tuning import make_tuning

__all__ = ["stub", "stub_library"]  # fixtures

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)

TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""From the library's frame (x towards the user, y right, z up) to the world's (x right, y away from the user, z up)."""

OMEGA_6 = {"type": 34, "wrist": 1}
SIGMA_7 = {"type": 104, "wrist": 1, "active_wrist": 1, "gripper": 1}


@pytest.fixture
def bench(stub: Stub) -> StubBench:
    return StubBench(stub)


class TestContract(DriverContract):
    """The contract over the stand-in."""


# --- what the header says ------------------------------------------------------------------------


def test_models_are_those_of_the_header() -> None:
    """System types and recommended maxima, as published."""
    types = {
        33: "omega.3", 34: "omega.6", 36: "omega.6", 35: "omega.7", 37: "omega.7", 63: "delta.3", 206: "sigma.3",
        104: "sigma.7", 105: "sigma.7", 203: "lambda.3", 131: "lambda.6", 132: "lambda.6", 108: "lambda.7",
        109: "lambda.7",
    }  # fmt: skip
    assert {number: model.name for number, model in MODELS.items()} == types
    for number in (34, 35, 104, 108, 131):
        assert MODELS[number].full_name.endswith("right")
    for number in (36, 37, 105, 109, 132):
        assert MODELS[number].full_name.endswith("left")
    limits = {
        33: (12, 0, 5000, 30, 0.075), 34: (12, 0, 5000, 30, 0.075), 35: (12, 0, 5000, 30, 0.075),
        63: (20, 0, 5000, 30, 0.15), 104: (12, 0.2, 4000, 30, 0.075),
    }  # fmt: skip
    for number, expected in limits.items():
        assert tuple(MODELS[number].limits) == expected
    force, torque, stiffness, _, radius = MODELS[108].limits
    assert (force, torque, stiffness, radius) == (12, 0.2, 8000, 0.1125)


def test_causes_and_status_words_are_those_of_the_header() -> None:
    """Force, error and cause are words 5, 9 and 14; causes 1 to 6 are button, velocity, watchdog, software, USB, dead man."""
    assert (exchange.STATUS_FORCE, exchange.STATUS_ERROR, exchange.STATUS_CAUSE) == (5, 9, 14)
    words = ("button", "velocity", "watchdog", "library", "USB", "dead-man")
    assert len(library.FORCE_OFF_CAUSES) == 6
    assert all(word in library.FORCE_OFF_CAUSES[n + 1] for n, word in enumerate(words))


@pytest.mark.parametrize("kind", sorted(MODELS))
def test_every_model_opens_with_its_limits(kind: int, stub: Stub, bench: StubBench) -> None:
    """Each system type opens under its name; three axes are driven, six where the wrist has motors."""
    name = MODELS[kind].name
    wrist, active = not name.endswith("3"), name in ("sigma.7", "lambda.7")
    stub.update(type=kind, wrist=wrist, active_wrist=active)
    with bench.open(model=name) as device:
        assert device.info.name.startswith(name)
        assert device.info.sensed_dof == (6 if wrist else 3)
        assert device.info.actuated_dof == (6 if active else 3)
        assert device.info.force_max_n == (20.0 if name == "delta.3" else 12.0)
        assert stub["max_force"] == device.info.force_max_n
        assert device.info.torque_max_nm == (0.2 if active else 100.0)


# --- opening -------------------------------------------------------------------------------------


def test_nothing_is_done_that_the_rig_does_not_ask_for(stub: Stub, bench: StubBench) -> None:
    """Without a word in the rig nothing moves, nothing carries weight, nothing brakes, the threshold stays; the watchdog
    is 240 times 125 us, expert mode is off again and no expert's call came outside it."""
    with bench.open():
        seen = {name: stub[name] for name in ("moved", "gravity", "brakes", "threshold", "watchdog", "force_on")}
        assert seen == {"moved": 0, "gravity": 0, "brakes": 0, "threshold": 0, "watchdog": 240, "force_on": 1}
        assert stub["expert"] == stub["expert_misuse"] == 0
    assert stub["brakes"] == stub["force_on"] == 0
    assert stub["opens"] == stub["closes"] == 1


def test_everything_is_done_that_the_rig_asks_for(stub: Stub, bench: StubBench) -> None:
    """Calibration, weight, threshold and watchdog as given; brakes when the force is off, and off again with it."""
    stub["initialized"] = 0
    words = {"calibrate": True, "gravity_compensation": True, "brakes": True}
    with bench.open(velocity_threshold=300, watchdog_s=0.01, **words) as device:
        seen = {name: stub[name] for name in ("moved", "gravity", "brakes", "threshold", "watchdog", "regulated")}
        assert seen == {"moved": 1, "gravity": 1, "brakes": 0, "threshold": 300, "watchdog": 80, "regulated": 0}
        assert stub["expert"] == stub["expert_misuse"] == 0
        device.stop()
        assert stub["brakes"] == 1
    with bench.open(brakes=True):
        assert stub["brakes"] == 0 and stub["force_on"] == 1


def test_device_that_is_not_calibrated_does_not_move_by_itself(stub: Stub, bench: StubBench) -> None:
    """Without `calibrate` it is refused, closed and unmoved, and the message says what moves."""
    stub["initialized"] = 0
    with pytest.raises(DeviceError, match=r"not calibrated.*calibrate = true.*MOVES"):
        bench.open()
    assert stub["moved"] == 0 and stub["opens"] == stub["closes"] == 1


def test_failure_while_setting_up_closes_and_leaves_expert_mode(stub: Stub, bench: StubBench) -> None:
    """Where a setting is refused, its function is named, expert mode is off, the device is closed without force."""
    stub["refuse_watchdog"] = 1
    with pytest.raises(DeviceError, match="dhdSetWatchdog"):
        bench.open()
    assert stub["expert"] == stub["force_on"] == 0 and stub["closes"] == 1
    stub.reset()
    stub.update(initialized=0, refuse_init=1)
    with pytest.raises(DeviceTimeout, match=r"drdAutoInit.*timeout"):
        bench.open(calibrate=True)
    stub.reset()
    stub["fail_write"] = 0  # the first force fails, after the force is on
    with pytest.raises(DeviceError, match="dhdSetForce"):
        bench.open()
    assert stub["force_on"] == 0 and stub["opens"] == stub["closes"] == 1


@pytest.mark.parametrize(
    ("code", "kind"),
    [(3, DeviceBusy), (20, DeviceBusy), (5, DeviceNotFound), (7, DeviceTimeout), (2, DeviceError), (4, DeviceError)],
)
def test_error_of_opening_has_its_kind(code: int, kind: type[HapticError], stub: Stub, bench: StubBench) -> None:
    """The library's number decides what a failed opening is called."""
    stub.update(fail_open=1, error=code)
    with pytest.raises(kind) as caught:
        bench.open()
    assert type(caught.value) is kind and "device 0" in str(caught.value)


def test_device_is_chosen_by_serial_model_and_number(stub: Stub, bench: StubBench) -> None:
    """Among three devices the named one is opened, the others are closed again; a wish that none fits lists them."""
    stub["devices"] = 3  # the stub's serial numbers end in the device's number
    with bench.open(serial=1232) as device:
        assert device.info.name == "omega.3, serial 1232"
    with bench.open(number=1, model="omega.3") as device:
        assert device.info.name == "omega.3, serial 1231"
    assert stub["opens"] == stub["closes"] == 4
    with pytest.raises(DeviceNotFound, match=r"model = omega\.7, serial = 9.*omega\.3, serial 1230; .*1231; .*1232"):
        bench.open(model="omega.7", serial=9)
    stub["type"] = 60
    with pytest.raises(DeviceNotFound, match="unknown type 60"):
        bench.open()
    assert stub["opens"] == stub["closes"]


def test_watchdog_shorter_than_two_ticks_is_refused(bench: StubBench) -> None:
    """A watchdog that would bite between two ticks is refused before the device is touched, with the least that will do."""
    with pytest.raises(DeviceError, match=r"watchdog_s = 0\.001 .*at 1000 Hz: give at least 0\.002"):
        bench.open(watchdog_s=0.001)
    bench.open(watchdog_s=0.002).close()
    bench.open(watchdog_s=0.0).close()
    assert bench.stub["watchdog"] == 0


def test_options_outside_their_range_are_refused_by_name() -> None:
    """Each number has a range and a reason, each name a list."""
    given = {"watchdog_s": 0.5, "serial": -1, "number": 127, "velocity_threshold": -1, "model": "omega.5", "spin": 1}
    with pytest.raises(ConfigError) as caught:
        build(forcedimension.Options, given, "rig [device]")
    for word in ("watchdog_s = 0.5", "serial = -1", "number = 127", "velocity_threshold = -1", "omega.6", "spin"):
        assert word in str(caught.value)


# --- library and USB -----------------------------------------------------------------------------


def test_absent_library_says_where_it_was_looked_for(tmp_path: Path) -> None:
    """The message has each place, the variables that are not set, and where to get it; a device is named all the same."""
    environ = {"FDSDK": str(tmp_path / "sdk"), "HOME": str(tmp_path)}
    with pytest.raises(DeviceNotFound) as caught:
        library.load(None, environ)
    machine = os.uname().machine
    for part in (
        f"{tmp_path}/sdk/lib/release/lin-{machine}-gcc/libdrd.so*", f"{tmp_path}/.local/lib/libdrd.so*",
        "/usr/local/lib/libdrd.so*", "$FORCEDIM_SDK is not set", "forcedimension.com", "FDSDK",
    ):  # fmt: skip
        assert part in str(caught.value), part
    with (
        plugged_in(0x0402, 0x040C, 0x7777, nodes=None),
        pytest.raises(DeviceNotFound, match=r"no such file.*omega\.x haptic device.*lambda.*1451:7777"),
    ):
        forcedimension.open_device(forcedimension.Options(library="/no/such/libdrd.so"), RATE_HZ)


@pytest.mark.parametrize("variable", ["FDSDK", "FORCEDIM_SDK", "HOME"])
def test_library_is_found_where_the_sdk_puts_it(variable: str, stub_library: Path, tmp_path: Path) -> None:
    """In the SDK's folder by either variable, and in ~/.local/lib; of two versions the newer."""
    folder = tmp_path / (".local/lib" if variable == "HOME" else f"lib/release/lin-{os.uname().machine}-gcc")
    folder.mkdir(parents=True)
    (folder / "libdrd.so.3.17.5").symlink_to(stub_library)
    (folder / "libdrd.so.3.9.0").write_text("older")
    found = library.load(None, {"HOME": "/nowhere", variable: str(tmp_path)})
    assert found._name == str(folder / "libdrd.so.3.17.5")


def test_unusable_library_is_named(tmp_path: Path) -> None:
    """A file that is no library, and a library that lacks a function, are refused with the file and the function."""
    file = tmp_path / "libdrd.so"
    file.write_text("no library")
    with pytest.raises(DeviceError, match=rf"{file} cannot be loaded"):
        library.load(str(file))
    source = tmp_path / "empty.c"
    source.write_text("int dhdErrorGetLast(void) { return 0; }\n")
    subprocess.run([COMPILER, "-shared", "-fPIC", "-o", str(file), str(source)], check=True)
    with pytest.raises(DeviceError, match=rf"{file} has no function dhdErrorGetLastStr"):
        library.load(str(file))


def test_every_function_has_its_full_prototype(stub_library: Path) -> None:
    """Result and parameters of each are declared: ctypes' own guesses would cut a double and pass no char."""
    loaded = library.load(str(stub_library))
    for name, (result, parameters) in library.PROTOTYPES.items():
        function = getattr(loaded, name)
        assert function.restype is result and function.argtypes == list(parameters)
    source = (Path(__file__).parent / "stubs" / "drd.c").read_text()
    for name, (_, parameters) in library.PROTOTYPES.items():
        declared = re.search(rf"\b{name}\(([^)]*)\)\n?\s*{{", source)[1]
        counted = 0 if declared.strip() == "void" else declared.count(",") + 1
        assert counted == len(parameters), name


def test_permission_is_diagnosed_over_usb(stub: Stub, bench: StubBench) -> None:
    """A node that this user may not write gives the udev rule; one that he may is no question of permission."""
    stub["devices"] = 0
    nodes = stub.path.parent
    with (
        plugged_in(0x0402, nodes=nodes, mode=0o600),
        pytest.raises(DevicePermission, match=r'001/005.*ATTRS\{idVendor\}=="1451".*udevadm'),
    ):
        bench.open()
    with plugged_in(0x0402, nodes=nodes), pytest.raises(DeviceError, match="does not see omega.x") as caught:
        bench.open()
    assert type(caught.value) is DeviceError
    with plugged_in(nodes=nodes), pytest.raises(DeviceNotFound, match="1451"):
        bench.open()


# --- exchange ------------------------------------------------------------------------------------


def matrix_of(q: Any) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_poses_and_wrenches_are_turned_into_the_world(stub: Stub, bench: StubBench) -> None:
    """Towards the user is -y, right is x, up is z: position, orientation, force and torque, by matrices."""
    assert np.linalg.det(TURN) == 1.0
    stub.update(**SIGMA_7, x=0.01, y=0.02, z=0.03, stiffness=1e6, damping=1e3)
    for axis in range(3):
        for angle in (0.0, 0.4, -2.0, math.pi):
            stub.update(axis=axis, turned=angle)
            with bench.open() as device:
                status, sample = Servo(device).read()
                assert status == OK
                # The weight of 0.25 kg hangs on 1e6 N/m.
                np.testing.assert_allclose(sample[:3], TURN @ [0.01, 0.02, 0.03], atol=3e-6)
                about = np.zeros(3)
                about[axis] = 1.0
                cross = np.cross(np.eye(3), about).T
                theirs = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
                # Rounding of sines of half and of whole angles.
                np.testing.assert_allclose(matrix_of(sample[3:7]), TURN @ theirs @ TURN.T, atol=1e-14)
                assert sample[3] >= 0.0
                assert Servo(device).write(0.1, 0.2, 0.3, 0.01, 0.02, 0.03) == OK
                assert [stub["fx"], stub["fy"], stub["fz"]] == (TURN.T @ [0.1, 0.2, 0.3]).tolist()
                assert [stub["tx"], stub["ty"], stub["tz"]] == (TURN.T @ [0.01, 0.02, 0.03]).tolist()


@pytest.mark.parametrize("kind", [33, 34, 35, 63, 131])
def test_torque_is_never_sent_where_no_motor_turns(kind: int, stub: Stub, bench: StubBench) -> None:
    """An omega.6 among others takes a torque, senses its orientation and gets forces only; no gripper is driven."""
    stub.update(type=kind, wrist=1, gripper=kind == 35)
    with bench.open() as device:
        servo = Servo(device)
        for _ in range(50):
            servo.read()
            assert servo.write(0.1, 0.2, 0.3, 0.1, -0.2, 0.3) == OK
    assert stub["torque_sent"] == stub["gripper_sent"] == 0 and stub["writes"] >= 50


def test_buttons_and_gripper_are_read(stub: Stub, bench: StubBench) -> None:
    """Every bit of the mask arrives, the highest included; the gripper's angle where there is one, else None."""
    stub.update(buttons=2.0**31 + 5, **OMEGA_6)
    with bench.open() as device:
        assert Servo(device).read()[1][8] == 2.0**31 + 5
        assert device.gripper_rad is None
    stub.update(type=35, gripper=1, gripper_rad=0.25, buttons=0)
    with bench.open() as device:
        assert Servo(device).read()[1][8] == 0.0
        assert device.gripper_rad == 0.25


def test_one_and_two_are_success_and_are_counted(stub: Stub, bench: StubBench) -> None:
    """A held-back exchange and motors at their limit go on with status STALE, each counted; the pose is the last one."""
    stub.update(guard_reads=4, guard_writes=5)
    with bench.open() as device:
        servo = Servo(device)
        before = None
        for n in range(20):
            status, sample = servo.read()
            assert status == (STALE if n and n % 4 == 0 else OK)
            if status == STALE:
                assert sample[:7] == before[:7] and sample[7] >= before[7]
            before = sample
            # Number 0 was the zero of the opening.
            assert servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) == (STALE if (n + 1) % 5 == 0 else OK)
        stub.update(guard_reads=0, guard_writes=0)
        assert servo.write(0.0, 0.0, 30.0, 0.0, 0.0, 0.0) == STALE
        assert device.counts == (20, 4, 21, 4, 1)
        assert stub["fz"] == 12.0  # the device's own limit, set when it was opened


@pytest.mark.parametrize(("code", "status"), [(7, TIMEOUT), (2, LOST), (1, LOST)])
@pytest.mark.parametrize("call", ["fail_read", "fail_write"])
def test_failing_call_gives_its_status_and_reason(
    call: str, code: int, status: int, stub: Stub, bench: StubBench
) -> None:
    """The library's timeout is a timeout, any other error a loss; the number stands in the reason."""
    with bench.open() as device:
        servo = Servo(device)
        servo.read()
        servo.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        stub.update(**{call: 0, "error": code})
        assert (servo.read()[0] if call == "fail_read" else servo.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)) == status
        assert device.reason() == f"the library's error {code}"
        device.stop()
        assert stub.norm() == 0.0  # even where every force fails: the force is disabled
        assert stub["force_on"] == 0


def test_force_that_is_no_number_becomes_zero(stub: Stub, bench: StubBench) -> None:
    """NaN or infinity in any place of a wrench never reaches the library: it gets zero."""
    stub.update(**SIGMA_7)
    with bench.open() as device:
        servo = Servo(device)
        for place in range(6):
            for bad in (math.nan, math.inf, -math.inf):
                assert servo.write(0.1, 0.1, 0.1, 0.01, 0.01, 0.01) == OK
                wrench = [0.1] * 6
                wrench[place] = bad
                assert servo.write(*wrench) == STALE
                assert stub.norm() == stub["tx"] == stub["ty"] == stub["tz"] == 0.0


def test_matrix_that_is_no_rotation_is_no_orientation(stub: Stub, bench: StubBench) -> None:
    """A pose that is not a number stays one, for the guard to refuse; its read succeeds."""
    stub["nan_at"] = 1
    with bench.open() as device:
        servo = Servo(device)
        assert not math.isnan(servo.read()[1][1])
        status, sample = servo.read()
        assert status == OK and math.isnan(sample[1])
        assert not math.isnan(servo.read()[1][1])


@entry
def fuzz(read: int, write: int, handle: int, sample: Any, wrench: Any, out: Any, times: int) -> None:
    """Read and write `times`; counts statuses outside OK and STALE, and orientations neither NaN nor unit."""
    for _ in range(times):
        status = call_device(read, handle, sample)
        if status != 0 and status != 1:
            out[0] += 1
        norm = 0.0
        for k in range(3, 7):
            norm += sample[k] * sample[k]
        if norm == norm:
            out[2] += 1
            if not abs(norm - 1.0) < 1e-9:
                out[1] += 1
        for k in range(6):
            wrench[k] = sample[k]
        call_device(write, handle, wrench)


def test_a_million_readings_of_garbage(stub: Stub, bench: StubBench) -> None:
    """Whatever bits the library gives, a read ends with OK or STALE and an orientation is NaN or of unit length; what
    comes of it and goes back as force is finite, and never more than the device's limit."""
    with bench.open(status_period_s=1.0) as device:
        stub.update(garbage=1)
        io, out = device.io(), np.zeros(3, np.int64)
        fuzz(io.read, io.write, io.handle, np.zeros(9), np.zeros(6), out, 1_000_000)
        assert out[:2].tolist() == [0, 0]
        assert stub["peak"] <= 12.0 and math.isfinite(stub.norm())


def test_exchange_allocates_nothing() -> None:
    """The compiled read and write, compiled afresh, name no allocator; the control that allocates does."""
    compile_fresh = numba.cfunc(exchange.IO_SIGNATURE, error_model="numpy")

    def allocates(handle: int, values: Any) -> int:
        return len(np.zeros(handle))

    allocators = ("NRT_Allocate", "NRT_MemInfo_alloc", "malloc")
    assert any(name in compile_fresh(allocates).inspect_llvm() for name in allocators)
    for function in (exchange.read, exchange.write):
        code = compile_fresh(function._pyfunc).inspect_llvm()
        assert "inttoptr" in code  # it is the code that calls the library
        assert not any(name in code for name in allocators)


# --- in the loop ---------------------------------------------------------------------------------

PRESSING = {**OMEGA_6, "z": 0.0115, "az": 0.0035, "ax": 0.006, "ay": 0.012, "hz": 1.0, "turn": 0.5}
"""Once a second the hand goes 2 mm deep into the plane z = 0 with a finger of 10 mm, rolls, slides and lets go."""


def records_of(servo: s.Servo) -> np.ndarray:
    out = np.empty((8192, RECORD_SIZE))
    return out[: servo.take(out)]


def test_closed_loop_feels_what_the_contact_step_gives(stub: Stub, bench: StubBench) -> None:
    """Press, roll, slide and release by a hand on a simulated handle: the forces at the motors and the modes are those
    that the contact step gives on the sensed poses; the wall holds the handle back; two threads never meet in the library."""
    stub.update(**PRESSING)
    scene = load_scene("paper-plane")
    with bench.open() as device:
        tuning = make_tuning(scene, load_rig("replay", {"guard.ramp_s": 0.01}).guard, device.info)
        servo = s.Servo(device, tuning, RATE_HZ, 2500)
        servo.compile()
        servo.start()
        ended = servo.join(60.0)
        assert ended == s.Ended(s.FINISHED, OK)
        records = records_of(servo)
        servo.close()
        assert device.counts.reads == 2500
    engine = Engine(scene, RATE_HZ)
    forces, modes = [], []
    for row in records:
        at = OFFSET["probe.position"]
        turned = OFFSET["probe.orientation"]
        step = engine.step(row[at : at + 3], row[turned : turned + 4], float(row[OFFSET["dt"]]))
        forces.append(step.force)
        modes.append(step.mode)
    given = records[:, OFFSET["force"] : OFFSET["force"] + 3]
    free = records[:, OFFSET["servo.guard"]] == 0
    assert np.mean(free) > 0.9
    # The same kernel on the same poses; the record's orientation has been normalised once more.
    np.testing.assert_allclose(given[free], np.array(forces)[free], atol=1e-9)
    assert records[:, OFFSET["contact.mode"]].tolist() == [float(mode) for mode in modes]
    assert {MODE_NAMES[int(mode)] for mode in set(modes)} == set(MODE_NAMES)
    assert 0.5 < np.abs(given[:, 2]).max() < 12.0
    depth = 0.01 - records[:, OFFSET["probe.position"] + 2].min()
    assert 0.0 < depth < 0.0015  # the hand of 1000 N/m and the wall of 1000 N/m share the 2 mm
    assert stub["threads"] == 0 and stub["torque_sent"] == 0
    assert stub.norm() == 0.0 and stub["force_on"] == 0 and stub["opens"] == stub["closes"] == 1


def fd_rig(stub: Stub, **changes: Any) -> Rig:
    base = {
        "device.driver": "forcedimension", "device.library": str(stub.path), "servo.realtime": "off",
        "telemetry.endpoint": "tcp://127.0.0.1:*", "guard.ramp_s": 0.01,
    }  # fmt: skip
    return load_rig("replay", base | changes)


@pytest.mark.parametrize(
    ("fault", "error", "words"),
    [
        ({"button_at": 700}, SafetyStop, "turned its force off.*button"),
        ({"threshold": 20}, SafetyStop, "turned its force off.*velocity threshold"),
        ({"step_s": 0.05}, SafetyStop, "turned its force off.*watchdog"),
        ({"error_word": 3}, SafetyStop, "error word is 3"),
        ({"unplug_at": 700}, DeviceLost, "omega.6 right, serial 1230 is gone.*error 2"),
        ({"fail_read": 700, "error": 7}, DeviceTimeout, "no answer to a read.*error 7"),
        ({"fail_write": 700, "error": 2}, DeviceLost, "on write.*error 2"),
        ({"delay_at": 700, "delay_s": 0.9}, SafetyStop, "no tick for"),
    ],
)
def test_every_fault_under_the_daemon_is_named_and_leaves_no_force(
    fault: dict[str, float], error: type[HapticError], words: str, stub: Stub, bench: StubBench
) -> None:
    """Force button, threshold, watchdog, error word, unplugging, errors of reads and writes, a blocked transfer: the
    daemon ends with the fault's own error and cause, the motors have no force, and the device opens again afterwards."""
    stub.update(**PRESSING)
    options = {"device.velocity_threshold": 20} if "threshold" in fault else {}
    stub.update(**{name: value for name, value in fault.items() if name != "threshold"})
    with Daemon(fd_rig(stub, **options), load_scene("paper-plane")) as running:
        running.start()
        with pytest.raises(error, match=words):
            running.wait(60.0)
        assert stub.norm() == 0.0
    assert stub.norm() == 0.0
    stub.reset()
    bench.open().close()


def test_pose_that_is_no_pose_means_zero_force_for_its_tick(stub: Stub, bench: StubBench) -> None:
    """One NaN from the device zeroes the force in its tick and is told by the guard; the loop goes on."""
    stub.update(**PRESSING, nan_at=480)  # in contact
    with bench.open() as device:
        tuning = make_tuning(load_scene("paper-plane"), load_rig("replay", {"guard.ramp_s": 0.01}).guard, device.info)
        servo = s.Servo(device, tuning, RATE_HZ, 700)
        servo.compile()
        servo.start()
        assert servo.join(60.0).ending == s.FINISHED
        records = records_of(servo)
        servo.close()
    force = np.linalg.norm(records[:, OFFSET["force"] : OFFSET["force"] + 3], axis=1)
    assert force[479] > 0.3 and force[480] == 0.0 and force[540] > 0.3
    assert int(records[480, OFFSET["servo.guard"]]) == POSE_REFUSED


def test_status_is_asked_for_as_often_as_the_rig_says(stub: Stub, bench: StubBench) -> None:
    """A force that the device turned off is noticed after at most the rig's time, and not before the question."""
    with bench.open(status_period_s=0.02) as device:
        servo = Servo(device)
        for _ in range(20):
            assert servo.read()[0] == OK
            servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
        stub.update(force_on=0, cause=6)
        assert [servo.read()[0] for _ in range(20)] == [OK] * 19 + [FORCE_OFF]
        assert "dead-man" in device.reason()


def test_stop_while_a_transfer_hangs(stub: Stub, bench: StubBench) -> None:
    """From another thread, `stop` waits a moment for the exchange under way and then takes the force off over it."""
    stub.update(**PRESSING, delay_at=100, delay_s=0.8)
    with bench.open() as device:
        tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard, device.info)
        servo = s.Servo(device, tuning, RATE_HZ)
        servo.compile()
        servo.start()
        while servo.ticks < 100:
            servo.wait_record()
        time.sleep(0.05)
        device.stop()
        assert stub.norm() == 0.0 and stub["force_on"] == 0
        assert servo.ticks == 100  # it did hang
        servo.stop()
        assert servo.join(10.0) is not None
        servo.close()
        assert stub.norm() == 0.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_leaves_the_device_closed_and_without_force(number: int, stub_library: Path, tmp_path: Path) -> None:
    """The command line's daemon on the stand-in, pressing: a signal ends it in order, exit code 0, and the device was
    zeroed, disabled and closed, with expert mode off."""
    rig, left = tmp_path / "rig.toml", tmp_path / "left.txt"
    rig.write_text(
        f'[device]\ndriver = "forcedimension"\nlibrary = "{stub_library}"\n[guard]\nramp_s = 0.01\n'
        f'[telemetry]\nendpoint = "ipc://{tmp_path}/t"\n[servo]\nrealtime = "off"\n'
    )
    settings = ",".join(f"{name}={value}" for name, value in PRESSING.items())
    process = subprocess.Popen(
        [sys.executable, "-m", "softfinger.server.cli", "run", "--rig", str(rig)],
        env=os.environ | {"STUB_DRD_SET": settings, "STUB_DRD_LOG": str(left)},
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        from softfinger.server.client import subscribe

        for sample in subscribe(f"ipc://{tmp_path}/t"):
            if sample.force[2] > 0.5:
                break
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, said
    state = {name: float(value) for name, value in (line.split() for line in left.read_text().splitlines())}
    assert state["peak"] > 0.5
    assert state["motors"] == state["force_on"] == state["expert"] == state["unplugged"] == 0
    assert state["opens"] == state["closes"] == 1


def test_shipped_rigs_open_their_device(stub: Stub, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each shipped rig for a device of Force Dimension opens it, moves nothing, and refuses another model."""
    names = [name for name in shipped(Rig) if load_rig(name).device.driver == "forcedimension"]
    assert names == ["omega-3", "omega-6", "omega-7"]
    for kind, name in zip((33, 34, 35), names, strict=True):
        rig = load_rig(name)
        options = build(forcedimension.Options, rig.device.options | {"library": str(stub.path)}, name)
        stub.update(type=kind, wrist=kind > 33, gripper=kind == 35)
        with forcedimension.open_device(options, rig.servo.rate_hz) as device:
            assert device.info.name.startswith(name.replace("-", "."))
            assert rig.guard.force_max_n <= device.info.force_max_n
        stub["type"] = 63
        with pytest.raises(DeviceNotFound, match=r"delta\.3"):
            forcedimension.open_device(options, rig.servo.rate_hz)
    assert stub["moved"] == 0


