"""Emulated devices of every driver, and the forces that they received, in N on the hand, with their times.

FAR_RIGS have rig files, for programs that open a device themselves. FAR_ENDS have open devices whose hands press into
the paper's plane and move; also simulated and replayed devices, which have no emulated counterpart.
"""

import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from emulators.hapkit import COMPILER as CXX
from emulators.hapkit import HANDLE_M, PULLEY_M, SECTOR_M, Hapkit, compile_sketch
from emulators.hapkit import NO_COMPILER as NO_CXX
from emulators.haply2diy import Firmware, Port
from emulators.serialboard import Board, Cable
from numpy.typing import NDArray

from helpers import haply_devices, usb_stub
from helpers.c_stub import compiled, folder
from helpers.described_boards import force_at, lower, settled
from helpers.drd_stub import SOURCE as DRD
from helpers.drd_stub import Stub
from helpers.hd_stub import SOURCE as HD
from helpers.hd_stub import HdStub
from helpers.hid_devices import woody
from helpers.rig_files import write_rig
from helpers.waits import repeated
from softfinger.config.load import build, load_rig
from softfinger.drivers import registry
from softfinger.drivers.base import Device
from softfinger.drivers.replay import device as replay
from softfinger.drivers.simulated import device as simulated

Array = NDArray[np.float64]

RATE_HZ = 1000.0
PATIENT = {"quiet_s": 0.2, "timeout_s": 1.0}
"""Time limits for a busy machine, on which a thread may answer late."""
PRESS_TICKS = 200
"""Time in which the hand of a board moves into the floor: slower than the limit of a pose jump."""
PRESSED_S = 0.01
"""Time between the poses of the recording."""


class Far(NamedTuple):
    """Emulated device of a rig.

    rig           file of the rig
    device        controlled by tests: stub, service, board or its port
    forces_since  received forces from that index on (-1: the latest), in order (n, 4): s (monotonic clock), N
    press         put the hand some millimetres into a floor at z = 0, where most hands move
    unplug        pull the cable
    resolution    N, of the motors
    sees          axes of the world along which it moves
    part          part of a force (N) that its motors can display
    powerless     True if the device has no force without its cable; others retain the last force
    handover      ticks until a force reaches the motors
    withholds     whether the driver sends zero if its answers are not read
    hush          makes the device receive without answering; None if it has no such fault
    tremble       moves a hand that `press` leaves at rest
    frames        number of received frames, without conversion of their forces: polled, that would delay the emulator
    """

    rig: str
    device: Any
    forces_since: Callable[[int], Array]
    press: Callable[[], object]
    unplug: Callable[[], object]
    resolution: float = 1e-6
    sees: str = "xyz"
    part: Callable[[Sequence[float]], tuple[float, ...]] = tuple
    powerless: bool = False
    handover: int = 1
    withholds: bool = False
    hush: Callable[[], object] | None = None
    tremble: Callable[[], AbstractContextManager[object]] = nullcontext
    frames: Callable[[], int] | None = None

    def count_frames(self) -> int:
        return len(self.forces_since(0)) if self.frames is None else self.frames()

    def newest(self) -> float:
        """Size (N) of the latest force; 0 before the first."""
        forces = self.forces_since(-1)
        return float(np.linalg.norm(forces[-1, 1:])) if len(forces) else 0.0


class FarEnd(NamedTuple):
    """An open device and the forces it received.

    received  after closing, the forces in order (n, 4): as `Far.forces_since`, or without times (NaN) if row k is that
              of tick k
    so_far    the same, before that
    others    as in `Far`
    """

    device: Device
    received: Callable[[], Array]
    so_far: Callable[[], Array]
    handover: int = 1
    withholds: bool = False
    hush: Callable[[], object] | None = None


def rows(times: Any, forces: Any) -> Array:
    """Return received forces from times (n,) and forces (n, 3)."""
    return np.column_stack([times, np.array(forces, float).reshape(-1, 3)])


def rows_from(first: int, times: list[float], elements: list[Any], force_of: Callable[[Any], Any]) -> Array:
    """Return received forces from that element on."""
    forces = [force_of(element) for element in elements[first:]]
    return rows(times[first:][: len(forces)], forces)


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


class Hand:
    """Intention of an emulated hand: at rest until it presses, then 4 mm deep and moving back and forth."""

    is_pressing = False

    def __call__(self, t: float) -> tuple[float, float, float]:
        return (0.002 * np.sin(6.0 * t), 0.0, 0.006) if self.is_pressing else (0.01, 0.02, 0.03)

    def press(self) -> None:
        self.is_pressing = True


@contextmanager
def open_haptics(folder: Path, patch: pytest.MonkeyPatch, **keys: Any) -> Iterator[Far]:
    stub = HdStub(compiled(HD, "libHD.so.3.4.0", "-pthread"))
    stub.reset()

    def forces_since(first: int) -> Array:
        journal = stub.journal()[first:]
        return rows(journal["ns"] * 1e-9, journal["force"])

    yield Far(
        rig_file(folder, "touch", library_file=str(stub.path), force_age_max_s=0.1, **keys), stub, forces_since,
        lambda: stub.update(y=8.0, ax=2.0, az=2.0), lambda: stub.update(unplugged=1), powerless=True, handover=2,
    )  # fmt: skip
    stub.reset()


@contextmanager
def force_dimension(folder: Path, patch: pytest.MonkeyPatch, **keys: Any) -> Iterator[Far]:
    stub = Stub(compiled(DRD, "libdrd.so.3.17.5"))
    stub.reset()
    yield Far(
        rig_file(folder, "omega-3", library_file=str(stub.path), watchdog_s=0.0, **keys), stub,
        lambda first: stub.log()[first:], lambda: stub.update(z=0.008, ax=0.002, ay=0.002),
        lambda: stub.update(unplugged=1), powerless=True,
    )  # fmt: skip
    stub.reset()


@contextmanager
def falcon(folder: Path, patch: pytest.MonkeyPatch, **keys: Any) -> Iterator[Far]:
    rig = rig_file(folder, "falcon", **{"counts_per_nm": 10000.0, "kick_s": 0.15, "timeout_s": 2.0, **keys})
    with usb_stub.attached() as stub:
        stub["logged"] = 0

        def forces_since(first: int) -> Array:
            times = stub.times()
            return rows(times[first:], stub.log()[: len(times)][first:, :3])

        def press() -> None:
            stub["z"], stub["press"], stub["drag"] = 0.008, 0.003, 0.01

        yield Far(
            rig, stub, forces_since, press, partial(stub.__setitem__, "unplugged", 1),
            usb_stub.FalconBench.force_step_n, hush=partial(stub.__setitem__, "mute_at", 0),
        )  # fmt: skip
        assert (stub["misuse"], stub["flying"], stub["allocated"]) == (0, 0, 0) and stub["opens"] == stub["closes"]


@contextmanager
def hid(folder: Path, patch: pytest.MonkeyPatch, rig: str = "woodenhaptics-2019", **keys: Any) -> Iterator[Far]:
    """The arm has no device node: the driver gets its file descriptor from here."""
    hand, keys = Hand(), {"timeout_s": 2.0, **keys}
    with woody(rig, intention=hand, **keys) as (device, arm, answering):
        for opener in ("softfinger.tools.doctor.report.open_device", "softfinger.drivers.registry.open_device"):
            patch.setattr(opener, lambda *_: device)

        def force_of(words: tuple[int, ...]) -> tuple[float, ...]:
            return arm.arm.force(arm.place, (1e-3 * words[0], 1e-3 * words[1], 1e-3 * words[2]))

        # half a milliampere in each of three motors
        yield Far(
            rig_file(folder, rig, **keys), answering, lambda first: rows_from(first, arm.sent_at, arm.sent, force_of),
            hand.press, answering.unplug, 0.01, withholds=True, hush=answering.mute.set, frames=lambda: len(arm.sent),
        )  # fmt: skip


@contextmanager
def haply(folder: Path, patch: pytest.MonkeyPatch, **keys: Any) -> Iterator[Far]:
    """Inverse3 on the emulated service, which runs in another process."""
    with haply_devices.Service() as service:
        move = partial(service.do, "hand", id=haply_devices.ID)
        move(at=[0.0, 0.0, 0.03], press=0.0, drag=0.0)

        def forces_since(first: int) -> Array:
            return np.array([[0.0, *service.force()]] if first == -1 else service.log()[first:]).reshape(-1, 4)

        yield Far(
            rig_file(folder, "haply-inverse3", port=service.port, **{"stale_s": 0.2, **PATIENT, **keys}), service,
            forces_since, partial(move, at=[0.0, 0.0, 0.008], press=0.003, drag=0.01),
            partial(service.do, "vanish", id=haply_devices.ID), powerless=True, handover=2,
            hush=lambda: service.set(mute=True),
        )  # fmt: skip


@contextmanager
def serial(folder: Path, patch: pytest.MonkeyPatch, early_end: bool = False, **keys: Any) -> Iterator[Far]:
    hand = Hand()
    board = Board(hand, early_end)
    with Cable(board) as cable:
        rig = rig_file(folder, "woodenhaptics-v3", path=cable.path, **PATIENT | keys)

        def forces_since(first: int) -> Array:
            return rows_from(first, board.sent_at, board.sent, lambda words: np.multiply(words[:3], 1e-3))

        yield Far(
            rig, cable, forces_since, hand.press, cable.pull, 1e-3, hush=cable.hush, frames=lambda: len(board.sent)
        )


@contextmanager
def two_diy(folder: Path, patch: pytest.MonkeyPatch, **keys: Any) -> Iterator[Far]:
    board = Firmware()
    with Port(board) as port:

        def forces_since(first: int) -> Array:
            given = board.given[first:]
            return rows([at for at, *_ in given], [force_at(board.angles, torques) for _, *torques in given])

        yield Far(
            rig_file(folder, "haply-2diy", path=port.path, **PATIENT | keys), port, forces_since,
            partial(lower, board), port.pull, 1e-6, "xz", lambda force: (force[0], 0.0, force[2]), powerless=True,
            hush=port.mute.set, frames=lambda: len(board.given),
        )  # fmt: skip


@contextmanager
def hapkit(folder: Path, patch: pytest.MonkeyPatch, **keys: Any) -> Iterator[Far]:
    """Hapkit with its sketch. Its log contains only changes."""
    with Hapkit(sketch_library()) as board:
        slowly(lambda share: board.turn(0.3 * share))  # encoder counts start at the position of the board's start

        def forces_since(first: int) -> Array:
            changes = np.array(board.changes()[first:]).reshape(-1, 2)
            sizes = changes[:, 1] * (SECTOR_M / PULLEY_M / HANDLE_M)
            return np.column_stack([changes[:, 0], np.zeros((len(changes), 2)), sizes])

        def press() -> None:
            slowly(lambda share: board.turn(0.3 - 0.206 * share))

        def tremble() -> None:
            board.turn(0.094 + 0.004 * np.sin(12.0 * time.monotonic()))

        # a duty cycle of 1/255 gives 0.03 N m duty^2; at 0.2 N the duty is 0.2
        yield Far(
            rig_file(folder, "hapkit", path=board.path, **PATIENT | keys), board, forces_since, press, board.pull, 0.01,
            "z", lambda force: (0.0, 0.0, force[0] * np.sin(0.3) + force[2] * np.cos(0.3)),
            hush=board.hush, tremble=lambda: repeated(tremble, every_s=0.002),
            frames=lambda: board.processed() // 4,
        )  # fmt: skip


@cache
def sketch_library() -> Path:
    """Return the Hapkit's sketch, compiled at the first call; skip the test if there is no compiler."""
    if CXX is None:
        pytest.skip(NO_CXX)
    return compile_sketch(Path(folder().name) / "hapkit.so")


@contextmanager
def pressed_replay(tmp_path: Path) -> Iterator[FarEnd]:
    """Recording of a fingertip 1 mm deep in the plane, dragged back and forth."""
    times = np.arange(0.0, 4.005, PRESSED_S)
    x = 0.005 * np.sin(0.5 * np.pi * times)
    rest = np.tile([0.0, 0.009, 1.0, 0.0, 0.0, 0.0], (len(times), 1))
    path = tmp_path / "pressed.csv"
    np.savetxt(path, np.column_stack([times, x, rest]), delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    device = replay.open_device(build(replay.Options, {"recording": str(path)}, "[device]"), RATE_HZ)
    yield FarEnd(device, *2 * (lambda: logged(device),))


@contextmanager
def simulated_hand(tmp_path: Path) -> Iterator[FarEnd]:
    """Simulated handle; its hand aims at a depth of 4 mm, and sways."""
    hand = {"position_m": [0.0, 0.0, 0.006], "sway_m": [0.005, 0.0, 0.0], "sway_hz": 0.5}
    device = simulated.open_device(build(simulated.Options, hand, "[device]"), RATE_HZ)
    yield FarEnd(device, *2 * (lambda: logged(device),))


TIMELESS = ("replay", "simulated")
"""Logs of written forces without times: ticks without a write are missing."""


def logged(device: Any) -> Array:
    """Return the log of a device without an emulated counterpart."""
    forces = device.read_log().wrench[:, :3]
    return rows(np.full(len(forces), np.nan), forces)


FAR_RIGS: dict[str, Callable[..., Any]] = {
    "openhaptics": open_haptics, "haply": haply, "haply-2diy": two_diy, "hapkit": hapkit, "serial": serial,
    "forcedimension": force_dimension, "falcon": falcon, "hid": hid,
}  # fmt: skip
"""Functions by driver, or by rig for boards described by a rig."""


@contextmanager
def pressing(name: str, tmp_path: Path, **keys: Any) -> Iterator[FarEnd]:
    """Open the device of FAR_RIGS with this name and a pressing hand."""
    patient = {} if name in ("openhaptics", "forcedimension") else {"timeout_s": 2.0}
    with pytest.MonkeyPatch.context() as patch, FAR_RIGS[name](tmp_path, patch, **patient | keys) as far:
        device = registry.open_device(load_rig(far.rig).device, RATE_HZ)

        def received() -> Array:
            settled(far.newest, lambda size: size == 0.0)
            return far.forces_since(0)

        with device:
            far.press()
            with far.tremble():
                yield FarEnd(device, received, lambda: far.forces_since(0), far.handover, far.withholds, far.hush)


FAR_ENDS: dict[str, Callable[..., Any]] = {
    "replay": pressed_replay, "simulated": simulated_hand, **{name: partial(pressing, name) for name in FAR_RIGS}
}  # fmt: skip
"""Functions by driver, or by rig for boards described by a rig."""
