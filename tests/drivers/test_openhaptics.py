"""3D Systems' devices on a stub for the maker's library with a real thread and a journal of the motors' ticks."""

import argparse
import ctypes
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.c_stub import COMPILER, NO_COMPILER, compile_stub
from helpers.garbage import exchange_garbage
from helpers.hd_stub import PORT, SOURCE, HdStub, TouchBench, hd, hd_library, touch
from helpers.waits import until

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DevicePermission
from softfinger.config.load import find
from softfinger.config.schema import Rig
from softfinger.drivers import open_devices
from softfinger.drivers.base import OK, SAMPLE_SIZE, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.openhaptics import device as openhaptics
from softfinger.drivers.openhaptics import exchange, library
from softfinger.drivers.openhaptics.library import MODELS, UNKNOWN
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import find_claim
from softfinger.drivers.system.diagnosis import diagnose
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.drivers.system.rules import make_udev_rules
from softfinger.server.driver_contract import DeviceCaller, DriverContract
from softfinger.server.verbs import devices

__all__ = ["hd", "hd_library", "touch"]  # fixtures

pytestmark = [pytest.mark.real_time, pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)]

NAMES = tuple(MODELS)
OLDEST = SystemDevice("serial", 0x0301, 0x2988, "3D Systems Touch 3D Stylus", "", "/dev/ttyACM0")
"""Product string as the kernel logs it (jhu-saw/sawSensablePhantom)."""
NEWEST = SystemDevice("hid", 0x2988, 0x0304, "Touch", "", "/dev/hidraw0")
WAIT_S = 10.0


@pytest.fixture
def bench(touch: TouchBench) -> TouchBench:
    return touch


class TestContract(DriverContract):
    """The contract over the stub."""


def apply_force(servo: DeviceCaller, bench: TouchBench, force: tuple[float, float, float]) -> None:
    def is_displayed() -> bool:
        servo.read()
        servo.write(*force, 0.0, 0.0, 0.0)
        return bench.displayed()[:3] == pytest.approx(force, abs=1e-12)

    until(is_displayed)


# --- constants of the header ---


@pytest.mark.parametrize("model", range(len(NAMES)))
def test_every_model_opens_with_its_limits(model: int, hd: HdStub, bench: TouchBench) -> None:
    """Each model opens with CHAI3D's limits, or with the device's if lower; only a Premium 6DOF is given torques."""
    name, outputs = NAMES[model], 6 if "6DOF" in NAMES[model] else 3
    hd.update(model=model, outputs=outputs, max_force=50.0)
    with bench.open(model=name) as device:
        assert device.info.name == f"{name}, serial 70001"
        assert (device.info.sensed_dof, device.info.actuated_dof) == (6, outputs)
        assert device.info.force_max_n == MODELS[name].force_max_n
        assert device.info.workspace_min_m == pytest.approx((-0.08, -0.035, -0.06))
        DeviceCaller(device).write(0.1, 0.0, 0.0, 0.01, 0.01, 0.01)
        hd.after(2)
        assert [any(part) for part in np.split(np.array(hd.wrench()), 2)] == [True, outputs == 6]
    hd["max_force"] = 0.9
    with bench.open() as device:
        assert device.info.force_max_n == 0.9


def test_limits_equal_those_of_chai3d() -> None:
    published = {
        "Touch": (3.3, 0, 400, 4), "PHANTOM Omni": (3.3, 0, 700, 5), "PHANTOM Desktop": (7.9, 0, 1000, 5),
        "PHANTOM Premium 1.5 6DOF": (8.5, 0.188, 800, 5), "PHANTOM Premium 3.0 6DOF": (22, 0.188, 1000, 5),
    }  # fmt: skip
    assert {name: tuple(MODELS[name])[:4] for name in published} == published
    assert all(a <= b for limits in MODELS.values() for a, b in zip(UNKNOWN, limits, strict=True))


def test_unknown_model_runs_with_the_least_limits(hd, bench, caplog):
    hd.update(model=6, outputs=6)
    with bench.open() as device:
        assert device.info.actuated_dof == 3 and device.info.force_max_n == 3.3
    assert "limits are unknown" in caplog.text
    with pytest.raises(DeviceNotFound, match=r"model = Touch: it is a Something new, serial 70001"):
        bench.open(model="Touch")
    assert hd["opens"] == hd["closes"] == 2 and not hd["running"]


# --- opening ---


def test_the_order_of_opening_and_closing(hd: HdStub, bench: TouchBench) -> None:
    with bench.open_unarmed() as device:
        assert hd["running"] and hd["output_sets"] == 0
        servo = DeviceCaller(device, arm=False)
        assert servo.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
        device.arm()
        assert hd["output_sets"] == 1
    assert not hd["running"]
    assert (hd["opens"], hd["closes"], hd["starts"], hd["stops"], hd["scheduled"]) == (1, 1, 1, 1, 1)
    assert hd["misuse"] == hd["errors"] == 0


def test_opening_zeroes_the_force_of_a_killed_program(hd: HdStub, bench: TouchBench) -> None:
    call = ctypes.CDLL(str(hd.path))
    call.hdInitDevice.restype = ctypes.c_uint32
    which = call.hdInitDevice(None)
    call.hdBeginFrame(which)
    call.hdEnable(library.FORCE_OUTPUT)
    call.hdSetDoublev(library.CURRENT_FORCE, (ctypes.c_double * 3)(3.0, 0.0, 0.0))
    call.hdEndFrame(which)
    call.hdDisableDevice(which)
    assert hd.wrench()[0] == 3.0
    with bench.open_unarmed():
        assert not any(hd.wrench())


def test_calibration_by_itself_is_updated(hd: HdStub, bench: TouchBench) -> None:
    hd.update(style=7, calibration=library.NEEDS_UPDATE, updates_needed=3)
    with bench.open() as device:
        assert device.calibrated
    assert (hd["updated"], hd["update_style"]) == (3, library.AUTO)


def test_calibration_in_the_inkwell_waits_for_the_user(hd, bench, caplog):
    hd.update(style=library.INKWELL, calibration=library.NEEDS_MANUAL_INPUT)
    with pytest.raises(DeviceError, match="not calibrated: put the stylus into the inkwell"):
        bench.open(calibration_wait_s=0.1)
    assert hd["opens"] == hd["closes"] == 1 and not hd["running"]

    def dock() -> None:
        until(lambda: caplog.text.count("inkwell") >= 2)
        hd["docked"] = 1

    user = threading.Thread(target=dock)
    user.start()
    with bench.open(calibration_wait_s=WAIT_S) as device:
        assert device.calibrated and hd["update_style"] == library.INKWELL
    user.join()


def test_encoders_are_reset_only_if_the_rig_allows_it(hd: HdStub, bench: TouchBench) -> None:
    """Resetting encoders assumes the handle in its reset position, so opening fails without `reset_encoders`."""
    hd.update(style=library.ENCODER_RESET, calibration=library.NEEDS_UPDATE)
    with pytest.raises(DeviceError, match=r"reset position.*reset_encoders = true"):
        bench.open()
    assert hd["updated"] == 0
    with bench.open(reset_encoders=True) as device:
        assert device.calibrated and hd["update_style"] == library.ENCODER_RESET


@pytest.mark.parametrize(
    ("code", "kind", "words"),
    [
        (library.ALREADY_INITIATED, DeviceBusy, "in use by another program"),
        (library.INVALID_LICENSE, DeviceError, "it has no licence"),
        (library.COMM_ERROR, DeviceNotFound, "does not answer.*0x0302.*FireWire.*shows 2988 or 0301:2988"),
    ],
)
def test_error_of_opening_has_its_kind(code, kind, words, hd, bench):
    hd["init_error"] = code
    with pytest.raises(kind, match=words) as caught:
        bench.open()
    assert type(caught.value) is kind and not hd["running"]


def test_an_unusable_library_is_named(tmp_path: Path, bench: TouchBench) -> None:
    with pytest.raises(DeviceNotFound, match=r"library_file = '/no/libHD.so'.*OpenHaptics"):
        bench.open(library_file="/no/libHD.so")
    (tmp_path / "libHD.so").write_text("no library")
    with pytest.raises(DeviceError, match=r"libHD.so cannot be loaded.*x86_64"):
        bench.open(library_file=str(tmp_path / "libHD.so"))
    old = compile_stub(SOURCE, tmp_path / "libHD.so.3.0.0", "-pthread", "-DhdIsEnabled=hdIsNotThere")
    with pytest.raises(DeviceError, match=r"libHD.so.3.0.0 has no function hdIsEnabled: install OpenHaptics 3.4"):
        bench.open(library_file=str(old))


def test_search_of_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hd_library: Path) -> None:
    monkeypatch.setattr(library, "FOLDERS", (tmp_path / "a", tmp_path / "b"))
    with pytest.raises(
        DeviceNotFound, match=rf"{tmp_path}/a/libHD.so\*.*{tmp_path}/b/libHD.so\*.*libHD.so.3.4 by the loader"
    ):
        library.load(None)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "libHD.so.3.4").write_text("older")
    (tmp_path / "b" / "libHD.so.3.4.0").symlink_to(hd_library)
    assert library.load(None)._name == str(tmp_path / "b" / "libHD.so.3.4.0")


def test_identify_gives_no_force(hd: HdStub, bench: TouchBench) -> None:
    hd["calibration"] = library.NEEDS_MANUAL_INPUT
    reply = openhaptics.identify(PORT, bench.options())
    assert reply == {"model": "Touch", "serial": "70001", "calibrated": False}
    assert hd["updated"] == hd["output_sets"] == 0 and not hd["running"]


@pytest.mark.parametrize(
    ("device", "rule"),
    [
        (PORT, 'SUBSYSTEM=="tty", ATTRS{idVendor}=="2988", TAG+='),  # any product of the vendor
        (OLDEST, 'SUBSYSTEM=="tty", ATTRS{idVendor}=="0301", ATTRS{idProduct}=="2988"'),
        (NEWEST, 'SUBSYSTEM=="hidraw", ATTRS{idVendor}=="2988", ATTRS{idProduct}=="0304"'),
        (NEWEST, 'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", ATTR{idVendor}=="2988", ATTR{idProduct}=="0304"'),
    ],
)
def test_each_generation_of_the_touch_is_claimed(device, rule, hd, bench, monkeypatch):
    claim = find_claim(device)
    assert claim is not None and (claim.driver, claim.bus, claim.rigs) == ("openhaptics", device.bus, ("touch",))
    (line,) = [line for line in make_udev_rules().splitlines() if line.startswith(rule)]
    assert ("ID_MM_DEVICE_IGNORE" in line) == (device.bus == "serial")
    bare = device._replace(bus="usb", node="/dev/bus/usb/001/002")
    diagnosis = diagnose(bare, find_claim(bare))
    assert (diagnosis.state, "usbhid" in diagnosis.remedy) == ("node", device.bus == "hid")
    hd["devices"] = 0
    bench.ports((device,))
    attached = rf"{device.name} \({device.ids}\) at {device.node} is attached.*Touch_Setup"
    with pytest.raises(DeviceError, match=attached) as caught:
        bench.open()
    assert type(caught.value) is DeviceError
    bench.ports((device,), permitted=False)
    monkeypatch.setattr(discovery, "is_permitted", lambda node: False)
    with pytest.raises(DevicePermission, match=rf"\({device.ids}\) at .*install --system"):
        bench.open()


def test_a_device_that_usb_does_not_list_is_identified(hd, bench, tmp_path, capsys):
    rig = tmp_path / "touch.toml"
    text = find("touch", Rig).read_text("utf-8")
    rig.write_text(text.replace('driver = "openhaptics"', f'driver = "openhaptics"\nlibrary_file = "{hd.path}"'))

    def listed(ask: bool = True, rig: Path | None = rig) -> Any:
        assert devices.run(argparse.Namespace(json=True, ask=ask, rig=rig)) == 0
        return json.loads(capsys.readouterr().out)["devices"]

    (entry,) = listed()
    assert (entry["bus"], entry["node"], entry["state"]) == ("library", "", "usable")
    assert entry["said"] == {"model": "Touch", "serial": "70001", "calibrated": True}
    assert listed(rig=None) == listed(ask=False) == []
    assert devices.run(argparse.Namespace(json=False, ask=True, rig=rig)) == 0
    assert "it reports: model Touch, serial 70001, calibrated True" in capsys.readouterr().out
    hd["devices"] = 0
    (entry,) = listed()
    assert entry["state"] == "error" and "Ethernet" in entry["reason"] and "GTDD_HOME" in entry["reason"]
    rig.write_text(text.replace('driver = "openhaptics"', 'driver = "openhaptics"\nlibrary_file = "/no/libHD.so"'))
    (entry,) = listed()
    assert entry["state"] == "library"


# --- callback ---


def test_a_force_that_is_too_old_is_ended_by_the_library_thread(hd: HdStub, bench: TouchBench) -> None:
    age_s = 0.02
    with bench.open(force_age_max_s=age_s) as device:
        servo = DeviceCaller(device)
        apply_force(servo, bench, (1.0, 0.0, 0.0))
        wrote = time.monotonic_ns()
        servo.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        until(lambda: not any(bench.displayed()))
        rows = hd.journal()
        rows = rows[rows["ns"] > wrote]
        with_force = np.flatnonzero(rows["force"][:, 0])
        last = with_force[-1]
        assert rows["ns"][last] - wrote < age_s * 1e9 + (rows["ns"][last + 1] - rows["ns"][last]) + 2e6
        lapses = device.counts()["lapses"]
        assert lapses >= 1
        assert servo.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
        assert not any(bench.displayed())
        apply_force(servo, bench, (0.5, 0.0, 0.0))


def test_late_frames_cause_a_warning(hd: HdStub, bench: TouchBench) -> None:
    hd["rate_hz"] = 25
    with bench.open(force_age_max_s=0.02) as device:
        servo = DeviceCaller(device)

        def is_withheld() -> bool:
            servo.read()
            return servo.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD

        until(lambda: is_withheld() and "force_age_max_s = 0.02 s apart" in device.warning())
        hd["rate_hz"] = 1000
        apply_force(servo, bench, (1.0, 0.0, 0.0))


def test_the_inkwell_is_a_warning(hd: HdStub, bench: TouchBench) -> None:
    hd.update(style=library.INKWELL, docked=1)
    with bench.open() as device:
        hd.after(2)
        assert "inkwell" in device.warning()
        hd["docked"] = 0
        hd.after(2)
        assert device.warning() == ""
    hd["docked"] = 1
    with bench.open(inkwell=False) as device:
        apply_force(DeviceCaller(device), bench, (1.0, 0.0, 0.0))


def test_hot_motors_are_a_warning(hd: HdStub, bench: TouchBench) -> None:
    """The warning starts at 0.8 of the maker's scale and ends below 0.7; the run continues."""
    with bench.open() as device:
        assert device.warning() == ""
        for temperature, warns in ((0.75, False), (0.85, True), (0.75, True), (0.65, False)):
            hd["temperature"] = temperature
            hd.after(250)
            assert ("hot" in device.warning()) is warns, temperature
        assert DeviceCaller(device).read()[0] == OK


def test_a_force_that_cannot_be_enabled(hd: HdStub, bench: TouchBench) -> None:
    with bench.open_unarmed() as device:
        hd["refuse_force"] = 1
        with pytest.raises(DeviceError, match=r"cannot be switched on: it cannot do this now \(error 0x0102"):
            device.arm()


def test_a_library_that_hangs_in_a_frame(hd: HdStub, bench: TouchBench) -> None:
    with bench.open() as device:
        servo = DeviceCaller(device)
        apply_force(servo, bench, (1.0, 0.0, 0.0))
        hd.update(delay_s=1.5, delay_at=hd["frames"] + 2)
        until(lambda: servo.read()[0] == TIMEOUT)
        frames = hd["frames"]
        device.stop()
        assert hd["frames"] == frames, "it waited for the library"
        assert not any(hd.wrench()) and device.zero_failure() == ""  # written by another thread
        hd.after(3)
        assert not any(hd.wrench())


@pytest.mark.scaled
def test_frames_of_garbage(hd: HdStub, bench: TouchBench, cases: Callable[[int, int], int]) -> None:
    with bench.open() as device:
        hd["drop_at"] = 0  # from here on the test calls the frames, as fast as possible
        hd.after(3)
        hd["garbage"] = 1
        io, out = device.io(), np.zeros(3, np.int64)
        arrays = np.zeros(SAMPLE_SIZE), np.zeros(6), out
        exchange_garbage(exchange.run_frame.address, io.read, io.write, io.handle, *arrays, cases(20_000, 1_000_000))
        assert out[:2].tolist() == [0, 0]
        assert hd["misuse"] == hd["errors"] == 0


# --- two devices ---


def test_two_devices_at_once(hd: HdStub, bench: TouchBench) -> None:
    hd["devices"] = 2
    with bench.open_unarmed() as first, bench.open_unarmed(name="Left Device") as second:
        assert second.info.name.endswith("70002")
        first_servo, two = DeviceCaller(first), DeviceCaller(second)
        assert two.read()[1][0] - first_servo.read()[1][0] == pytest.approx(0.1)
        apply_force(first_servo, bench, (1.0, 0.0, 0.0))
        until(lambda: two.write(0.0, 0.0, 0.5, 0.0, 0.0, 0.0) == OK and (hd.after(2) or hd.wrench(1)[1] == 0.5))
        second.close()
        assert not any(hd.wrench(1))
        apply_force(first_servo, bench, (1.0, 0.0, 0.0))
    assert hd["misuse"] == 0 and not hd["running"]
    both = [bench.open_unarmed(), bench.open_unarmed(name="Left Device")]
    for device in both:
        device.arm()
    assert open_devices.call_all(lambda device: device.close(), both) == []  # as when the process ends
    assert not hd["running"] and not any(hd.wrench(0) + hd.wrench(1))


def test_a_second_device_is_not_opened_over_a_force(hd: HdStub, bench: TouchBench) -> None:
    """Opening would pause the library's thread while the first device has a force."""
    hd["devices"] = 2
    with bench.open() as first:
        apply_force(DeviceCaller(first), bench, (1.0, 0.0, 0.0))
        with pytest.raises(DeviceBusy, match="list both in one rig"):
            bench.open_unarmed(name="Left Device")
        assert DeviceCaller(first, arm=False).read()[0] in (OK, STALE)


def test_the_same_device_twice_is_busy(hd: HdStub, bench: TouchBench) -> None:
    with bench.open_unarmed() as first:
        with pytest.raises(DeviceBusy, match="twice in this rig"):
            bench.open_unarmed()
        hd.after(3)
        assert DeviceCaller(first).read()[0] == OK
