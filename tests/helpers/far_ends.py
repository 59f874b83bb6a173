"""Emulated devices of every driver with forces, received with their times; each hand presses into the paper's plane."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from emulators.hapkit import COMPILER as CXX
from emulators.hapkit import NO_COMPILER as NO_CXX
from emulators.hapkit import Hapkit, compile_sketch
from emulators.haply2diy import TORQUE_MAX, Firmware, Port
from numpy.typing import NDArray

from helpers import described_boards, haply_devices, usb_stub
from helpers.c_stub import compiled, folder
from helpers.drd_stub import SOURCE as DRD
from helpers.drd_stub import OmegaBench, Stub
from helpers.hd_stub import SOURCE as HD
from helpers.hd_stub import HdStub, TouchBench
from helpers.hid_devices import woody
from helpers.serial_devices import at_rest, board, settle
from helpers.waits import repeated
from softfinger.config.load import build
from softfinger.drivers.base import Device
from softfinger.drivers.replay import device as replay
from softfinger.drivers.simulated import device as simulated

RATE_HZ = 1000.0
PRESSED_S = 0.01


class FarEnd(NamedTuple):
    """A device and the forces it received.

    device    open and armed
    received  after closing, the forces in order (n, 4): monotonic time, s, NaN if row k is that of tick k; and the
              force, in N, or in A or N m of the motors if the device receives these
    handover  ticks until a force reaches the motors
    most      limit of the guard, in the unit of `received`
    withholds whether the driver sends zero if its answers are not read
    hush      makes the device receive without answering; None if it has no such fault
    """

    device: Device
    received: Callable[[], NDArray[np.float64]]
    handover: int = 1
    most: float = 12.0
    withholds: bool = False
    hush: Callable[[], object] | None = None


class Timed(list[Any]):
    """List that records the time of each appended element, s of the monotonic clock."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []

    def append(self, element: Any) -> None:
        self.times.append(time.monotonic())
        super().append(element)


def rows(times: Any, forces: Any) -> NDArray[np.float64]:
    """Return `received` from times (n,) and forces (n, 1 to 3)."""
    columns = np.array(forces, float).reshape(len(times), -1 if len(times) else 0)
    out = np.zeros((len(times), 4))
    out[:, 0] = times
    out[:, 1 : 1 + columns.shape[1]] = columns
    return out


@contextmanager
def pressed_replay(tmp_path: Path) -> Iterator[FarEnd]:
    """Recording of a fingertip 1 mm deep in the plane, dragged back and forth."""
    times = np.arange(0.0, 4.005, PRESSED_S)
    x = 0.005 * np.sin(0.5 * np.pi * times)
    rest = np.tile([0.0, 0.009, 1.0, 0.0, 0.0, 0.0], (len(times), 1))
    path = tmp_path / "pressed.csv"
    np.savetxt(path, np.column_stack([times, x, rest]), delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    device = replay.open_device(build(replay.Options, {"recording": str(path)}, "[device]"), RATE_HZ)
    yield FarEnd(device, lambda: logged(device))


@contextmanager
def simulated_hand(tmp_path: Path) -> Iterator[FarEnd]:
    """Simulated handle; its hand aims at a depth of 4 mm, and sways."""
    hand = {"position_m": [0.0, 0.0, 0.006], "sway_m": [0.005, 0.0, 0.0], "sway_hz": 0.5}
    device = simulated.open_device(build(simulated.Options, hand, "[device]"), RATE_HZ)
    yield FarEnd(device, lambda: logged(device))


TIMELESS = ("replay", "simulated")
"""Logs of written forces without times: ticks without a write are missing."""


def logged(device: Any) -> NDArray[np.float64]:
    """Return the log of a device without an emulated counterpart."""
    forces = device.read_log().wrench[:, :3]
    return rows(np.full(len(forces), np.nan), forces)


def swaying(t: float) -> tuple[float, float, float]:
    """Return the goal of a hand, m, at a time, s: 4 mm deep, moving back and forth."""
    return (0.002 * np.sin(6.0 * t), 0.0, 0.006)


@contextmanager
def serial_board(tmp_path: Path, **keys: Any) -> Iterator[FarEnd]:
    with board(swaying, **{"timeout_s": 2.0, **keys}) as (device, far, cable):
        far.sent = Timed()

        def received() -> NDArray[np.float64]:
            settle(device, cable)
            return rows(far.sent.times, np.array(far.sent, float).reshape(-1, 7)[:, :3] * 1e-3)

        yield FarEnd(device, received, hush=cable.hush)


@contextmanager
def hid_arm(tmp_path: Path, **keys: Any) -> Iterator[FarEnd]:
    """Arm on a packet socket; its motors receive A."""
    with woody(intention=swaying, **{"timeout_s": 2.0, **keys}) as (device, arm, answering):
        arm.sent = Timed()

        def received() -> NDArray[np.float64]:
            answering.settle(device)
            return rows(arm.sent.times, np.array(arm.sent, float)[:, :3] * 1e-3)

        yield FarEnd(device, received, withholds=True, hush=answering.mute.set)


@contextmanager
def falcon(tmp_path: Path, **keys: Any) -> Iterator[FarEnd]:
    with usb_stub.attached() as stub:
        stub.update(z=0.008, press=0.003, drag=0.01)
        bench = usb_stub.FalconBench(stub)
        with bench.open(**{"kick_s": 0.15, "timeout_s": 2.0, **keys}) as device:
            stub["logged"] = 0
            yield FarEnd(device, lambda: rows(stub.times(), stub.log()[:, :3]), hush=lambda: bench.make("timeout"))


@contextmanager
def force_dimension(tmp_path: Path) -> Iterator[FarEnd]:
    """An omega.3 on the stub of libdrd."""
    stub = Stub(compiled(DRD, "libdrd.so.3.17.5"))
    stub.reset()
    stub.update(z=0.008, ax=0.002, ay=0.002)
    with OmegaBench(stub).open() as device:
        yield FarEnd(device, stub.log)


@contextmanager
def open_haptics(tmp_path: Path) -> Iterator[FarEnd]:
    """Touch on the stub of libHD, whose thread sends the latest force to the motors every millisecond."""
    stub = HdStub(compiled(HD, "libHD.so.3.4.0", "-pthread"))
    stub.reset()
    stub.update(y=8.0, ax=2.0, az=2.0)
    with pytest.MonkeyPatch.context() as patch, TouchBench(stub, patch).open() as device:

        def received() -> NDArray[np.float64]:
            journal = stub.journal()
            return rows(journal["ns"] * 1e-9, journal["force"])

        yield FarEnd(device, received, handover=2)


@contextmanager
def haply(tmp_path: Path, **keys: Any) -> Iterator[FarEnd]:
    """Inverse3 on the emulated service, which runs in another process."""
    with haply_devices.Service() as service, haply_devices.opened(service, **keys) as device:
        service.do("hand", id=haply_devices.ID, at=[0.0, 0.0, 0.008], press=0.003, drag=0.01)

        def received() -> NDArray[np.float64]:
            haply_devices.settle(device)
            return np.array(service.log())

        yield FarEnd(device, received, handover=2, hush=lambda: service.set(mute=True))


class RecordingFirmware(Firmware):
    """A 2DIY that records every command."""

    def __init__(self) -> None:
        super().__init__()
        self.sent_torques = Timed()

    def give(self, torques: list[float]) -> None:
        super().give(torques)
        self.sent_torques.append(tuple(self.torques))


@contextmanager
def two_diy(tmp_path: Path, **keys: Any) -> Iterator[FarEnd]:
    """Haply 2DIY on a pseudo terminal, with its fingertip in the floor; its motors receive N m."""
    firmware = RecordingFirmware()
    with (
        Port(firmware) as port,
        described_boards.opened("haply-2diy", port.path, **{"timeout_s": 2.0, **keys}) as device,
    ):
        firmware.angles = [142.0, 38.0]

        def received() -> NDArray[np.float64]:
            written = device.counts()["written"]
            described_boards.settled(
                lambda: firmware.commands,
                lambda written_bytes: written_bytes >= written or at_rest(lambda: firmware.commands),
            )
            return rows(firmware.sent_torques.times, firmware.sent_torques)

        yield FarEnd(device, received, most=2.0 * TORQUE_MAX, hush=port.mute.set)


@contextmanager
def hapkit(tmp_path: Path, **keys: Any) -> Iterator[FarEnd]:
    """Hapkit with its sketch on a pseudo terminal, in the floor, with a trembling hand; its motor receives N m. Its log
    contains only changes."""
    with (
        Hapkit(sketch_library()) as sketch,
        described_boards.opened("hapkit", sketch.path, **{"timeout_s": 2.0, **keys}) as device,
    ):
        sketch.turn(0.094)

        def tremble() -> None:
            sketch.turn(0.094 + 0.004 * np.sin(12.0 * time.monotonic()))

        def received() -> NDArray[np.float64]:
            described_boards.settled(sketch.torque, lambda torque: torque == 0.0)
            return rows(*zip(*sketch.changes(), strict=True))

        with repeated(tremble, every_s=0.002):
            yield FarEnd(device, received, most=0.03, hush=sketch.hush)


@cache
def sketch_library() -> Path:
    """Return the Hapkit's sketch, compiled at the first call; skip the test if there is no compiler."""
    if CXX is None:
        pytest.skip(NO_CXX)
    return compile_sketch(Path(folder().name) / "hapkit.so")


FAR_ENDS = {
    "replay": pressed_replay, "simulated": simulated_hand, "serial": serial_board, "hid": hid_arm, "falcon": falcon,
    "forcedimension": force_dimension, "openhaptics": open_haptics, "haply": haply, "haply-2diy": two_diy,
    "hapkit": hapkit,
}  # fmt: skip
"""Functions by driver, or by rig for boards described by a rig."""
