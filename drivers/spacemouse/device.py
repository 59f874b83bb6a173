"""SpaceMouse as a device: the puck moves the fingertip, without force feedback.

For exploring a scene without a haptic device: telemetry contains contact, forces and modes, and written wrenches are
logged.
"""

from __future__ import annotations

import contextlib
import os
import time
from errno import EAGAIN
from typing import Annotated, Any, Final, NamedTuple

from softfinger.config.errors import DeviceNotFound
from softfinger.drivers import wrench_log
from softfinger.drivers.base import (
    LOST,
    OK,
    PROTOCOL,
    SAMPLE_BUTTONS,
    SAMPLE_GRIPPER,
    SAMPLE_TIME,
    STALE,
    make_unlimited_info,
)
from softfinger.drivers.block import Block, counter, lay_out, numbers, raw_bytes, word
from softfinger.drivers.samples import store_pose
from softfinger.drivers.spacemouse.puck import (
    BUTTONS,
    REPORT_MAX,
    Options,
    PuckParameters,
    decode,
    make_parameters,
    move,
)
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import PUCKS
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.drivers.system.libc import IO_SIGNATURE, TIMESPEC_WORDS, read_monotonic_ns, read_now
from softfinger.drivers.system.nodes import open_path
from softfinger.drivers.wrench_log import LOG, LoggedDevice
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at, uint8_at
from softfinger.proxy.kernels.jit.pack import flatten, unpack_at
from softfinger.proxy.kernels.model import Quaternion, Vec3

QUEUE: Final = 64
"""Reports that the kernel queues per node; when the queue is full, it drops later reports."""
DRAIN_MAX: Final = 256
"""Maximum number of reports read in one tick: four times the kernel's queue."""
STEP_MAX_S: Final = 0.05
"""Maximum time step of a read: after a pause the fingertip resumes without a jump."""

_ZERO: Final = (0.0, 0.0, 0.0)
SETUP_LIKE: Final = PuckParameters(0.0, _ZERO, _ZERO, _ZERO, _ZERO)
SETUP_SIZE: Final = len(flatten(SETUP_LIKE))

LED_ON: Final = b"\x04\x01"
LED_OFF: Final = b"\x04\x00"


class Fields(NamedTuple):
    """Fields of a puck, after the fields of the log."""

    reports: Annotated[int, counter("reports received")]
    foreign: Annotated[int, counter("reports of other kinds, such as the battery of a wireless device")]
    fd: Annotated[int, word("file descriptor of the node, below 0 once it is closed")]
    sampled_at: Annotated[int, word("time of the last reported deflection, ns")]
    moved_at: Annotated[int, word("time up to which the motion of the fingertip is computed, ns")]
    hold: Annotated[int, word("time without a report after which the puck counts as released, ns")]
    timespec: Annotated[int, numbers("struct timespec of the clock", TIMESPEC_WORDS)]
    setup: Annotated[int, numbers("a `PuckParameters`", SETUP_SIZE)]
    pose: Annotated[int, numbers("position (m) and orientation of the fingertip", 7)]
    motion_time: Annotated[int, numbers("duration of the motion so far, s", 1)]
    buttons: Annotated[int, numbers("bit mask", 1)]
    deflection: Annotated[int, numbers("of the puck, see `decode`", 6)]
    buffer: Annotated[int, raw_bytes("a report", REPORT_MAX)]


AT: Final = lay_out(Fields, after=LOG)


@jit
def _drain(handle: int, now: int) -> int:
    """Read every queued report. Return OK if one had a deflection or buttons, STALE without one, or a status below 0.

    If the queue was full, as after minutes between opening and the first tick, the present deflection is unknown: it
    counts as zero until the next report.
    """
    at = int64_at(handle)
    deflection, buttons = float64_at(handle + 8 * AT.deflection), float64_at(handle + 8 * AT.buttons)
    status, before = STALE, at[AT.reports]
    for _ in range(DRAIN_MAX):
        count = read_now(at[AT.fd], handle + 8 * AT.buffer, REPORT_MAX)
        if count == -EAGAIN:
            break
        if count <= 0:
            return LOST
        at[AT.reports] += 1
        report = uint8_at(handle + 8 * AT.buffer)
        report_status = decode(report, count, deflection, buttons)
        if report_status == PROTOCOL:
            return PROTOCOL
        if report_status == STALE:
            at[AT.foreign] += 1
            continue
        status = OK
        if report[0] != BUTTONS:
            at[AT.sampled_at] = now
    if at[AT.reports] - before >= QUEUE:
        at[AT.sampled_at] = now - at[AT.hold] - 1
    return status


@jit
def read_setup(handle: int) -> PuckParameters:
    """Return the options of a puck, converted for kernels."""
    return unpack_at(SETUP_LIKE, handle + 8 * AT.setup)  # type: ignore[no-any-return]


@jit
def compute_pose(handle: int) -> tuple[Vec3, Quaternion]:
    """Return the fingertip's position (3,) m and orientation."""
    pose = float64_at(handle + 8 * AT.pose)
    return (pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6])


@jit
def read_buttons(handle: int) -> float:
    return float(float64_at(handle + 8 * AT.buttons)[0])


@jit
def update_pose(handle: int, setup: PuckParameters, now: int, dt: float) -> int:
    """Read the puck's reports and move the fingertip by `dt` (s); return the status of the puck."""
    at = int64_at(handle)
    if at[AT.fd] < 0:
        return LOST
    status = _drain(handle, now)
    if status < 0:
        return status
    deflection = float64_at(handle + 8 * AT.deflection)
    if now - at[AT.sampled_at] > at[AT.hold]:
        for k in range(6):
            deflection[k] = 0.0
    position, orientation = compute_pose(handle)
    position, orientation = move(setup, position, orientation, deflection, dt)
    store_pose(float64_at(handle + 8 * AT.pose), position, orientation)
    float64_at(handle + 8 * AT.motion_time)[0] += dt
    return status


@c_function(IO_SIGNATURE, on_demand=True)  # the simulated device imports this module, but not `read`
def read(handle: int, sample: Any) -> int:
    at = int64_at(handle)
    now = read_monotonic_ns(handle + 8 * AT.timespec)
    dt = min((now - at[AT.moved_at]) * 1e-9, STEP_MAX_S)
    at[AT.moved_at] = now
    status = update_pose(handle, read_setup(handle), now, dt)
    if status < 0:
        return status
    at[LOG.reads] += 1
    position, orientation = compute_pose(handle)
    store_pose(sample, position, orientation)
    sample[SAMPLE_TIME] = float64_at(handle + 8 * AT.motion_time)[0]
    sample[SAMPLE_BUTTONS] = read_buttons(handle)
    sample[SAMPLE_GRIPPER] = 0.0
    return OK  # also without a report: a puck that does not move sends none


class Puck:
    """Open puck, owner of the file descriptor `fd` of its node; LOG and AT lay out `block`."""

    def __init__(self, options: Options, fd: int, block: Block) -> None:
        self._word, self._led = block.word, options.led
        word = block.word
        block.numbers(AT.pose, 4)[:] = *options.start_m, 1.0
        block.numbers(AT.setup, SETUP_SIZE)[:] = flatten(make_parameters(options))
        word[AT.fd] = fd
        word[AT.hold] = round(options.hold_s * 1e9)
        word[AT.moved_at] = word[AT.sampled_at] = time.monotonic_ns()
        self._switch_light(LED_ON)

    def close(self) -> None:
        """Switch the lamp off and close the node. May be called repeatedly, but not while the loop reads."""
        fd = int(self._word[AT.fd])
        if fd >= 0:
            self._switch_light(LED_OFF)
            self._word[AT.fd] = -1
            os.close(fd)

    def _switch_light(self, report: bytes) -> None:
        if self._led:
            with contextlib.suppress(OSError):  # some have no lamp, and a disconnected one needs none
                os.write(int(self._word[AT.fd]), report)


class SpaceMouse(LoggedDevice):
    """Fingertip of the puck as a device. Written wrenches are only logged."""

    _functions = read, wrench_log.write

    def __init__(self, options: Options, fd: int, rate_hz: float, name: str = "puck") -> None:
        super().__init__(Block(LOG, AT), 0, rate_hz, None)
        self._puck = Puck(options, fd, self._block)
        self.info = make_unlimited_info(f"spacemouse {name}", 0, options.workspace_min_m, options.workspace_max_m)

    def close(self) -> None:
        """Close the node. May be called repeatedly, but not while the loop reads."""
        super().close()
        self._puck.close()


def open_puck(options: Options) -> tuple[int, str]:
    """Open the puck that the options select, or the only one attached; return file descriptor and name.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError if the node is not a puck's.
    """
    puck = find_puck(options)
    return open_path(puck.node, puck.vendor, puck.product), puck.name


def find_puck(options: Options) -> SystemDevice:
    """Return the puck that matches the options; raises DeviceNotFound if there is none or more than one."""
    nodes = list(discovery.iter_hidraw_nodes())
    if options.path is not None:
        # opening reports whether an unlisted node is missing or is not a node
        return next(
            (node for node in nodes if node.node == options.path), SystemDevice("hid", *PUCKS[0], "", "", options.path)
        )
    pucks = [node for node in nodes if (node.vendor, node.product) in PUCKS]
    matching = [node for node in pucks if options.serial in (None, node.serial)]
    if len(matching) == 1:
        return matching[0]
    if matching:
        choices = ", ".join(f"{node.node} (serial '{node.serial}')" for node in matching)
        raise DeviceNotFound(f"{len(matching)} SpaceMice are attached: select one with serial or path: {choices}")
    present = ", ".join(map(str, pucks or nodes)) or "no HID device"
    condition = f" with serial = '{options.serial}'" if options.serial is not None else ""
    raise DeviceNotFound(f"no SpaceMouse{condition} is attached: plug it in; attached are: {present}")


def open_device(options: Options, rate_hz: float) -> SpaceMouse:
    """Open the puck that a rig describes; raises DeviceError or a subclass if it cannot be used."""
    fd, name = open_puck(options)
    return SpaceMouse(options, fd, rate_hz, name)
