"""Falcon driver on a stub for libusb with adjustable delays; test_falcon_emulated.py uses the real libusb."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from helpers.c_stub import COMPILER, NO_COMPILER
from helpers.closed_loop import assert_engine_agrees
from helpers.usb_stub import FalconBench, UsbStub, stub, word

from softfinger.config.errors import DeviceError, DeviceLost, DeviceNotFound
from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.base import LOST, OK, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.falcon.block import AT as WORDS
from softfinger.drivers.falcon.device import Falcon
from softfinger.drivers.system.claims import find_claim
from softfinger.drivers.system.diagnosis import Diagnosis
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.driver_contract import RATE_HZ, DeviceCaller, DriverContract
from softfinger.server.loop import servo_thread as s
from softfinger.server.loop import shutdown
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.verbs import devices

__all__ = ["stub"]  # fixture

pytestmark = [pytest.mark.real_time, pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)]

STROKE = {"z": 0.012, "press": 0.006, "drag": 0.02}
"""In 1.2 s a hand moves from 2 mm above the plane to 4 mm below, 20 mm to the side and back, and up."""

COUNT_M = 3 * 0.5 * 6.4e-4 / 15
"""Half a count is 0.3 mrad at a leg, at most 1/15 m per radian; three legs."""


@pytest.fixture
def bench(stub: UsbStub) -> FalconBench:
    return FalconBench(stub)


class TestContract(DriverContract):
    """The contract, with a device that answers within the tick."""


def run(device: Falcon, ticks: int) -> tuple[s.LoopEnd, np.ndarray]:
    guard = load_rig("replay", {"guard.ramp_s": 0.01}).guard
    servo = s.ServoThread([device], make_tuning(load_scene("paper-plane"), guard, [device.info]), RATE_HZ, ticks)
    servo.compile()
    servo.start()
    ended = servo.join(60.0)
    assert ended is not None
    records = np.empty((8192, RECORD_SIZE))
    records = records[: servo.records.take(records)]
    servo.close()
    return ended, records


def columns(records: np.ndarray, at: int, number: int = 3) -> np.ndarray:
    return records[:, at : at + number]


def test_closed_loop_with_a_fresh_reply_in_every_tick(stub: UsbStub, bench: FalconBench) -> None:
    stub.update(**STROKE)
    with bench.open() as device:
        stub["logged"] = 0
        ended, records = run(device, 1500)
        log = stub.log()
    assert ended == s.LoopEnd(s.FINISHED, OK)
    assert not records[:, AT.servo_device].any(), "a tick without a fresh reply, or with a force that was cut"
    # The first read, and one after a pause of the machine, sends an extra zero. Each packet of a tick finds the knob at
    # the position sensed in that tick.
    log = log[log[:, 6] == 0][: len(records)]
    np.testing.assert_allclose(columns(records, AT.probe_position), log[:, 3:6], rtol=0, atol=COUNT_M)

    assert assert_engine_agrees(records, load_scene("paper-plane"), RATE_HZ) > 300
    assert set(records[:, AT.contact_mode]) == {0.0, 1.0, 2.0}
    # Half a count at each motor is 4 mN at the knob. K is evaluated at the position of the encoders, 64 um off of some
    # 50 mm over which it changes.
    forces = columns(records, AT.force)
    error = np.linalg.norm(log[:, :3] - forces, axis=1)
    assert (error < 0.007 + COUNT_M / 0.02 * np.linalg.norm(forces, axis=1)).all() and forces[:, 2].max() > 0.5
    assert (stub["threads"], stub["misuse"], stub["flying"], stub["allocated"]) == (0, 0, 0, 0)
    assert stub["opens"] == stub["closes"] and not any(stub.motors())


@pytest.mark.parametrize(
    ("fault", "status"),
    [
        ({"unplug_at": 300}, LOST),
        ({"break_at": 300}, LOST),
        ({"block_at": 300}, TIMEOUT),
        ({"hush_at": 300}, TIMEOUT),
        ({"mute_at": 300}, TIMEOUT),
    ],
    ids=["unplugged", "broken", "out-blocked", "in-blocked", "mute"],
)
def test_faults_leave_no_transfer_pending(fault, status, stub, bench):
    stub.update(z=0.004)
    with bench.open() as device:
        stub.update(**{name: stub["steps"] + steps for name, steps in fault.items()})
        ended, _ = run(device, 2000)
        assert (ended.ending, ended.status) in {(shutdown.READ_FAILED, status), (shutdown.WRITE_FAILED, status)}
    assert (stub["threads"], stub["misuse"], stub["flying"], stub["dropped"], stub["allocated"]) == (0, 0, 0, 0, 0)
    assert stub["opens"] == stub["closes"]
    assert stub["most"] > 50, "there was no force to take away"
    if "block_at" in fault or "break_at" in fault:  # the bus accepts no zero
        steps = stub["steps"]
        for name in fault:
            stub[name] = -1
        assert stub["steps"] == steps
    else:
        assert not any(stub.motors())


@pytest.mark.parametrize("timeout_s", [0.05, 2.0])
def test_a_force_that_hangs_is_withdrawn_and_a_zero_follows(timeout_s, stub, bench):
    with bench.open(timeout_s=timeout_s, kick_s=0.02) as device:
        servo = DeviceCaller(device)
        servo.read()
        servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        assert any(stub.motors())
        servo.read()
        stub["block"] = 1
        servo.write(0.0, 0.0, 2.0, 0.0, 0.0, 0.0)
        forces = stub["forces"]
        threading.Timer(0.15, lambda: stub.__setitem__("block", 0.0)).start()
        device.stop()
        assert stub["forces"] == forces and not any(stub.motors())
        assert stub["cancels"] >= 1
        assert servo.read()[0] in (OK, STALE, WITHHELD)  # a pause, on a machine that is busy


def test_a_stop_without_a_zero_is_logged(stub: UsbStub, bench: FalconBench, caplog: pytest.LogCaptureFixture) -> None:
    device = bench.open(timeout_s=0.05, kick_s=0.02)
    servo = DeviceCaller(device)
    servo.read()
    stub["block"] = 1
    servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    device.close()
    device.stop()
    assert caplog.text.count("zero force has not reached it: it has accepted no packet for 1 s") == 1
    assert device.zero_failure() == "it has accepted no packet for 1 s"
    steps = stub["steps"]
    stub["block"] = 0
    assert (stub["flying"], stub["dropped"], stub["steps"]) == (0, 0, steps)


def test_transfers_not_returned_by_libusb_are_not_freed(stub, bench, caplog):
    device = bench.open()
    DeviceCaller(device).read()
    stub.update(stubborn=1, hush_at=0)
    device.close()
    assert "does not cancel its transfers" in caplog.text
    assert stub["dropped"] == 1 and stub["allocated"] == 2 and stub["misuse"] == 0
    assert stub["opens"] == stub["closes"]
    device.close()
    stub.update(stubborn=0, hush_at=-1)
    with bench.open() as reopened:
        assert DeviceCaller(reopened).read()[0] == OK


def test_stop_waits_for_the_loop_to_leave_libusb(stub: UsbStub, bench: FalconBench) -> None:
    with bench.open() as device:
        servo = DeviceCaller(device)
        servo.read()
        servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        stub["slow_s"] = 0.1
        loop = threading.Thread(target=servo.read)
        loop.start()
        while not stub.busy():
            time.sleep(0.001)
        device.stop()
        assert not any(stub.motors())
        loop.join()
    assert stub["threads"] == 0


def test_closing_under_a_loop_that_hangs_in_libusb(stub, bench, caplog):
    device = bench.open()
    servo = DeviceCaller(device)
    servo.read()
    servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    stub["slow_s"] = 2.3  # two waits of a second
    statuses: list[int] = []
    loop = threading.Thread(target=lambda: statuses.append(servo.read()[0]))
    loop.start()
    while not stub.busy():
        time.sleep(0.001)
    device.close()
    assert "the device stays open" in caplog.text
    assert stub["closes"] == stub["opens"] - 1
    loop.join()
    assert statuses[0] >= 0
    device.close()
    assert stub["opens"] == stub["closes"] and not any(stub.motors())
    assert (stub["threads"], stub["misuse"], stub["allocated"]) == (0, 0, 0)


@pytest.mark.parametrize(("knobs", "error"), [({"refuse": -1}, DeviceLost), ({"transfers": 1}, DeviceError)])
def test_a_failed_opening_frees_everything(knobs, error, stub, bench):
    stub.update(**knobs)
    with pytest.raises(error):
        bench.open()
    assert (stub["allocated"], stub["misuse"], stub["flying"]) == (0, 0, 0) and stub["opens"] == stub["closes"]


def test_firmware_and_homing(stub: UsbStub, bench: FalconBench, tmp_path: Path) -> None:
    path = tmp_path / "firmware.bin"
    path.write_bytes(bytes(range(250)) * 6)
    stub.update(firmware=1500, spoil=1, homed=0)
    with bench.open(firmware=str(path)) as device:
        assert stub["loads"] == 2
        status, sample = DeviceCaller(device).read()
        assert status == OK
        np.testing.assert_allclose(sample[:3], stub.state()[3:], rtol=0, atol=COUNT_M)
    assert stub["most"] == 0, "a motor was driven before its place was known"
    assert stub["misuse"] == 0


@pytest.mark.scaled
def test_spoilt_replies(stub: UsbStub, bench: FalconBench, cases: Callable[[int, int], int]) -> None:
    number = cases(20_000, 1_000_000)
    with bench.open() as device:
        stub.update(still=1, fuzz=1)
        fresh, repeated, failed, places, nowhere, pushed, wrong, partly, withheld = stub.fuzz(device, number)
        assert (pushed, wrong, partly) == (0, 0, 0)
        # Each pause of the machine of 30 ms or more withholds the force of one tick.
        assert (fresh + withheld, repeated, failed) == (number, 0, 0) and withheld < 100
        assert places + nowhere == number and nowhere > number // 10
        assert word(device, WORDS.garbled) > number
    assert not any(stub.motors()) and stub["misuse"] == 0


def test_two_falcons_by_serial_number(stub: UsbStub, bench: FalconBench) -> None:
    stub.update(z=0.03)
    stub[1, "attached"] = 1
    stub[1, "z"], stub[1, "x"] = 0.045, 0.02
    stub.place(1)
    with pytest.raises(DeviceNotFound, match="2 Falcons are attached: select one with serial: 'SN1', 'SN2'"):
        bench.open()
    assert stub["opens"] == stub["closes"] and stub[1, "opens"] == stub[1, "closes"]
    with bench.open(serial="SN2") as second:
        first = bench.open(serial="SN1")
        servo = DeviceCaller(second)
        servo.read()
        servo.write(0.0, 0.0, 0.3, 0.0, 0.0, 0.0)
        assert any(stub.motors(1)) and not any(stub.motors(0))
        servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        with ThreadPoolExecutor() as pool:
            results = list(pool.map(lambda device: run(device, 300), (first, second)))
        for (ended, records), height in zip(results, (0.03, 0.045), strict=True):
            assert ended == s.LoopEnd(s.FINISHED, OK)
            assert np.mean(records[:, AT.servo_device] == OK) > 0.5
            np.testing.assert_allclose(columns(records, AT.probe_position)[:, 2], height, rtol=0, atol=COUNT_M)
        first.close()
        assert stub["claimed"] == 0 and stub[1, "claimed"] == 1
        statuses = []
        for _ in range(5):
            statuses.append(servo.read()[0])
            servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        assert set(statuses) <= {OK, WITHHELD} and OK in statuses  # withheld after a pause
    stub[1, "attached"] = 0
    with pytest.raises(DeviceNotFound, match="no Falcon has the serial number 'SN2': attached are 'SN1'"):
        bench.open(serial="SN2")
    assert not any(stub.motors(1))
    assert (stub["misuse"], stub["allocated"], stub["flying"], stub[1, "flying"]) == (0, 0, 0, 0)
    assert stub[1, "opens"] == stub[1, "closes"]


FALCON = SystemDevice("usb", 0x0403, 0xCB48, "FALCON HAPTIC", "SN1", "/dev/bus/usb/001/005")


def test_a_falcon_reports_its_firmware(stub: UsbStub) -> None:
    claim = find_claim(FALCON)
    assert claim is not None
    diagnosis, reply = devices.identify_device(FALCON, claim)
    assert (diagnosis, reply) == (Diagnosis("usable"), {"firmware": True})
    assert devices.as_map(FALCON, claim, diagnosis, reply)["said"] == {"firmware": True}
    assert "    it reports: firmware True" in devices.format_lines([(FALCON, claim, diagnosis, reply)])
    stub.update(firmware=1000)
    diagnosis, reply = devices.identify_device(FALCON, claim)
    assert (diagnosis.state, reply) == ("firmware", {"firmware": False})
    assert stub["opens"] == stub["closes"] and stub["loads"] == 0
    assert len(stub.log()) and not stub.log()[:, :3].any()  # packets without a force
    stub["held"] = 1
    diagnosis, reply = devices.identify_device(FALCON, claim)
    assert (diagnosis.state, reply) == ("busy", None)
