"""A SpaceMouse as a device: its puck moves the fingertip, and no force comes back.

For looking at a scene without a haptic device: contact, forces and modes are in telemetry, and what is written is
kept as a replay keeps it. The C functions share a block of int64 words with Python, the device's handle.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from typing import Any, Final

import numpy as np
from numba import carray

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.drivers import discovery, wrench_log
from softfinger.drivers.base import (
    LOST,
    OK,
    PROTOCOL,
    SAMPLE_BUTTONS,
    SAMPLE_GRIPPER,
    SAMPLE_TIME,
    STALE,
    Device,
    DeviceInfo,
    DeviceIO,
)
from softfinger.drivers.claims import PUCKS
from softfinger.drivers.discovery import Attached
from softfinger.drivers.hidraw import open_path
from softfinger.drivers.libc import EAGAIN, EINTR, IO_SIGNATURE, TIMESPEC_WORDS, errno_location, monotonic_ns, read_fd
from softfinger.drivers.puck import BUTTONS, REPORT_MAX, Options, Setup, decode, make_setup, move
from softfinger.drivers.replay import DAMPING_MAX_NS_PER_M, FORCE_MAX_N, STIFFNESS_MAX_N_PER_M, TORQUE_MAX_NM
from softfinger.drivers.wrench_log import READS, WrenchLog, Written
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import float64_at, int64_at, uint8_at
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.pack import flatten, unpack

# Words of the block behind the handle, after those of the log.
FD: Final = wrench_log.WORDS
HEARD_AT: Final = FD + 1  # ns, when the puck last reported its deflection
MOVED_AT: Final = FD + 2  # ns, up to when the fingertip has been moved
HOLD: Final = FD + 3  # ns without a report after which the puck counts as let go
REPORTS: Final = FD + 4  # reports received
FOREIGN: Final = FD + 5  # of these, of other kinds (a wireless puck tells its battery)
SETUP: Final = FD + 6  # addresses, from here on
STATE: Final = FD + 7  # (STATE_SIZE,) float64
BUFFER: Final = FD + 8
TIMESPEC: Final = FD + 9
WORDS: Final = TIMESPEC + TIMESPEC_WORDS

# Places in the state.
POSITION: Final = 0
ORIENTATION: Final = 3
TIME: Final = 7  # s of motion so far
MASK: Final = 8  # buttons
DEFLECTION: Final = 9  # (6,) counts
STATE_SIZE: Final = 15

DRAIN_MAX: Final = 256
"""Reports taken in one tick: four times what the kernel keeps for a node."""
STEP_MAX_S: Final = 0.05
"""Most time that one read moves the fingertip over: after a pause it goes on, and does not jump."""

_ZERO: Final = (0.0, 0.0, 0.0)
SETUP_LIKE: Final = Setup(0.0, _ZERO, _ZERO, _ZERO, _ZERO)
SETUP_SIZE: Final = len(flatten(SETUP_LIKE))

LED_ON: Final = b"\x04\x01"
LED_OFF: Final = b"\x04\x00"


@jit
def _drain(handle: int, now: int) -> int:
    """Take every report that is there; OK if one said something, STALE if none came, or a status below 0."""
    word = int64_at(handle)
    state = word[STATE]
    status = STALE
    for _ in range(DRAIN_MAX):
        count = read_fd(word[FD], word[BUFFER], REPORT_MAX)
        if count < 0:
            error = errno_location()[0]
            if error == EINTR:
                continue
            return status if error == EAGAIN else LOST
        if count == 0:
            return LOST
        word[REPORTS] += 1
        report = uint8_at(word[BUFFER])
        said = decode(report, count, float64_at(state + DEFLECTION * 8), float64_at(state + MASK * 8))
        if said == PROTOCOL:
            return PROTOCOL
        if said == STALE:
            word[FOREIGN] += 1
            continue
        status = OK
        if report[0] != BUTTONS:
            word[HEARD_AT] = now
    return status


@jit
def place(handle: int) -> tuple[Vec3, Quaternion]:
    """Where the puck has moved to: position (3,) m and orientation."""
    state = float64_at(int64_at(handle)[STATE])
    return (state[0], state[1], state[2]), (state[3], state[4], state[5], state[6])


@jit
def mask(handle: int) -> float:
    """Its buttons, a bit each."""
    return float(float64_at(int64_at(handle)[STATE])[MASK])


@jit
def follow(handle: int, setup: Setup, now: int, dt: float) -> int:
    """Take the puck's reports and move the fingertip for `dt` (s); the status of the puck."""
    word = int64_at(handle)
    if word[FD] < 0:
        return LOST
    status = _drain(handle, now)
    if status < 0:
        return status
    state = float64_at(word[STATE])
    deflection = float64_at(word[STATE] + DEFLECTION * 8)
    if now - word[HEARD_AT] > word[HOLD]:
        for k in range(6):
            deflection[k] = 0.0
    before, turned = place(handle)
    position, orientation = move(setup, before, turned, deflection, dt)
    for k in range(3):
        state[POSITION + k] = position[k]
    for k in range(4):
        state[ORIENTATION + k] = orientation[k]
    state[TIME] += dt
    return status


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    now = monotonic_ns(handle + TIMESPEC * 8)
    dt = min((now - word[MOVED_AT]) * 1e-9, STEP_MAX_S)
    word[MOVED_AT] = now
    status = follow(handle, unpack(SETUP_LIKE, carray(float64_at(word[SETUP]), (SETUP_SIZE,))), now, dt)
    if status < 0:
        return status
    word[READS] += 1
    state = float64_at(word[STATE])
    for k in range(7):
        sample[k] = state[k]
    sample[SAMPLE_TIME] = state[TIME]
    sample[SAMPLE_BUTTONS] = state[MASK]
    sample[SAMPLE_GRIPPER] = 0.0
    return OK  # a puck at rest is silent: where the fingertip stays is a new sample all the same


class Puck:
    """An open puck on the file descriptor `fd` of its node, which it owns from now on.

    `word` is the block of whoever reads it, at least WORDS long.
    """

    def __init__(self, options: Options, fd: int, word: np.ndarray[Any, np.dtype[np.int64]]) -> None:
        self._word, self._led = word, options.led
        state = np.zeros(STATE_SIZE)
        state[POSITION : POSITION + 3], state[ORIENTATION] = options.start_m, 1.0
        self._arrays = (flatten(make_setup(options)), state, np.zeros(REPORT_MAX, np.uint8))
        word[SETUP : BUFFER + 1] = [array.ctypes.data for array in self._arrays]
        word[FD] = fd
        word[HOLD] = round(options.hold_s * 1e9)
        word[MOVED_AT] = word[HEARD_AT] = time.monotonic_ns()
        self._light(LED_ON)

    def close(self) -> None:
        """Lamp off, node released. Any number of times, but not while the loop reads."""
        fd = int(self._word[FD])
        if fd >= 0:
            self._light(LED_OFF)
            self._word[FD] = -1
            os.close(fd)

    def counts(self) -> dict[str, int]:
        """Reports received, and those of them that were of other kinds."""
        return {"reports": int(self._word[REPORTS]), "foreign": int(self._word[FOREIGN])}

    def _light(self, report: bytes) -> None:
        if self._led:
            with contextlib.suppress(OSError):  # some have no lamp, and one that is gone needs none
                os.write(int(self._word[FD]), report)


class SpaceMouse(Device):
    """The puck's fingertip as a device. What is written goes nowhere, and is kept as a replay keeps it."""

    def __init__(self, options: Options, fd: int, rate_hz: float, name: str = "puck") -> None:
        self._word = np.zeros(WORDS, dtype=np.int64)
        self._log = WrenchLog(self._word, 0, rate_hz, None)
        self._puck = Puck(options, fd, self._word)
        x0, y0, z0 = (float(a) for a in options.workspace_min_m)
        x1, y1, z1 = (float(a) for a in options.workspace_max_m)
        # It displays no force, so it limits none: the rig's guard does, and telemetry has the force that a hand
        # would feel.
        self.info = DeviceInfo(
            name=f"spacemouse {name}",
            sensed_dof=6,
            actuated_dof=0,
            force_max_n=FORCE_MAX_N,
            torque_max_nm=TORQUE_MAX_NM,
            stiffness_max_n_per_m=STIFFNESS_MAX_N_PER_M,
            damping_max_ns_per_m=DAMPING_MAX_NS_PER_M,
            workspace_min_m=(x0, y0, z0),
            workspace_max_m=(x1, y1, z1),
        )

    def io(self) -> DeviceIO:
        return DeviceIO(read.address, wrench_log.write.address, self._word.ctypes.data)

    def stop(self) -> None:
        self._log.stop()

    def close(self) -> None:
        self._log.close()
        self._puck.close()

    def counts(self) -> dict[str, int]:
        return self._log.counts() | self._puck.counts()

    def written(self) -> Written:
        """The wrenches kept, oldest first. While the servo runs: those that were complete just now."""
        return self._log.written()


def open_puck(options: Options) -> tuple[int, str]:
    """File descriptor and name of the puck that the options name, or of the only one attached.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError when the node is no puck's.
    """
    if not sys.platform.startswith("linux"):
        raise DeviceError(f"a SpaceMouse is read through Linux's hidraw, and this is {sys.platform}")
    found = find(options)
    return open_path(found.node, found.vendor, found.product), found.name


def find(options: Options) -> Attached:
    """The one puck that the options fit; DeviceNotFound when there is none or more than one."""
    nodes = list(discovery.hidraw_nodes())
    if options.path is not None:
        # a node that the tables do not have is said to be absent, or no node, when it is opened
        return next(
            (one for one in nodes if one.node == options.path), Attached("hid", *PUCKS[0], "", "", options.path)
        )
    pucks = [one for one in nodes if (one.vendor, one.product) in PUCKS]
    fitting = [one for one in pucks if options.serial in (None, one.serial)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        listed = ", ".join(f"{one.node} (serial '{one.serial}')" for one in fitting)
        raise DeviceNotFound(f"{len(fitting)} pucks are attached: name one with serial or path: {listed}")
    others = ", ".join(map(str, pucks or nodes)) or "no HID device"
    asked = f" with serial = '{options.serial}'" if options.serial is not None else ""
    raise DeviceNotFound(f"no SpaceMouse{asked} is attached: plug it in; attached are: {others}")


def open_device(options: Options, rate_hz: float) -> SpaceMouse:
    """Open the puck a rig names; DeviceError and its kinds when it cannot be used."""
    fd, name = open_puck(options)
    return SpaceMouse(options, fd, rate_hz, name)
