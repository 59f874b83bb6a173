"""Boards described in a rig, a Haply 2DIY and a Hapkit with its shipped sketch: poses, forces and faults."""

import contextlib
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from emulators.hapkit import Hapkit
from emulators.haply2diy import Firmware, Port, place
from helpers.described_boards import REST, TO_WORLD, force_of, opened, settled
from helpers.far_ends import sketch_library
from helpers.waits import ends_within, fresh, until

from softfinger.config.errors import DeviceTimeout
from softfinger.drivers.base import LOST, OK, PROTOCOL, TIMEOUT, Device
from softfinger.server.driver_contract import DeviceCaller

pytestmark = pytest.mark.real_time


@contextlib.contextmanager
def two_diy(**changes: Any) -> Iterator[tuple[DeviceCaller, Device, Firmware, Port]]:
    board = Firmware()
    with Port(board) as port, opened("haply-2diy", port.path, **changes) as device:
        board.angles = list(REST)
        yield DeviceCaller(device), device, board, port


def test_pose_and_force_of_a_2diy() -> None:
    with two_diy() as (servo, device, board, _):
        fresh(servo)
        x, y = place(*REST)
        wanted = TO_WORLD @ (x - 0.019, y - 0.1, 0.0)
        np.testing.assert_allclose(fresh(servo)[:3], wanted, atol=1e-7)  # a float32 of degrees: 8e-6 of them, 0.07 m
        assert servo.write(0.3, 5.0, -0.4, 1.0, 1.0, 1.0) == OK
        settled(lambda: board.torques, any)
        np.testing.assert_allclose(force_of(board), (0.3, 0.0, -0.4), atol=1e-6)  # a float32 of 0.04 N m
        assert (device.info.sensed_dof, device.info.actuated_dof) == (2, 2)


def test_a_frame_that_lost_a_byte_is_ended_by_resync_bytes() -> None:
    with two_diy(quiet_s=0.02, timeout_s=2.0) as (servo, _, board, port):
        for at in (1, 3, 6, 9):  # of the device number, and of both torques
            fresh(servo)
            setups, logged = board.setups, len(board.log)
            cut = at

            def lose(data: bytes, cut: int = cut) -> bytes:
                port.hears = bytes
                return data[:cut] + data[cut + 1 :]

            port.hears = lose
            servo.write(0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
            until = time.monotonic() + 1.0
            while servo.read()[0] != OK and time.monotonic() < until:
                servo.write(0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
                time.sleep(0.001)
            fresh(servo)
            assert board.setups == setups and board.host == [5, 5]
            assert all(abs(t) <= 0.123 for _, *torques in board.log[logged:] for t in torques)
            servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            assert settled(lambda: board.torques, lambda torques: not any(torques)) == [0.0, 0.0]


def test_a_board_that_forgot_its_setup_is_given_up_and_closed_without_force() -> None:
    with two_diy(quiet_s=0.02, timeout_s=0.3) as (servo, device, board, _):
        fresh(servo)
        servo.write(0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
        settled(lambda: board.torques, any)
        board.host = [0, 0]
        until = time.monotonic() + 10.0
        while (status := servo.read()[0]) >= 0 and time.monotonic() < until:
            servo.write(0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
            time.sleep(0.001)
        assert status in (PROTOCOL, TIMEOUT)
        assert any(board.torques)  # the motors retain their force
        device.close()
        assert settled(lambda: board.torques, lambda torques: not any(torques)) == [0.0, 0.0]


def test_a_board_that_never_answers_is_named_with_the_request() -> None:
    with two_diy(wake_s=0.2) as (_, device, _, port):
        port.mute.set()
        with pytest.raises(DeviceTimeout, match=r"sends no frame within 0\.2 s.*has not answered 02 05 00 00 00 00 "):
            device.arm()


def test_the_sketch_switches_off_by_itself() -> None:
    with Hapkit(sketch_library()) as board, opened("hapkit", board.path) as device:
        servo = DeviceCaller(device)
        fresh(servo)
        servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        assert settled(board.torque, lambda torque: torque > 0.0) > 0.0
        assert settled(board.torque, lambda torque: torque == 0.0) == 0.0
        (on, _), (off, last) = board.changes()[-2:]
        assert last == 0.0
        assert off - on > 0.045


def test_a_hapkit_moves_on_its_arc() -> None:
    with Hapkit(sketch_library()) as board, opened("hapkit", board.path) as device:
        servo = DeviceCaller(device)

        def is_at(angle: float) -> bool:
            place = (-0.09 * (np.cos(angle) - 1.0), 0.0, 0.09 * np.sin(angle))
            # counts of 20 um, and a fraction of one for the rig's five digits
            return bool(np.abs(np.subtract(servo.read()[1][:3], place)).max() < 1e-4)

        for angle in [*np.linspace(0.0, 0.5, 20), *np.linspace(0.5, -0.5, 40)]:  # a step is less than the sensor's jump
            board.turn(angle)
            until(partial(is_at, angle), message=f"at {angle}")
        for damaged in (b"\xa5\x00", b"\xa5\x00\x00\x00\x00\x01", b"\xa5" * 7, bytes(40)):
            until(lambda data=damaged: servo.read() and board.say(data), message="room in the terminal")
            frames = device.counts()["frames"]
            with ends_within(60):
                while device.counts()["frames"] < frames + 20:
                    assert is_at(-0.5)
        assert servo.read()[0] >= 0
        board.pull()
        assert settled(lambda: servo.read()[0], lambda status: status < 0) == LOST
