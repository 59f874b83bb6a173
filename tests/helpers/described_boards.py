"""A Haply 2DIY and a Hapkit, each on a pseudo terminal, for tests of boards described by a rig."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from emulators.haply2diy import Firmware, place

from helpers.rig_files import rig_options
from helpers.waits import WAIT_S, eventually
from softfinger.drivers.serial.device import SerialDevice, open_device

PATIENT = {"quiet_s": 0.1, "timeout_s": 0.5}
"""Time limits for a busy machine, on which a thread may answer late."""
REST = (150.0, 30.0)
"""Angles (degrees) of a 2DIY's links in the middle of its workspace."""
TO_WORLD = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
"""Axes of the shipped 2DIY rig: towards the user is down."""


def opened(rig: str, path: str, **changes: Any) -> SerialDevice:
    return open_device(rig_options(rig, **{"path": path, **PATIENT, **changes}), 1000.0)


def settled(value: Callable[[], Any], wanted: Callable[[Any], bool], within_s: float = WAIT_S) -> Any:
    """Wait until a value is as wanted, at most `within_s`; return its last value."""
    eventually(lambda: wanted(value()), within_s, 0.0005)
    return value()


def lower(board: Firmware) -> None:
    """Move a 2DIY's handle from 64 mm above the floor until a fingertip of 10 mm is 4 mm deep, slower than 10 m/s."""
    for share in np.linspace(0.0, 1.0, 200):
        board.angles = [168.0 - 26.0 * share, 12.0 + 26.0 * share]
        time.sleep(0.002)


def force_of(board: Firmware) -> np.ndarray:
    """Return the force (3,) N on the hand in the world, from the present torques of a 2DIY."""
    return force_at(board.angles, board.torques)


def force_at(angles: Sequence[float], torques: Sequence[float]) -> np.ndarray:
    """Return the force (3,) N of torques (N m, ports 1 and 2) at angles (degrees): J^-T tau, with J by differences."""
    h = 1e-4  # degrees
    first, two = angles
    columns = [
        (np.subtract(place(first + h, two), place(first - h, two))) / np.radians(2 * h),
        (np.subtract(place(first, two + h), place(first, two - h))) / np.radians(2 * h),
    ]
    x, y = np.linalg.solve(np.array(columns), (torques[1], torques[0]))  # link 1 is on port 2
    return TO_WORLD @ np.array([x, y, 0.0])
