"""Boards described in a rig, a Haply 2DIY and a Hapkit with its shipped sketch: poses, forces and faults; the daemon on
described boards, which log their motors' forces: contact, faults, a second program, all signals."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulators.hapkit import Hapkit
from emulators.haply2diy import Firmware, Port, place
from emulators.slowline import SlowLine
from helpers.c_stub import compiled
from helpers.described_boards import REST, TO_WORLD, force_of, lower, opened, settled
from helpers.far_ends import sketch_library
from helpers.processes import COMMAND, find_child
from helpers.programs import LIMIT_S, Program
from helpers.rig_files import load_rig_in_process, write_rig
from helpers.waits import ends_within, fresh, until

from softfinger.config.errors import DeviceTimeout
from softfinger.config.load import load_scene
from softfinger.config.schema import Rig
from softfinger.drivers.base import LOST, OK, PROTOCOL, TIMEOUT, Device
from softfinger.server.app import Daemon
from softfinger.server.driver_contract import DeviceCaller
from softfinger.server.states import COMMANDED_REASON

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


ZEROS = bytes.fromhex("5a0000a3") * 2
"""Two frames to a Hapkit, without torque."""


def rig(name: str, path: str, **changes: Any) -> Rig:
    return load_rig_in_process(name, {"path": path, "quiet_s": 0.1, "timeout_s": 0.5}, changes)


@contextmanager
def pressing(**changes: Any) -> Iterator[tuple[Daemon, Firmware, Port]]:
    board = Firmware()
    with Port(board) as port, Daemon(rig("haply-2diy", port.path, **changes), load_scene("paper-plane")) as daemon:
        daemon.start()
        lower(board)
        assert settled(lambda: force_of(board)[2], lambda up: up > 0.2) > 0.2
        yield daemon, board, port


def test_a_late_board_continues() -> None:
    with pressing() as (daemon, board, port):
        for late, stays in ((0.005, True), (0.15, False)):

            def wait(answer: bytes, late: float = late) -> bytes:
                time.sleep(late)
                return answer

            port.spoil = wait
            if stays:
                answers = board.answers
                until(lambda answers=answers: board.answers > answers + 50)
                assert force_of(board)[2] > 0.1
            else:
                assert settled(lambda: any(board.torques), lambda on: not on) is False
        port.spoil = bytes
        assert settled(lambda: force_of(board)[2], lambda up: up > 0.1) > 0.1
        daemon.stop()
        daemon.wait(20.0)
        assert settled(lambda: any(board.torques), lambda on: not on) is False


def test_disarm_does_not_wait_for_the_answers_of_a_late_board() -> None:
    """At this slew limit the force falls in six steps, and the board accepts one force for each of its answers."""
    with pressing(**{"guard.force_slew_n_per_s": 100.0}) as (daemon, board, port):
        assert settled(lambda: force_of(board)[2], lambda up: up > 1.9) > 1.9

        def wait(answer: bytes) -> bytes:
            time.sleep(0.02)
            return answer

        port.spoil = wait
        answers = board.answers
        until(lambda: board.answers > answers + 5)
        count = len(board.log)
        daemon.rendering.disarm(COMMANDED_REASON)
        assert settled(lambda: any(board.torques), lambda on: not on) is False
        forces = [torques for _, *torques in board.log[count:] if any(torques)]
        assert len(forces) <= 2  # one under way at `disarm`, one for an answer in the 6 ms after it


@contextmanager
def command(
    name: str, path: str, folder: Path, environment: dict[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    mine = write_rig(folder, name, path=path, quiet_s=0.1, timeout_s=2.0)
    words = [*COMMAND, "run", "--rig", str(mine), "--realtime", "off", "--endpoint", f"ipc://{folder}/a"]
    with Program(words, stderr=subprocess.PIPE, text=True, env=environment, kill_at_end=True) as process:
        yield process


def press(board: Firmware, process: subprocess.Popen[str]) -> None:
    until(lambda: board.commands >= 50 or process.poll() is not None)
    assert process.poll() is None, process.stderr and process.stderr.read()
    lower(board)
    until(lambda: force_of(board)[2] >= 0.2 or process.poll() is not None)
    assert process.poll() is None


def test_a_watcher_ends_the_force_of_a_killed_program(tmp_path: Path) -> None:
    board = Firmware()
    with Port(board) as port, command("haply-2diy", port.path, tmp_path) as process:
        press(board, process)
        process.kill()
        process.wait()
        assert settled(lambda: any(board.torques), lambda on: not on) is False


def push(board: Hapkit, process: subprocess.Popen[str], down: float) -> float:
    """Turn the handle down from an angle (rad) until it is pushed back; return the angle."""
    end = time.monotonic() + LIMIT_S
    while board.torque() < 0.02:
        assert process.poll() is None and time.monotonic() < end
        down = max(down - 0.004, -0.2)
        board.turn(down)  # counted from the position at the opening of the port, or at the start of the board
        time.sleep(0.01)
    return down


UART = Path(__file__).parents[1] / "stubs" / "uart.c"


def test_a_stalled_line_transmits_no_old_force(tmp_path: Path) -> None:
    stub = compiled(UART, "uart.so", "-ldl")
    with Hapkit(sketch_library()) as board, SlowLine(board.path, 1_000_000, tmp_path) as line:
        board.turn(0.3)
        with command("hapkit", line.path, tmp_path, environment=line.environment(stub)) as process:

            def stall() -> None:
                line.stalled.set()
                assert settled(line.queued, lambda waiting: waiting == ZEROS) == ZEROS

            down = push(board, process, 0.3)
            stall()  # after 0.25 s the run would end; the board switches its motor off after 50 ms
            assert settled(board.torque, lambda torque: torque == 0.0) == 0.0
            begun = len(board.changes())
            line.stalled.clear()
            push(board, process, down)
            back = [torque for _, torque in board.changes()[begun:]]
            assert abs(back[0]) < 0.005 and max(map(abs, np.diff(back))) < 0.01  # N m at the motor: it fades in
            stall()
            process.send_signal(signal.SIGTERM)
            stderr = process.communicate(timeout=60)[1]
        ended = len(board.changes())
        line.stalled.clear()
        settled(lambda: line.waiting, lambda waiting: waiting == 0)
        assert not any(torque for _, torque in board.changes()[ended:]) and board.torque() == 0.0
    assert process.returncode == 4, stderr
    assert "zero force is not confirmed" in stderr and "force is zero" not in stderr
    assert "too many frames are queued in the port" in stderr


def test_a_killed_program_leaves_a_hapkit_without_force(tmp_path: Path) -> None:
    with Hapkit(sketch_library()) as board:
        board.turn(0.3)  # to the right is up: 27 mm, and the fingertip has a radius of 10
        with command("hapkit", board.path, tmp_path) as process:
            push(board, process, 0.3)
            watcher = find_child(process.pid, b"watcher.py\0")
            os.kill(watcher, signal.SIGSTOP)  # leaves the zero to the board
            process.kill()
            killed = time.monotonic()
            process.wait()
            assert settled(board.torque, lambda torque: torque == 0.0) == 0.0
            os.kill(watcher, signal.SIGKILL)
            off, last = board.changes()[-1]
            assert last == 0.0
            assert off - killed > 0.0
