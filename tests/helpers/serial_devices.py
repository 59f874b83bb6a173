"""Serial devices for the tests: the driver on a pseudo terminal, an emulated board at the other end."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from emulators.serialboard import FRAME_BYTES, Board, Cable

from helpers import rig_files
from softfinger.drivers.serial.device import SerialDevice, open_device

RIG = "woodenhaptics-v3"
PLACE = (0.01, 0.02, -0.015)


rig_options = partial(rig_files.rig_options, RIG)


def opened(cable: Cable, **changes: Any) -> SerialDevice:
    """Open the device at the end of a cable; its limits allow for late answers of a busy machine."""
    return open_device(rig_options(**{"path": cable.path, "quiet_s": 0.1, "timeout_s": 0.5, **changes}), 1000.0)


@contextmanager
def board(**changes: Any) -> Iterator[tuple[SerialDevice, Board, Cable]]:
    with Cable(Board(lambda _: PLACE)) as cable, opened(cable, **changes) as device:
        yield device, cable.board, cable


def settle(device: SerialDevice, cable: Cable) -> None:
    """Wait until the board has received all that the driver has sent; after a stop, until a zero and no more."""
    until = time.monotonic() + 10.0
    while cable.received_bytes < FRAME_BYTES * device.counts()["written"] + device.counts()["kicks"]:
        if device.counts()["dropped"] and not any(cable.board.force) and at_rest(lambda: cable.received_bytes):
            return
        assert time.monotonic() < until, "the emulated board does not take its frames"
        time.sleep(0.0002)


def at_rest(value: Callable[[], int]) -> bool:
    before = value()
    time.sleep(0.1)
    return value() == before
