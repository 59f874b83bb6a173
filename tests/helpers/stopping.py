"""Stop a device while another thread writes forces."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from helpers.waits import repeated, until
from softfinger.drivers.base import Device
from softfinger.server.driver_contract import DeviceCaller


def stop_during_writes(device: Device, forces: Callable[[], Sequence[bool]], settle: Callable[[], object]) -> None:
    """Stop a device while a thread writes forces without a pause, and check that no force follows the zero.

    forces  whether each command that the far end has processed so far had a force, in order
    settle  waits until the far end has processed all commands
    """
    servo = DeviceCaller(device)

    def write() -> None:
        servo.read()
        servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

    with repeated(write, every_s=0.0):
        until(lambda: any(forces()))
        device.stop()
        settle()
        stopped = len(forces())
        time.sleep(0.005)
        settle()
        assert not any(forces()[stopped - 1 :])
