"""Force Dimension's devices under the servo and the daemon: closed loop, faults, signals, zero force afterwards."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.c_stub import COMPILER, NO_COMPILER
from helpers.closed_loop import assert_engine_agrees, records_of_daemon
from helpers.drd_stub import OmegaBench, Stub, bench, stub, stub_library
from helpers.rig_files import load_rig_in_process
from helpers.waits import until

from softfinger.config.errors import DeviceLost, DeviceNotFound, DeviceTimeout, HapticError, SafetyStop
from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.schema import Rig
from softfinger.config.sources import list_shipped
from softfinger.drivers.base import FORCE_OFF, OK
from softfinger.drivers.forcedimension import device as forcedimension
from softfinger.proxy.record import AT, MODE_NAMES
from softfinger.server.app import Daemon
from softfinger.server.driver_contract import RATE_HZ, DeviceCaller, run_for
from softfinger.server.loop import servo_thread as s
from softfinger.server.loop.tuning import make_tuning

__all__ = ["bench", "stub", "stub_library"]  # fixtures

pytestmark = [pytest.mark.real_time, pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)]

PRESSING = {"type": 34, "wrist": 1, "z": 0.0115, "az": 0.0035, "ax": 0.006, "ay": 0.012, "hz": 1.0, "turn": 0.5}
"""Once a second the hand moves 2 mm deep into the plane z = 0 with a finger of 10 mm, rolls, slides and releases."""


def fd_rig(stub: Stub, **changes: Any) -> Rig:
    # The watchdog counts real time, and this machine may stall any thread for longer.
    device = {"driver": "forcedimension", "library_file": str(stub.path), "watchdog_s": 0.0}
    return load_rig_in_process("replay", device, changes)


def test_the_closed_loop_displays_the_forces_of_the_contact_step(stub: Stub) -> None:
    stub.update(**PRESSING, gripper=1, gripper_rad=0.25)
    scene = load_scene("paper-plane")
    changes = {"device.gravity_compensation": True, "guard.ramp_s": 0.01}
    records = records_of_daemon(fd_rig(stub, **changes), scene, 2500)
    compared = assert_engine_agrees(records, scene, RATE_HZ)
    assert compared > 500  # of each 1000 ticks, some 400 are in the plane
    assert set(records[:, AT.contact_mode].tolist()) == set(range(len(MODE_NAMES)))
    assert np.mean(records[:, AT.servo_guard] == 0) > 0.9
    assert set(records[:, AT.gripper].tolist()) == {0.25}
    assert 0.5 < np.abs(records[:, AT.force + 2]).max() < 12.0
    # A late force lets the hand go deeper for some ticks. For 2 % of the time the depth is within 0.4 % of the largest.
    depth = 0.01 - np.percentile(records[:, AT.probe_position + 2], 2)
    # Hand and wall, 1000 N/m each, share the 2 mm; at 1 Hz, inertia adds (1/14)^2 and damping shifts as little.
    assert depth == pytest.approx(0.001, rel=0.05)
    assert stub["threads"] == 0 and stub["torque_sent"] == 0
    assert stub.norm() == 0.0 and stub["force_on"] == 0 and stub["opens"] == stub["closes"] == 1


@pytest.mark.parametrize(
    ("fault", "error", "words"),
    [
        ({"button_at": 700}, SafetyStop, "disabled its force.*button"),
        ({"threshold": 20}, SafetyStop, "disabled its force.*velocity threshold"),
        ({"delay_at": 700, "delay_s": 0.15}, SafetyStop, "disabled its force.*watchdog"),
        ({"error_word": 3}, SafetyStop, "error code is 3"),
        ({"unplug_at": 700}, DeviceLost, "omega.6 right, serial 1230 is gone.*error 2"),
        ({"fail_read": 700, "error": 7}, DeviceTimeout, "no answer to a read.*error 7"),
        ({"fail_write": 700, "error": 2}, DeviceLost, "on write.*error 2"),
        ({"delay_at": 700, "delay_s": 0.9}, SafetyStop, "no tick for"),
    ],
)
def test_every_fault_under_the_daemon_is_named_and_leaves_no_force(
    fault: dict[str, float], error: type[HapticError], words: str, stub: Stub, bench: OmegaBench
) -> None:
    stub.update(**PRESSING)
    limit = {"device.velocity_threshold": fault["threshold"]} if "threshold" in fault else {}
    if "watchdog" in words:
        limit["device.watchdog_s"] = 0.03
    stub.update(**{name: value for name, value in fault.items() if name != "threshold"})
    with Daemon(fd_rig(stub, **limit), load_scene("paper-plane")) as running:
        running.start()
        with pytest.raises(error, match=words):
            running.wait(60.0)
        assert stub.norm() == 0.0
    assert stub.norm() == 0.0
    stub.reset()
    bench.open().close()


def runs_with_its_watchdog(stub: Stub, late: Callable[[], Callable[[], None]]) -> bool:
    stub.reset()
    stub.update(**PRESSING)
    options = build(forcedimension.Options, {"library_file": str(stub.path)}, "[device]")
    with forcedimension.open_device(options, RATE_HZ) as device:
        assert stub["force_on"] == 0
        tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard, [device.info])
        servo = s.ServoThread([device], tuning, RATE_HZ, 300, late)
        servo.compile()
        servo.start()
        ended = servo.join(60.0)
        servo.close()
        assert ended is not None and stub["watchdog"] == 240
        assert ended.ending == s.FINISHED or (ended.status == FORCE_OFF and "watchdog" in device.reason())
        return ended.ending == s.FINISHED


def test_the_default_watchdog_tolerates_a_slow_start(stub: Stub) -> None:
    """The default watchdog tolerates 0.5 s before the first tick; a stall may trip it, so one of five runs finishes."""

    def late() -> Callable[[], None]:
        time.sleep(0.5)
        return lambda: None

    assert any(runs_with_its_watchdog(stub, late) for _ in range(5))


def test_the_status_period_of_the_rig_is_used(stub: Stub, bench: OmegaBench) -> None:
    with bench.open(status_period_s=0.02) as device:
        servo = DeviceCaller(device)
        for _ in range(20):
            assert servo.read()[0] == OK
            servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
        stub.update(force_on=0, cause=6)
        assert [servo.read()[0] for _ in range(20)] == [OK] * 19 + [FORCE_OFF]
        assert "dead-man" in device.reason()


@pytest.mark.parametrize("exclusive", [0, 1])
def test_stop_while_a_transfer_hangs(
    exclusive: int, stub: Stub, bench: OmegaBench, caplog: pytest.LogCaptureFixture
) -> None:
    stub.update(**PRESSING, delay_at=100, delay_s=1.5, exclusive=exclusive)
    with bench.open() as device:
        tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard, [device.info])
        servo = s.ServoThread([device], tuning, RATE_HZ)
        servo.compile()
        servo.start()
        run_for(servo, 100)
        until(stub.busy)
        device.stop()
        assert stub.busy() and servo.ticks == 100  # the call still hangs
        assert ("blocks all others" in caplog.text) == bool(exclusive)
        assert bool(device.zero_failure()) == bool(exclusive)
        assert exclusive or (stub.norm() == 0.0 and stub["force_on"] == 0)
        servo.stop()
        assert servo.join(10.0) is not None
        servo.close()
        until(lambda: stub.norm() == 0.0 and stub["force_on"] == 0)


def test_stop_waits_for_a_running_exchange(stub: Stub, bench: OmegaBench) -> None:
    tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard)
    stub["slow_s"] = 0.02  # long enough to call in, shorter than `stop` waits
    for _ in range(3):  # this thread might stall for a full reading, but not each time
        with bench.open() as device:
            servo = s.ServoThread([device], tuning, RATE_HZ)
            servo.compile()
            servo.start()
            while servo.ticks < 3 or not stub.busy():
                pass
            device.stop()
            servo.stop()
            assert servo.join(10.0) == s.LoopEnd(s.STOPPED, OK)
            servo.close()
    assert stub["threads"] == 0


def test_shipped_rigs_open_their_device(stub: Stub, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [
        name for name in list_shipped(Rig) if (config := load_rig(name).device) and config.driver == "forcedimension"
    ]
    assert names == ["omega-3", "omega-6", "omega-7"]
    for kind, name in zip((33, 34, 35), names, strict=True):
        rig = load_rig(name)
        options = build(forcedimension.Options, rig.device.options | {"library_file": str(stub.path)}, name)
        stub.update(type=kind, wrist=kind > 33, gripper=kind == 35)
        with forcedimension.open_device(options, rig.servo.rate_hz) as device:
            assert device.info.name.startswith(name.replace("-", "."))
            assert rig.guard.force_max_n <= device.info.force_max_n
        stub["type"] = 63
        with pytest.raises(DeviceNotFound, match=r"delta\.3"):
            forcedimension.open_device(options, rig.servo.rate_hz)
    assert stub["moved"] == 0
