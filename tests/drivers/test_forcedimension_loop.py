"""Force Dimension's devices under the servo: status, stop during a transfer, shipped rigs."""

import pytest
from helpers.c_stub import COMPILER, NO_COMPILER
from helpers.drd_stub import PRESSING, OmegaBench, Stub, bench, stub, stub_library
from helpers.waits import until

from softfinger.config.errors import DeviceNotFound
from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.schema import Rig
from softfinger.config.sources import list_shipped
from softfinger.drivers.base import FORCE_OFF, OK
from softfinger.drivers.forcedimension import device as forcedimension
from softfinger.server.driver_contract import RATE_HZ, DeviceCaller, run_for
from softfinger.server.loop import servo_thread as s
from softfinger.server.loop.tuning import make_tuning

__all__ = ["bench", "stub", "stub_library"]  # fixtures

pytestmark = [pytest.mark.real_time, pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)]


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
def test_stop_while_a_transfer_hangs(exclusive, stub, bench, caplog):
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
