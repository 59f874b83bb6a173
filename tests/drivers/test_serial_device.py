"""Serial devices on a pseudo terminal: opening, calls of the system; test_contract_at_far_ends has the contract."""

import os
import threading

import numpy as np
import pytest
from emulators.serialboard import FRAME_BYTES, Board, Cable
from helpers.serial_devices import PLACE, board, opened
from helpers.waits import fresh, until

from softfinger.config.errors import DeviceError
from softfinger.config.errors import DeviceTimeout as NoAnswer
from softfinger.drivers.base import LOST, OK, STALE, WITHHELD
from softfinger.drivers.board_exchange import BOARD
from softfinger.server.driver_contract import DeviceCaller

pytestmark = pytest.mark.real_time


def test_an_empty_port_is_not_read() -> None:
    """A read of an empty terminal waits for a kernel thread; a pipe in its place would block for ever."""
    with board(quiet_s=0.2, timeout_s=2.0) as (device, itself, _):
        servo = DeviceCaller(device)
        fresh(servo)
        out, into = os.pipe()
        fd = int(device._block.word[BOARD.fd])
        terminal = os.dup(fd)
        os.dup2(out, fd)
        try:
            for _ in range(3):
                assert servo.read()[0] in (OK, STALE)
            itself.place = (0.05, 0.05, 0.05)
            os.write(into, b"\n" + itself.frame())
            status, sample = servo.read()
            assert status == OK
            np.testing.assert_allclose(sample[:3], (0.05, 0.05, 0.05), atol=1e-6)  # the frame's micrometres
        finally:
            os.dup2(terminal, fd)
            for descriptor in (terminal, out, into):
                os.close(descriptor)


def test_minutes_between_opening_and_the_first_tick() -> None:
    with board(wake_s=0.3, timeout_s=0.2) as (device, itself, cable):
        cable.say(20 * itself.frame())
        itself.place, itself.speed = (0.03, 0.0, 0.02), (0.0, 0.0, 0.0)
        device.arm()
        sample = DeviceCaller(device).read()[1]
        np.testing.assert_allclose(sample[:3], (0.03, 0.0, 0.02), atol=1e-3)  # the hand pulls it away for one step
        cable.hush()
        with pytest.raises(NoAnswer, match=r"sends no frame within 0\.3 s"):
            device.arm()


def test_a_sleeping_board_is_woken_at_opening() -> None:
    with Cable(Board(lambda _: PLACE)) as cable:
        cable.hush()

        def wake() -> None:
            until(lambda: cable.board.wakes >= 3)
            cable.mute.clear()

        threading.Thread(target=wake, daemon=True).start()
        cable.board.force, cable.rest = (1.0, 0.0, 0.0), b"1000 0"  # of a killed program
        with opened(cable) as device:
            assert device.counts()["kicks"] >= 3
            assert not any(cable.board.force)
        cable.hush()
        with pytest.raises(NoAnswer, match=r"at /dev/pts/\d+ sends no frame within 0.2 s: check its power"):
            opened(cable, wake_s=0.2)
        cable.mute.clear()
        cable.spoil = lambda _: b"Marlin 2.1 ready".ljust(FRAME_BYTES - 1) + b"\n"
        with pytest.raises(
            DeviceError, match=r"no frame of eight numbers in 64 bytes \(its last bytes are b'Marlin 2.1"
        ):
            opened(cable, wake_s=0.2)
        assert all(not any(words[:3]) for words in cable.board.sent)


def test_a_closed_device_uses_no_file_descriptor() -> None:
    """Another file may have the number of the closed port."""
    with board() as (device, _, _):
        servo = DeviceCaller(device)
    word = device.zero_command()
    assert servo.read()[0] == LOST and servo.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
    assert servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) == OK
    assert word is not None and word.fd == -1
