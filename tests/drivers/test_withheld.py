"""Forces that the driver withheld or could not send, packet by packet, in a scene that always pulls with 5 N."""

import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from emulators.serialboard import Board, Cable
from helpers import usb_stub
from helpers.hid_devices import Answering, Api, described, ends
from helpers.serial_devices import PLACE, opened
from helpers.waits import until

from softfinger.config.load import build, load_rig, load_scene
from softfinger.drivers.base import Device
from softfinger.drivers.hid.device import HidDevice, Options
from softfinger.drivers.hid.link import ReportLink, make_thread_link
from softfinger.server.driver_contract import PULL, RATE_HZ
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tick import Tuning
from softfinger.server.loop.tuning import make_tuning

pytestmark = pytest.mark.real_time

PULL_N = 5.0
SLEW_N = 0.2
"""Slew limit of the guard per tick, small enough that several ticks in one step show."""
QUIET_S = 0.02
STALL_S = 0.06

Sent = Callable[[], np.ndarray]


class Line(NamedTuple):
    """A device, the forces its board received ((n, 3) N, in order), and functions that stall or delay the board.

    step_n  both ends of a change are rounded, by half of it in all
    """

    device: Device
    forces: Sent
    stall: Callable[[bool], None]
    late: Callable[[float], None]
    step_n: float = 1e-3 * 1.001


@contextmanager
def serial() -> Iterator[Line]:
    with Cable(Board(lambda _: PLACE)) as cable, opened(cable, quiet_s=QUIET_S, timeout_s=2.0) as device:

        def stall(now: bool) -> None:
            cable.hear(not now)

        def late(by_s: float) -> None:
            def slowly(frame: bytes) -> bytes:
                time.sleep(by_s)
                return frame

            cable.spoil = slowly

        yield Line(device, lambda: np.array(cable.board.sent).reshape(-1, 7)[:, :3] * 1e-3, stall, late)


@contextmanager
def hid(through: str) -> Iterator[Line]:
    torques: list[tuple[int, ...]] = []
    wait = [0.0]

    def answer(report: bytes) -> bytes:
        torques.append(struct.unpack("<3i", report[1:]))
        time.sleep(wait[0])
        return b"\x03" + struct.pack("<7fBB", 10, -20, 5, 1, 0, 0, 0, 0, 0)

    class Slow(Api):
        def write(self, buff: bytes) -> int:
            time.sleep(wait[0])
            return super().write(buff)

    options = build(Options, described(force_max_n=PULL_N, kick_s=QUIET_S, timeout_s=2.0), "rig")
    fd, end = ends()
    with Answering(end, answer) as answering:
        link = ReportLink(fd) if through == "node" else make_thread_link(Slow(fd), options)
        with HidDevice(options, link) as device:

            def stall(now: bool) -> None:
                answering.deaf.set() if now else answering.deaf.clear()

            def late(by_s: float) -> None:
                wait[0] = by_s

            yield Line(device, lambda: np.array(torques).reshape(-1, 3) * 1e-3, stall, late)


@contextmanager
def falcon() -> Iterator[Line]:
    with usb_stub.attached() as stub:

        def stall(now: bool) -> None:
            stub["mute_at"] = 0.0 if now else -1.0

        def late(by_s: float) -> None:
            stub["late"] = round(1e3 * by_s)

        with usb_stub.FalconBench(stub).open(timeout_s=2.0, kick_s=QUIET_S) as device:
            stub.update(still=1, logged=0)
            # half a motor count at each leg is 4 mN at the knob, which moves a millisecond before the exchange
            yield Line(device, lambda: stub.log()[:, :3], stall, late, 0.02)
        assert stub["logged"] < LOGGED, "not every packet was seen"


CONNECTIONS = {
    "serial": serial, "hid node": lambda: hid("node"), "hid thread": lambda: hid("thread"), "falcon": falcon
}  # fmt: skip
LOGGED = 8192


def pulling(ramp_s: float) -> Tuning:
    """Return a scene that pulls with PULL_N everywhere; of the contract's kind, so that it is compiled once."""
    scene = load_scene({**PULL, "effect": [{"kind": "constant_force", "force_n": [0.0, 0.0, PULL_N]}]})
    guard = load_rig("woodenhaptics-v3", {"guard.ramp_s": ramp_s, "guard.force_slew_n_per_s": SLEW_N * RATE_HZ}).guard
    return make_tuning(scene, guard)


@contextmanager
def running(line: Line, ramp_s: float) -> Iterator[ServoThread]:
    line.device.info = replace(line.device.info, own_clock=True)
    servo = ServoThread([line.device], pulling(ramp_s), RATE_HZ)
    servo.compile()
    line.device.arm()
    servo.start()
    try:
        yield servo
    finally:
        servo.stop()
        assert servo.join(30.0) is not None
        servo.close()


def pulls(line: Line) -> bool:
    forces = line.forces()
    return len(forces) > 0 and bool(forces[-1, 2] > 0.99 * PULL_N)


@pytest.mark.parametrize("connection", CONNECTIONS)
def test_a_force_ramps_up_after_a_silence(connection: str) -> None:
    ramp_s = 0.2
    with CONNECTIONS[connection]() as line, running(line, ramp_s):
        until(lambda: pulls(line))
        before = len(line.forces())
        line.stall(True)
        time.sleep(STALL_S)
        line.stall(False)
        until(lambda: not line.forces()[before:].all(axis=0)[2])
        until(lambda: pulls(line))
        forces = line.forces()
    pull = forces[:, 2]
    zeros = np.flatnonzero(pull[before:] == 0.0) + before
    assert pull[before] > 0.9 * PULL_N
    assert len(zeros) > 0
    assert np.diff(pull).max() <= SLEW_N + line.step_n
    back = pull[zeros[-1] + 1 :]
    # The ramp counts ticks; a frame may have waited for QUIET_S at most.
    assert back[0] <= PULL_N * 2 * QUIET_S / ramp_s and np.diff(back).max() <= PULL_N * 2 * QUIET_S / ramp_s
    if connection == "falcon":  # a tick adds its share to the ramp; at most a few ticks lie between two packets
        assert back[0] <= 4 * PULL_N / (ramp_s * RATE_HZ) + line.step_n and len(back) > ramp_s * RATE_HZ / 4


@pytest.mark.parametrize(
    ("connection", "late_s"), [("serial", 0.004), ("hid thread", 0.004), ("falcon", 0.004), ("falcon", 0.002)]
)
def test_a_force_that_waits_is_no_wider_step(connection: str, late_s: float) -> None:
    with CONNECTIONS[connection]() as line:
        line.late(late_s)
        with running(line, 0.01):
            until(lambda: pulls(line))
            pull = line.forces()[:, 2]
    # Upwards only: a busy machine may cause a silence, which ends the force at once.
    assert np.diff(pull).max() <= SLEW_N + line.step_n
    assert np.count_nonzero((pull > 0.0) & (pull < PULL_N - line.step_n)) >= PULL_N / SLEW_N / 2
