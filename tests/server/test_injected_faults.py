"""Faults injected between every driver and the loop: what the device was given, what was told, and how it went on.

What is asserted of forces is what the device's far end has received: the log of a replay and of a simulated handle, the
frames of a board, the reports of an arm. One scene, so one loop is compiled, of 20 s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.hid_devices import woody
from helpers.injected_run import FROZEN_S, RAMP_S, Seen, run
from helpers.serial_devices import board, settle

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout, SafetyStop
from softfinger.config.load import build
from softfinger.drivers.base import Device
from softfinger.drivers.replay import device as replay
from softfinger.drivers.simulated import device as simulated
from softfinger.proxy.record import AT
from softfinger.server.loop.health import HELD_MAX_S, SILENCE_MAX_S, STALL_POLL_S, STALL_POLLS

pytestmark = pytest.mark.real_time

RATE_HZ = 1000.0
FORCE_MAX_N = 12.0
"""Of the rig."""
STEP_N = 2.0
"""The slew limit's change in a tick, at 1 kHz."""
TOUCH_N = 0.1
"""Less than any of these hands presses with, once the ramp is over."""
RAMP_TICKS = round(RAMP_S * RATE_HZ)
AFTER = 150
"""Ticks behind the fault: the ramp, and what shows that the force is there again."""
PRESSED_S = 0.01
FULL_N = 1.2
"""No less than the replay presses with: 1 N, and 0.6 times that of friction."""
MOMENTS = {"first": 0, "ramp": RAMP_TICKS // 2, "contact": 100}


class Case(NamedTuple):
    """A fault, and what is to come of it.

    fault   without its tick
    lasts   ticks that it lasts
    event   told by name; empty: none is
    zero    within how many ticks of it the device has zero, None: it keeps a force, within the guard's limits
    ends    the error that the run ends with; None: it goes on, and the force comes back
    within  ticks until that end
    """

    fault: dict[str, Any]
    lasts: int = 1
    event: str = ""
    zero: int | None = None
    ends: type[Exception] | None = None
    within: int = 1


STALLED = round(RATE_HZ * STALL_POLL_S * (STALL_POLLS + 2))
"""A look may come just before the last tick, and one more until the zero is written."""
SILENT = round(RATE_HZ * SILENCE_MAX_S) + 2
HELD = round(RATE_HZ * HELD_MAX_S) + 2
FROZEN = round(RATE_HZ * FROZEN_S)

CASES = {
    "stale": Case({"kind": "stale"}, 20),
    "stale for long": Case({"kind": "stale"}, 2 * FROZEN, "pose_frozen", zero=FROZEN + FROZEN // 5),
    "frozen": Case({"kind": "frozen"}, 20),
    "frozen for long": Case({"kind": "frozen"}, 2 * FROZEN, "pose_frozen", zero=FROZEN + FROZEN // 5),
    "nan": Case({"kind": "nan", "number": "y"}, 3, "pose_refused", zero=0),
    "nan rotation": Case({"kind": "nan", "number": "qw"}, 1, "pose_refused", zero=0),
    "nan for long": Case({"kind": "nan"}, 900, "pose_refused", 0, DeviceError, SILENT),
    "infinite": Case({"kind": "infinite", "number": "z"}, 2, "pose_refused", zero=0),
    "short": Case({"kind": "short", "numbers": 3}, 5, "pose_refused", zero=0),
    "teleport": Case({"kind": "teleport", "offset_m": [0.0, 0.0, -0.9]}, 1, "pose_jumped", zero=0),
    "jumping": Case({"kind": "teleport", "offset_m": [0.9, 0.0, 0.0], "every_ticks": 2}, 40, "pose_jumped", 0,
                    DeviceError, 20),
    "corrupt": Case({"kind": "corrupt", "every_ticks": 50}, 100),
    "bounce": Case({"kind": "bounce"}, 20),
    "slow read": Case({"kind": "slow", "block_s": 0.01}, 3, "missed"),
    "slow write": Case({"kind": "slow", "block_s": 0.01, "on": "write"}, 3, "missed"),
    "hang": Case({"kind": "slow", "block_s": 0.6}, 1, "stalled", STALLED, SafetyStop, 3),
    "disconnect": Case({"kind": "disconnect"}, 100, "", 0, DeviceLost),
    "timeout": Case({"kind": "timeout"}, 1, "", 0, DeviceTimeout),
    "timeout write": Case({"kind": "timeout", "on": "write"}, 1, "", 1, DeviceTimeout),
    "protocol": Case({"kind": "protocol"}, 1, "", 0, DeviceLost),
    "protocol write": Case({"kind": "protocol", "on": "write"}, 1, "", 1, DeviceLost),
    "force off": Case({"kind": "force_off"}, 1, "", 0, SafetyStop),
    "withheld": Case({"kind": "withheld"}, 20, "ramping", zero=0),
    "held": Case({"kind": "held"}, 20),
    "held for long": Case({"kind": "held"}, 400, "", HELD, DeviceTimeout, HELD),
    "swallowed": Case({"kind": "swallowed"}, 20),
}  # fmt: skip

Received = Callable[[], np.ndarray]
"""Forces (n, 3) N that the far end of a device was given, in their order."""


@contextmanager
def pressed_replay(tmp_path: Path) -> Iterator[tuple[Device, Received]]:
    """A recording of a fingertip 1 mm deep in the plane that is dragged to and fro."""
    times = np.arange(0.0, 4.005, PRESSED_S)
    x = 0.005 * np.sin(0.5 * np.pi * times)
    rest = np.tile([0.0, 0.009, 1.0, 0.0, 0.0, 0.0], (len(times), 1))
    path = tmp_path / "pressed.csv"
    np.savetxt(path, np.column_stack([times, x, rest]), delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    device = replay.open_device(build(replay.Options, {"recording": str(path)}, "[device]"), RATE_HZ)
    yield device, lambda: device.written().wrench[:, :3]


@contextmanager
def simulated_hand(tmp_path: Path) -> Iterator[tuple[Device, Received]]:
    """A computed handle whose hand wants to be 4 mm deep, and sways."""
    hand = {"position_m": [0.0, 0.0, 0.006], "sway_m": [0.005, 0.0, 0.0], "sway_hz": 0.5}
    device = simulated.open_device(build(simulated.Options, hand, "[device]"), RATE_HZ)
    yield device, lambda: device.written().wrench[:, :3]


@contextmanager
def serial_board(tmp_path: Path) -> Iterator[tuple[Device, Received]]:
    """A board behind a pseudo terminal."""
    with board(lambda t: (0.002 * np.sin(6.0 * t), 0.0, 0.006), timeout_s=2.0) as (device, far, cable):

        def received() -> np.ndarray:
            settle(device, cable)
            return np.array(far.sent, float).reshape(-1, 7)[:, :3] * 1e-3

        yield device, received


@contextmanager
def hid_arm(tmp_path: Path) -> Iterator[tuple[Device, Received]]:
    """An arm behind a packet socket; what its motors are given is in mA, which is a force to some factor."""
    with woody(intention=lambda t: (0.002 * np.sin(6.0 * t), 0.0, 0.006), timeout_s=2.0) as (device, arm, answering):

        def received() -> np.ndarray:
            answering.settle(device)
            return np.array(arm.sent, float)[:, :3] * 1e-3

        yield device, received


DRIVERS = {"replay": pressed_replay, "simulated": simulated_hand, "serial": serial_board, "hid": hid_arm}


def injected(driver: Any, name: str, at: int, tmp_path: Path) -> tuple[Seen, np.ndarray]:
    case = CASES[name]
    fault = case.fault | {"at_tick": at, "ticks": case.lasts}
    with driver(tmp_path) as (device, received):
        seen = run(device, [fault], at + case.lasts + AFTER, RATE_HZ, tmp_path)
        return seen, received()


def check_end(name: str, at: int, seen: Seen) -> None:
    """How it ended, what was told, and that the recording has every tick."""
    case = CASES[name]
    if case.ends is None:
        assert seen.error is None, seen.error
        assert seen.ticks == at + case.lasts + AFTER
    else:
        assert type(seen.error) is case.ends, seen.error
        assert case.fault["kind"] in str(seen.error) or case.event == "stalled"
        assert at <= seen.ticks <= at + case.within
    if case.event:
        assert case.event in seen.events
    assert seen.recorded[:, AT.tick].tolist() == list(range(seen.ticks))


def check_limits(forces: np.ndarray) -> np.ndarray:
    """No wrench above the guard's limit, none that is more than a tick's change from the one before, the last one zero;
    returns their norms."""
    norms: np.ndarray = np.linalg.norm(forces, axis=1)
    assert norms.max() <= FORCE_MAX_N
    assert norms[-1] == 0.0
    steps = np.linalg.norm(np.diff(forces, axis=0, prepend=np.zeros((1, 3))), axis=1)
    assert np.all((steps <= STEP_N * (1.0 + 1e-9)) | (norms == 0.0))  # rounding; and zero is never refused
    return norms


@pytest.mark.parametrize(
    "moment", [pytest.param(each, marks=[pytest.mark.exhaustive] * (each == "first")) for each in MOMENTS]
)
@pytest.mark.parametrize("name", CASES)
def test_an_injected_fault_leaves_no_force_that_it_may_not(name: str, moment: str, tmp_path: Path) -> None:
    """Of a replay, whose log has each wrench that it was given: zero within the ticks that are stated, else within the
    guard's limits; the fault is told by name, the run ends with its error or goes on with a force that fades in, and no
    tick of the recording is lost."""
    case, at = CASES[name], MOMENTS[moment]
    seen, forces = injected(pressed_replay, name, at, tmp_path)
    check_end(name, at, seen)
    norms = check_limits(forces)
    if case.zero is not None:
        # A first pose is never a jump, the next one is.
        late = int(at == 0 and case.event == "pose_jumped")
        assert norms[at : at + case.zero + late + 1].min() == 0.0
    if case.event == "pose_refused" or case.fault["kind"] == "withheld":
        assert not norms[at : min(at + case.lasts, seen.ticks)].any()
    if case.ends is None:
        if case.zero is not None:
            assert norms[at + case.lasts] <= FULL_N * 2.0 / RAMP_TICKS
        assert norms[-AFTER // 2 : -2].min() > TOUCH_N  # the hand still presses, and feels it
    else:
        assert len(norms) <= seen.ticks + 2  # a tick that failed may have been written, and the zero of the stop


OTHERS = ("stale", "nan", "teleport", "withheld", "held for long", "disconnect", "force off", "timeout write")


@pytest.mark.parametrize("driver", ["simulated", "serial", "hid"])
@pytest.mark.parametrize("name", OTHERS)
def test_on_every_driver(name: str, driver: str, tmp_path: Path) -> None:
    """The same of a computed handle, a board and an arm, whose far ends have heard these wrenches: never more than the
    guard allows, a zero where one is due, and zero in the end, past a fault that keeps it off the way of every tick."""
    case, at = CASES[name], 200
    seen, forces = injected(DRIVERS[driver], name, at, tmp_path)
    check_end(name, at, seen)
    norms = np.linalg.norm(forces, axis=1)
    assert norms.max() <= FORCE_MAX_N
    assert norms[-1] == 0.0
    pressed = np.flatnonzero(norms > TOUCH_N * norms.max())
    assert len(pressed) > 20, "the hand never pressed"
    if case.ends is None and case.zero is not None:
        assert (norms[pressed[0] : pressed[-1]] == 0.0).any()
