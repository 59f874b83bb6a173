"""Force Dimension's devices on a stub for the maker's library: contract, constants, opening, exchange."""

import math
import os
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.c_stub import COMPILER, NO_COMPILER
from helpers.drd_stub import OmegaBench, Stub, bench, plugged_in, stub, stub_library
from helpers.forgotten import forget_user
from helpers.garbage import exchange_garbage
from helpers.plain_by_call import matrix, turned

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DevicePermission, DeviceTimeout
from softfinger.config.schema import DeviceConfig
from softfinger.drivers.base import LOST, OK, SAMPLE_SIZE, WITHHELD
from softfinger.drivers.forcedimension import device as forcedimension
from softfinger.drivers.forcedimension import exchange, library
from softfinger.drivers.forcedimension.selection import MODELS
from softfinger.drivers.system.claims import Claim
from softfinger.drivers.system.diagnosis import Diagnosis
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server.driver_contract import RATE_HZ, DeviceCaller, DriverContract
from softfinger.server.verbs import devices

__all__ = ["bench", "stub", "stub_library"]  # fixtures

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)

TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""From the library's frame (x towards the user, y right, z up) to the world's (x right, y away from the user, z up)."""

SIGMA_7 = {"type": 104, "wrist": 1, "active_wrist": 1, "gripper": 1}


class TestContract(DriverContract):
    """The contract over the stub."""


# --- constants of the header ---


def test_models_equal_the_vendors_header() -> None:
    types = {
        33: "omega.3", 34: "omega.6", 36: "omega.6", 35: "omega.7", 37: "omega.7", 63: "delta.3", 206: "sigma.3",
        104: "sigma.7", 105: "sigma.7", 203: "lambda.3", 131: "lambda.6", 132: "lambda.6", 108: "lambda.7",
        109: "lambda.7",
    }  # fmt: skip
    right, left = {34, 35, 104, 108, 131}, {36, 37, 105, 109, 132}
    # Types in CHAI3D's driver, which names them by the device with the same constants.
    right |= {102, 209, 112, 114, 117, 119, 121, 123, 125, 127, 129, 210, 115}
    left |= {103, 113, 118, 120, 122, 124, 126, 128, 130, 211, 116}
    types |= {110: "omega.3", 111: "delta.3", 133: "sigma.3", 115: "sigma.6", 116: "sigma.6"}
    types |= dict.fromkeys((102, 103, 209), "sigma.7")
    types |= dict.fromkeys((*range(112, 115), *range(117, 131), 210, 211), "lambda.7")
    assert {number: model.name for number, model in MODELS.items()} == types
    for side, numbers in (("right", right), ("left", left)):
        assert {number for number in types if MODELS[number].full_name.endswith(side)} == numbers
    limits = dict.fromkeys((33, 34, 35), (12, 0, 5000, 30, 0.075))
    limits |= {63: (20, 0, 5000, 30, 0.15), 104: (12, 0.2, 4000, 30, 0.075)}
    assert {number: tuple(MODELS[number].limits) for number in limits} == limits
    force, torque, stiffness, _, radius = MODELS[108].limits
    assert (force, torque, stiffness, radius) == (12, 0.2, 8000, 0.1125)


def test_causes_and_status_words_equal_the_vendors_header() -> None:
    assert (exchange.STATUS_FORCE, exchange.STATUS_ERROR, exchange.STATUS_CAUSE) == (5, 9, 14)
    words = ("button", "velocity", "watchdog", "library", "USB", "dead-man")
    assert len(library.FORCE_OFF_CAUSES) == 6
    assert all(word in library.FORCE_OFF_CAUSES[n + 1] for n, word in enumerate(words))


@pytest.mark.parametrize("kind", sorted(MODELS))
def test_every_model_opens_with_its_limits(kind: int, stub: Stub, bench: OmegaBench) -> None:
    name = MODELS[kind].name
    wrist, active = not name.endswith("3"), name in ("sigma.6", "sigma.7", "lambda.7")
    stub.update(type=kind, wrist=wrist, active_wrist=active)
    with bench.open(model=name) as device:
        assert device.info.name.startswith(name) and device.info.sensed_dof == (6 if wrist else 3)
        assert device.info.actuated_dof == (6 if active else 3)
        assert device.info.force_max_n == (20.0 if name == "delta.3" else 12.0)
        assert stub["max_force"] == device.info.force_max_n
        assert device.info.torque_max_nm == (0.2 if active else 100.0)
        assert DeviceCaller(device).write(0.1, 0.2, 0.3, 0.1, -0.2, 0.15) == OK
        assert (stub["torque_sent"] > 0, stub["gripper_sent"]) == (active, 0)


# --- opening ---


def test_a_minimal_rig_changes_no_setting(stub: Stub, bench: OmegaBench) -> None:
    with bench.open():
        state = {name: stub[name] for name in ("moved", "gravity", "brakes", "threshold", "watchdog", "force_on")}
        assert state == {"moved": 0, "gravity": 0, "brakes": 0, "threshold": 0, "watchdog": 0, "force_on": 1}
        assert stub["expert"] == stub["expert_misuse"] == 0
    assert stub["brakes"] == 1 and stub["force_on"] == 0
    assert stub["disables"] == 2 and stub["stops"] == 1  # one of them at opening
    assert stub["opens"] == stub["closes"] == 1


def test_settings_of_the_rig_are_made(stub: Stub, bench: OmegaBench) -> None:
    stub["initialized"] = 0
    with bench.open(velocity_threshold=300, calibrate=True, gravity_compensation=True):
        state = {name: stub[name] for name in ("moved", "gravity", "threshold", "regulated", "force_on")}
        assert state == {"moved": 1, "gravity": 1, "threshold": 300, "regulated": 0, "force_on": 1}
        assert stub["expert"] == stub["expert_misuse"] == 0


@pytest.mark.parametrize("brakes", [True, False])
def test_brakes_are_on_or_off_while_the_force_is_off(brakes: bool, stub: Stub, bench: OmegaBench) -> None:
    """The library brakes whenever the force is disabled, so `brakes = false` has to release the brakes each time."""
    with bench.open_unarmed(brakes=brakes) as device:
        assert (stub["force_on"], stub["brakes"]) == (0, brakes)
        device.arm()
        assert (stub["force_on"], stub["brakes"]) == (1, 0)
        device.stop()
        assert (stub["force_on"], stub["brakes"]) == (0, brakes)
    assert stub["brakes"] == brakes


def test_brakes_that_cannot_be_released_are_logged(stub, bench, caplog):
    stub["refuse_brakes"] = 1
    bench.open().close()
    assert "brakes" not in caplog.text
    bench.open(brakes=False).close()
    assert "brakes = false has no effect" in caplog.text


# --- arming ---


def test_opening_switches_nothing_on_and_arming_does(stub: Stub, bench: OmegaBench) -> None:
    with bench.open_unarmed(watchdog_s=0.03) as device:
        assert (stub["force_on"], stub["watchdog"], stub["cause"]) == (0, 0, 4)
        servo = DeviceCaller(device, arm=False)
        assert servo.read()[0] == OK and servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == WITHHELD
        assert servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) == OK
        time.sleep(0.1)
        for _ in range(20):  # this thread may stall for longer than the watchdog waits, but not each time
            device.arm()
            assert stub["watchdog"] == 240
            if servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK and stub["fz"] == 1.0:
                break
        assert stub["cause"] == 0
        time.sleep(0.1)
        assert stub["cause"] == 3 and stub.norm() == 0.0, "the stub's watchdog does not bite"


def test_opening_disables_a_force_of_a_killed_program(stub: Stub, bench: OmegaBench) -> None:
    stub.update(force_on=1, fz=3.0, cause=0)
    assert stub.norm() == 3.0
    with bench.open_unarmed():
        assert stub.norm() == 0.0 and stub["force_on"] == 0


def test_stopped_device_is_never_armed(stub: Stub, bench: OmegaBench) -> None:
    with bench.open_unarmed() as device:
        device.stop()
        device.arm()
        assert stub["force_on"] == 0
        assert DeviceCaller(device).write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == WITHHELD


def test_a_refused_stop_is_repeated(stub: Stub, bench: OmegaBench) -> None:
    with bench.open(watchdog_s=0.0) as device:
        servo = DeviceCaller(device)
        servo.write(0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
        stub["unplugged"] = 1  # the bus fails for a moment
        device.stop()
        assert "communication error" in device.zero_failure()
        stub["unplugged"] = 0
        assert stub.norm() == 0.5
        device.stop()
        assert stub.norm() == 0.0 and not device.zero_failure()


def test_stop_over_an_arming_that_hangs(stub: Stub, bench: OmegaBench) -> None:
    with bench.open_unarmed() as device:
        stub["enable_s"] = 1.0
        arming = threading.Thread(target=device.arm)
        arming.start()
        while not stub.busy():
            time.sleep(0.001)
        device.stop()
        assert arming.is_alive(), "it waited for the library"
        arming.join(10.0)
        assert stub["force_on"] == 0 and stub.norm() == 0.0


@pytest.mark.parametrize("code", [2, 6, 7])
def test_firmware_without_a_watchdog(code: int, stub: Stub, bench: OmegaBench) -> None:
    stub["refuse_watchdog"] = code
    kind, message = (DeviceTimeout, "") if code == 7 else (DeviceError, r"before 3\.0 has no watchdog.*watchdog_s = 0")
    with pytest.raises(kind, match=rf"dhdSetWatchdog.*{message}"):
        bench.open(watchdog_s=0.03)
    assert stub["expert"] == stub["force_on"] == 0 and stub["opens"] == stub["closes"] == 1
    with bench.open(watchdog_s=0.0) as device:
        assert DeviceCaller(device).write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK
        assert stub["fz"] == 1.0


def test_device_without_a_frame_gives_its_position(stub: Stub, bench: OmegaBench) -> None:
    stub.update(refuse_frame=1, x=0.01, y=0.02, z=0.03, stiffness=1e6, damping=1e3)
    with bench.open() as device:
        servo = DeviceCaller(device)
        reads = stub["reads"]
        for _ in range(5):
            status, sample = servo.read()
            assert status == OK
            np.testing.assert_allclose(sample[:3], TURN @ [0.01, 0.02, 0.03], atol=3e-6)  # 0.25 kg on 1e6 N/m
            assert sample[3:7] == [1.0, 0.0, 0.0, 0.0]
        assert stub["reads"] - reads == 5
        stub["fail_read"] = 0
        assert servo.read()[0] == LOST


def test_a_device_of_unknown_type_has_the_lowest_limits(stub, bench, caplog):
    stub.update(type=77, wrist=1, active_wrist=1)
    with bench.open() as device:
        assert device.info.name == "device of unknown type 77, serial 1230"
        assert "limits are unknown" in caplog.text
        for known in MODELS.values():
            assert device.info.force_max_n < known.limits.force_max_n
            assert device.info.stiffness_max_n_per_m < known.limits.stiffness_max_n_per_m
        assert stub["max_force"] == device.info.force_max_n
        servo = DeviceCaller(device)
        servo.read()
        servo.write(0.1, 0.0, 0.0, 0.1, 0.1, 0.1)
        assert stub["torque_sent"] == 0
    with pytest.raises(DeviceNotFound, match=r"model = omega\.6.*unknown type 77"):
        bench.open(model="omega.6")


def test_device_that_is_not_calibrated_does_not_move_by_itself(stub: Stub, bench: OmegaBench) -> None:
    stub["initialized"] = 0
    with pytest.raises(DeviceError, match=r"not calibrated.*calibrate = true.*MOVES"):
        bench.open()
    assert stub["moved"] == 0 and stub["opens"] == stub["closes"] == 1


def test_failure_while_setting_up_closes_and_leaves_expert_mode(stub: Stub, bench: OmegaBench) -> None:
    stub.update(initialized=0, refuse_init=1)
    with pytest.raises(DeviceTimeout, match=r"drdAutoInit.*timeout"):
        bench.open(calibrate=True)
    stub.reset()
    stub["fail_write"] = 0  # the first force fails, after enabling the force
    with bench.open_unarmed() as device, pytest.raises(DeviceError, match="dhdSetForce"):
        device.arm()
    assert stub["force_on"] == 0 and stub["opens"] == stub["closes"] == 1


def test_a_close_during_a_close_does_not_close_the_next_device(
    bench: OmegaBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal handler closes all devices between two instructions of a close; the library reuses ids."""
    closed = []

    class InterruptedFields:
        def __init__(self, fields: Any) -> None:
            self._fields, self.interrupted = fields, False

        def __getitem__(self, at: int) -> Any:
            value = self._fields[at]
            if at == exchange.AT.open and value and not self.interrupted:
                self.interrupted = True
                device.close()
            return value

        def __setitem__(self, at: int, value: Any) -> None:
            self._fields[at] = value

    with bench.open() as device:
        device.stop()
        monkeypatch.setattr(device._library, "drdClose", closed.append)
        monkeypatch.setattr(device, "_word", InterruptedFields(device._word))
        device.close()
        device.close()
    assert closed == [device._id]


@pytest.mark.parametrize(
    ("code", "kind"),
    [(3, DeviceBusy), (20, DeviceBusy), (5, DeviceNotFound), (7, DeviceTimeout), (2, DeviceError), (4, DeviceError)],
)
def test_error_of_opening_has_its_kind(code: int, kind: type[DeviceError], stub: Stub, bench: OmegaBench) -> None:
    stub.update(fail_open=1, error=code)
    with pytest.raises(kind) as caught:
        bench.open()
    assert type(caught.value) is kind and "device 0" in str(caught.value)


def test_device_is_chosen_by_serial_model_and_number(stub: Stub, bench: OmegaBench) -> None:
    stub["devices"] = 3  # the stub's serial numbers end in the device's number
    with bench.open(serial=1232) as device:
        assert device.info.name == "omega.3, serial 1232"
    with bench.open(number=1, model="omega.3") as device:
        assert device.info.name == "omega.3, serial 1231"
    assert stub["opens"] == stub["closes"] == 4
    with pytest.raises(DeviceNotFound, match=r"model = omega\.7, serial = 9.*omega\.3, serial 1230; .*1231; .*1232"):
        bench.open(model="omega.7", serial=9)
    assert stub["opens"] == stub["closes"]


def test_a_device_is_identified_without_force(stub: Stub) -> None:
    claim = Claim("forcedimension", "usb", 0x1451, None)
    rig = DeviceConfig(driver="forcedimension", options={"library_file": str(stub.path)})
    stub.update(type=34, wrist=1, initialized=0)
    omega = SystemDevice("usb", 0x1451, 0x0402, "omega.x haptic device", "", "/dev/bus/usb/001/005")
    diagnosis, reply = devices.identify_device(omega, claim, rig)
    assert diagnosis == Diagnosis("usable")
    assert reply == {"model": "omega.6 right", "serial": 1230, "system_type": 34, "calibrated": False}
    assert stub["opens"] == stub["closes"] == 1 and stub["moved"] == stub["force_on"] == stub["writes"] == 0
    stub["held"] = 1
    diagnosis, reply = devices.identify_device(omega, claim, rig)
    assert (diagnosis.state, reply) == ("busy", None)


def test_watchdog_shorter_than_two_ticks_is_refused(bench: OmegaBench) -> None:
    with pytest.raises(DeviceError, match=r"watchdog_s = 0\.001 .*at 1000 Hz: give at least 0\.002"):
        bench.open(watchdog_s=0.001)
    bench.open(watchdog_s=0.002).close()
    bench.open(watchdog_s=0.0).close()
    assert bench.stub["watchdog"] == 0


# --- library and USB ---


def test_the_error_for_a_missing_library_lists_the_paths(tmp_path: Path) -> None:
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
        pytest.raises(DeviceNotFound, match=r"the file does not exist.*omega\.x haptic device.*lambda.*1451:7777"),
    ):
        forcedimension.open_device(forcedimension.Options(library_file="/no/such/libdrd.so"), RATE_HZ)


@pytest.mark.parametrize("variable", ["FDSDK", "FORCEDIM_SDK", "HOME"])
def test_the_library_is_found_in_the_folders_of_the_sdk(variable: str, stub_library: Path, tmp_path: Path) -> None:
    folder = tmp_path / (".local/lib" if variable == "HOME" else f"lib/release/lin-{os.uname().machine}-gcc")
    folder.mkdir(parents=True)
    (folder / "libdrd.so.3.17.5").symlink_to(stub_library)
    (folder / "libdrd.so.3.9.0").write_text("older")
    loaded = library.load(None, {"HOME": "/nowhere", variable: str(tmp_path)})
    assert loaded._name == str(folder / "libdrd.so.3.17.5")


def test_the_library_is_searched_without_a_home_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a home directory, neither the search nor a path with ~ fails otherwise than by not finding the file."""
    forget_user(monkeypatch)
    for named in (None, "~/libdrd.so"):
        with pytest.raises(DeviceNotFound, match=r"searched for /usr/local/lib|'~/libdrd.so': the file does not exist"):
            library.load(named, {})


def test_every_function_has_its_full_prototype() -> None:
    """All result and parameter types are declared: by default ctypes would truncate a double and reject a char."""
    source = (Path(__file__).parents[1] / "stubs" / "drd.c").read_text()
    for name, (_, parameters) in library.PROTOTYPES.items():
        declared = re.search(rf"\b{name}\(([^)]*)\)\n?\s*{{", source)[1]
        counted = 0 if declared.strip() == "void" else declared.count(",") + 1
        assert counted == len(parameters), name


def test_permission_is_diagnosed_over_usb(stub: Stub, bench: OmegaBench) -> None:
    stub["devices"] = 0
    nodes = stub.path.parent
    with (
        plugged_in(0x0402, nodes=nodes, mode=0),
        pytest.raises(DevicePermission, match=r"1451.*001/005.*install --system"),
    ):
        bench.open()
    with plugged_in(0x0402, nodes=nodes), pytest.raises(DeviceError, match=r"does not see omega\.x") as caught:
        bench.open()
    assert type(caught.value) is DeviceError
    with plugged_in(nodes=nodes), pytest.raises(DeviceNotFound, match="1451"):
        bench.open()


# --- exchange ---


def test_poses_and_wrenches_are_turned_into_the_world(stub: Stub, bench: OmegaBench) -> None:
    assert np.linalg.det(TURN) == 1.0
    stub.update(**SIGMA_7, x=0.01, y=0.02, z=0.03, stiffness=1e6, damping=1e3)
    for axis in range(3):
        for angle in (0.0, 0.4, -2.0, math.pi):
            stub.update(axis=axis, turned=angle)
            with bench.open() as device:
                status, sample = DeviceCaller(device).read()
                assert status == OK
                # The weight of 0.25 kg hangs on 1e6 N/m.
                np.testing.assert_allclose(sample[:3], TURN @ [0.01, 0.02, 0.03], atol=3e-6)
                # Rounding of sines of half and of full angles.
                np.testing.assert_allclose(matrix(sample[3:7]), TURN @ turned(axis, angle) @ TURN.T, atol=1e-14)
                assert sample[3] >= 0.0
                assert DeviceCaller(device).write(0.1, 0.2, 0.3, 0.01, 0.02, 0.03) == OK
                assert [stub["fx"], stub["fy"], stub["fz"]] == (TURN.T @ [0.1, 0.2, 0.3]).tolist()
                assert [stub["tx"], stub["ty"], stub["tz"]] == (TURN.T @ [0.01, 0.02, 0.03]).tolist()


@pytest.mark.parametrize("left", [0, 1])
def test_an_open_gripper_has_a_positive_angle(left: int, stub: Stub, bench: OmegaBench) -> None:
    stub.update(**SIGMA_7, left=left, gripper_rad=0.4)
    with bench.open() as device:
        assert DeviceCaller(device).read()[1][9] == 0.4


@pytest.mark.scaled
def test_readings_of_garbage(stub: Stub, bench: OmegaBench, cases: Callable[[int, int], int]) -> None:
    with bench.open(status_period_s=1.0) as device:
        stub.update(garbage=1)
        io, out = device.io(), np.zeros(3, np.int64)
        exchange_garbage(
            0, io.read, io.write, io.handle, np.zeros(SAMPLE_SIZE), np.zeros(6), out, cases(20_000, 1_000_000)
        )
        assert out[:2].tolist() == [0, 0]
        assert stub["peak"] <= 12.0 and math.isfinite(stub.norm())
