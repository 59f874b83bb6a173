"""Rig files that name the emulated device of every driver.

For programs that open a device themselves; `far_ends` has open devices. Received forces are in N on the hand, with
times. Simulated and replayed devices have no emulated counterpart.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from emulators.hapkit import HANDLE_M, PULLEY_M, SECTOR_M, Hapkit
from emulators.haply2diy import Port
from emulators.serialboard import Board, Cable
from numpy.typing import NDArray

from helpers import haply_devices, usb_stub
from helpers.c_stub import compiled
from helpers.described_boards import force_at, lower
from helpers.drd_stub import SOURCE as DRD
from helpers.drd_stub import Stub
from helpers.far_ends import RecordingFirmware, Timed, rows, sketch_library
from helpers.hd_stub import SOURCE as HD
from helpers.hd_stub import HdStub
from helpers.hid_devices import woody
from helpers.rig_files import write_rig

Array = NDArray[np.float64]

PATIENT = {"quiet_s": 0.2, "timeout_s": 1.0}
"""Time limits for a busy machine, on which a thread may answer late."""
PRESS_TICKS = 200
"""Time in which the hand of a board moves into the floor: slower than the limit of a pose jump."""


class Far(NamedTuple):
    """Emulated device of a rig.

    rig           file of the rig
    device        controlled by tests: stub, service, board or its port
    forces_since  received forces from that index on (-1: the latest), in order (n, 4): s (monotonic clock), N
    press         put the hand some millimetres into a floor at z = 0
    unplug        pull the cable
    resolution    N, of the motors
    sees          axes of the world along which it moves
    powerless     True if the device has no force without its cable; others retain the last force
    """

    rig: str
    device: Any
    forces_since: Callable[[int], Array]
    press: Callable[[], None]
    unplug: Callable[[], None]
    resolution: float = 1e-6
    sees: str = "xyz"
    powerless: bool = False

    def newest(self) -> float:
        """Size (N) of the latest force; 0 before the first."""
        forces = self.forces_since(-1)
        return float(np.linalg.norm(forces[-1, 1:])) if len(forces) else 0.0


@contextmanager
def when_forced(
    far: Far, least_n: float, act: Callable[[], object], begin: Callable[[threading.Event], object] | None = None
) -> Iterator[list[float]]:
    """Call a function once when the device's force exceeds a limit; the yielded list then contains the time.

    begin  called first, in the same thread, with an event that is set when the block ends
    """
    times: list[float] = []
    over = threading.Event()

    def wait() -> None:
        if begin is not None:
            begin(over)
        while not over.wait(0.002):
            if far.newest() > least_n and not over.is_set():
                times.append(time.monotonic())
                act()
                return

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    try:
        yield times
    finally:
        over.set()
        thread.join()


def rig_file(folder: Path, name: str, **keys: object) -> str:
    """Write a shipped rig with changed keys of [device], without real time, whose force has risen after 50 ms."""
    file = write_rig(folder, name, **keys)
    text = file.read_text().replace('realtime = "auto"', 'realtime = "off"')
    file.write_text(re.sub(r"^ramp_s = \S+", "ramp_s = 0.05", text, flags=re.MULTILINE))
    return str(file)


def slowly(set_share: Callable[[float], None]) -> None:
    """Position of the hand, from 0 to 1, over time."""
    for share in np.linspace(0.0, 1.0, PRESS_TICKS):
        set_share(float(share))
        time.sleep(0.002)


@contextmanager
def open_haptics(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    stub = HdStub(compiled(HD, "libHD.so.3.4.0", "-pthread"))
    stub.reset()

    def forces_since(first: int) -> Array:
        journal = stub.journal()[first:]
        return rows(journal["ns"] * 1e-9, journal["force"])

    rig = rig_file(folder, "touch", library_file=str(stub.path), force_age_max_s=0.1)
    yield Far(rig, stub, forces_since, lambda: stub.update(y=8.0), lambda: stub.update(unplugged=1), powerless=True)
    stub.reset()


@contextmanager
def force_dimension(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    stub = Stub(compiled(DRD, "libdrd.so.3.17.5"))
    stub.reset()
    rig = rig_file(folder, "omega-3", library_file=str(stub.path), watchdog_s=0.0)
    unplug = lambda: stub.update(unplugged=1)  # noqa: E731
    yield Far(rig, stub, lambda first: stub.log()[first:], lambda: stub.update(z=0.008), unplug, powerless=True)
    stub.reset()


@contextmanager
def falcon(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    rig = rig_file(folder, "falcon", counts_per_nm=10000.0, kick_s=0.15, timeout_s=2.0)
    with usb_stub.attached() as stub:
        stub["logged"] = 0

        def forces_since(first: int) -> Array:
            times = stub.times()
            return rows(times[first:], stub.log()[: len(times)][first:, :3])

        def unplug() -> None:
            stub["unplugged"] = 1

        def press() -> None:
            stub["z"] = 0.008

        yield Far(rig, stub, forces_since, press, unplug, usb_stub.FalconBench.force_step_n)
        assert (stub["misuse"], stub["flying"], stub["allocated"]) == (0, 0, 0) and stub["opens"] == stub["closes"]


@contextmanager
def hid(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    """The arm has no device node: the driver gets its file descriptor from here."""
    place = [(0.01, 0.02, 0.03)]
    with woody(intention=lambda _: place[0], timeout_s=2.0) as (device, arm, answering):
        arm.sent = sent = Timed()
        for opener in ("softfinger.tools.doctor.report.open_device", "softfinger.drivers.registry.open_device"):
            patch.setattr(opener, lambda *_: device)

        def forces_since(first: int) -> Array:
            amperes = np.array(list(sent)[first:], float).reshape(-1, 7)[:, :3] * 1e-3
            forces = np.array([arm.arm.force(arm.place, tuple(row)) for row in amperes]).reshape(-1, 3)
            return rows(sent.times[first:][: len(forces)], forces)

        def press() -> None:
            place[0] = (0.0, 0.0, 0.006)

        # half a milliampere in each of three motors
        rig = rig_file(folder, "woodenhaptics-2019", timeout_s=2.0)
        yield Far(rig, answering, forces_since, press, answering.unplug, 0.01)


@contextmanager
def haply(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    with haply_devices.Service() as service:
        service.do("hand", id=haply_devices.ID, at=[0.0, 0.0, 0.03], press=0.0, drag=0.0)

        def forces_since(first: int) -> Array:
            return np.array([[0.0, *service.force()]] if first == -1 else service.log()[first:]).reshape(-1, 4)

        def press() -> None:
            service.do("hand", id=haply_devices.ID, at=[0.0, 0.0, 0.008], press=0.0, drag=0.0)

        def unplug() -> None:
            service.do("vanish", id=haply_devices.ID)

        rig = rig_file(folder, "haply-inverse3", port=service.port, stale_s=0.2, **PATIENT)
        yield Far(rig, service, forces_since, press, unplug, powerless=True)


@contextmanager
def serial(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    place = [(0.01, 0.02, 0.03)]
    with Cable(Board(lambda _: place[0])) as cable:
        cable.board.sent = sent = Timed()

        def forces_since(first: int) -> Array:
            forces = np.array(list(sent)[first:], float).reshape(-1, 7)[:, :3] * 1e-3
            return rows(sent.times[first:][: len(forces)], forces)

        def press() -> None:
            place[0] = (0.0, 0.0, 0.006)

        rig = rig_file(folder, "woodenhaptics-v3", path=cable.path, **PATIENT)
        yield Far(rig, cable, forces_since, press, cable.pull, 1e-3)


@contextmanager
def two_diy(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    board = RecordingFirmware()
    with Port(board) as port:

        def forces_since(first: int) -> Array:
            forces = [force_at(board.angles, torques) for torques in list(board.sent_torques)[first:]]
            return rows(board.sent_torques.times[first:][: len(forces)], np.array(forces).reshape(-1, 3))

        rig = rig_file(folder, "haply-2diy", path=port.path, **PATIENT)
        yield Far(rig, port, forces_since, partial(lower, board), port.pull, 1e-6, "xz", powerless=True)


@contextmanager
def hapkit(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    with Hapkit(sketch_library()) as board:
        board.turn(0.3)

        def forces_since(first: int) -> Array:
            changes = np.array(board.changes()[first:]).reshape(-1, 2)
            per_torque = SECTOR_M / PULLEY_M / HANDLE_M
            return np.column_stack([changes[:, 0], np.zeros((len(changes), 2)), changes[:, 1] * per_torque])

        def press() -> None:  # encoder counts start at the position in which the board was started
            slowly(lambda share: board.turn(0.3 - 0.25 * share))

        # a duty cycle of 1/255 gives 0.03 N m duty^2; at 0.2 N the duty is 0.2
        yield Far(
            rig_file(folder, "hapkit", path=board.path, **PATIENT), board, forces_since, press, board.pull, 0.01, "z"
        )


FAR_RIGS: dict[str, Callable[[Path, pytest.MonkeyPatch], Any]] = {
    "openhaptics": open_haptics, "haply": haply, "haply-2diy": two_diy, "hapkit": hapkit, "serial": serial,
    "forcedimension": force_dimension, "falcon": falcon, "hid": hid,
}  # fmt: skip
"""Functions by driver, or by rig for boards described by a rig."""
