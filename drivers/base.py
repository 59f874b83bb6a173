"""Contract between devices and the servo loop.

A driver gives the servo loop three integers: the addresses of two C functions, and a handle that both receive. The loop
calls them without the GIL and does not depend on the kind of device.

    int64 read(int64 handle, double sample[SAMPLE_SIZE])    -> status
    int64 write(int64 handle, const double wrench[6])       -> status

`sample` is position (m), orientation quaternion w, x, y, z (fingertip to world), device time (s), buttons, and opening
of the gripper (rad; 0 without one); `wrench` is force (N) and torque (N m) on the hand. Both are in the world frame:
only the driver converts from and to the axes of the vendor.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from softfinger.drivers.closeable import Closeable
from softfinger.proxy.kernels.model import Quaternion, Vec3

OK: Final = 0
"""Read: a new sample. Write: the device received the wrench.

Do not return it for a repeated sample: the allowed movement of the hand grows with the time since the last new one.
"""
STALE: Final = 1
"""Read: no new sample, the last one is repeated. Write: the device received the wrench, but limited it."""
END: Final = 2
"""Read: end of a recording; the servo stops normally."""
WITHHELD: Final = 3
"""Read or write: the driver commands zero instead of the force (silence, no pose, or disarmed).

The guard fades the force in again afterwards.
"""
HELD: Final = 4
"""Write: the device did not accept the wrench and keeps the previous force.

The guard continues from that force, so that the next one differs from it by a limited step.
"""
IGNORED_WRENCH_MAX_S: Final = 0.25
"""Time for which a device may ignore wrenches: then the run ends.

The device keeps the previous force, which no limit of the guard can change. Equal to the tolerated stall of a loop,
which has the same effect.
"""
LOST: Final = -1
"""The device is disconnected."""
TIMEOUT: Final = -2
"""The device did not answer in time."""
PROTOCOL: Final = -3
"""The device sent an answer that its protocol does not define."""
FORCE_OFF: Final = -4
"""The device answers, but has switched its force off; `Device.reason` returns the cause."""

TORQUE_MAX_NM: Final = 1e2
"""Torque limit without a motor that turns the handle: torque is accepted but not sent; contact and telemetry use it."""

SAMPLE_SIZE: Final = 10
SAMPLE_TIME: Final = 7
SAMPLE_BUTTONS: Final = 8
SAMPLE_GRIPPER: Final = 9


class DeviceIO(NamedTuple):
    """Addresses of the C functions, and the handle to call them with."""

    read: int
    write: int
    handle: int


class LeadableHand(Protocol):
    """Simulated hand that a program may lead. Call it from one thread only."""

    def lead(self, position_m: Vec3, orientation: Quaternion | None = None) -> None:
        """Set the target: position (3,) m and unit quaternion (None: unchanged), device frame."""

    def hold(self) -> None:
        """Hold the present intention, also during a motion to an earlier target."""

    def release(self) -> None:
        """End the lead: the hand resumes its configured behaviour."""

    def intends(self) -> tuple[Vec3, Quaternion]:
        """Return the present intention, (3,) m and unit quaternion, device frame; up to one tick old."""


@dataclass(frozen=True)
class DeviceInfo:
    """Capabilities of a device; the guard never commands more than this.

    `own_clock` is True if each read advances the device by one nominal period, independent of the wall clock (a
    recording, a simulation). The contact step then uses the nominal dt, so that a run is reproducible to the bit.
    """

    name: str
    sensed_dof: int
    actuated_dof: int
    force_max_n: float
    torque_max_nm: float
    stiffness_max_n_per_m: float
    damping_max_ns_per_m: float
    workspace_min_m: tuple[float, float, float]
    workspace_max_m: tuple[float, float, float]
    own_clock: bool = False

    @property
    def has_persistent_force(self) -> bool:
        """True if the last force persists in a person's hand until it is replaced."""
        return self.actuated_dof > 0 and not self.own_clock


class ModelLimits(NamedTuple):
    """Limits in N, N m (0: no motors turn the handle), N/m, N s/m, and the radius of the workspace, m."""

    force_max_n: float
    torque_max_nm: float
    stiffness_max_n_per_m: float
    damping_max_ns_per_m: float
    workspace_radius_m: float = 0.0


class Capabilities(Protocol):
    """Limits of a device whose motors turn no handle, in a rig's options or a table of models."""

    @property
    def force_max_n(self) -> float: ...
    @property
    def stiffness_max_n_per_m(self) -> float: ...
    @property
    def damping_max_ns_per_m(self) -> float: ...
    @property
    def workspace_radius_m(self) -> float: ...


def make_info(
    limits: Capabilities, name: str, sensed_dof: int, actuated_dof: int = 3, centre_m: Vec3 = (0.0, 0.0, 0.0)
) -> DeviceInfo:
    """Return the capabilities of a device without torque, with a box of twice its radius as workspace."""
    x, y, z = (float(v) for v in centre_m)
    r = limits.workspace_radius_m
    return DeviceInfo(
        name=name,
        sensed_dof=sensed_dof,
        actuated_dof=actuated_dof,
        force_max_n=limits.force_max_n,
        torque_max_nm=TORQUE_MAX_NM,
        stiffness_max_n_per_m=limits.stiffness_max_n_per_m,
        damping_max_ns_per_m=limits.damping_max_ns_per_m,
        workspace_min_m=(x - r, y - r, z - r),
        workspace_max_m=(x + r, y + r, z + r),
    )


def make_unlimited_info(
    name: str, actuated_dof: int, low_m: Iterable[float], high_m: Iterable[float], own_clock: bool = False
) -> DeviceInfo:
    """Return the capabilities of a device that displays no force: wide limits, so that the rig's guard limits.

    low_m, high_m  (3,) m  corners of the workspace
    """
    (x0, y0, z0), (x1, y1, z1) = map(float, low_m), map(float, high_m)
    return DeviceInfo(
        name=name,
        sensed_dof=6,
        actuated_dof=actuated_dof,
        force_max_n=1e3,
        torque_max_nm=TORQUE_MAX_NM,
        stiffness_max_n_per_m=1e6,
        damping_max_ns_per_m=1e3,
        workspace_min_m=(x0, y0, z0),
        workspace_max_m=(x1, y1, z1),
        own_clock=own_clock,
    )


def join_names(devices: Iterable[Device]) -> str:
    return ", ".join(device.info.name for device in devices)


class ZeroCommand(NamedTuple):
    """Means of another process to zero a device: path of its node, open file descriptor, and bytes to write there.

    A process that inherits the descriptor does not have to open the node. A serial port opened exclusively remains
    exclusive as long as any process has it open. A node on the USB bus can be opened repeatedly, so it has no
    descriptor here, but the interface and its endpoint that receives the bytes.
    """

    node: str
    fd: int | None
    zero: bytes
    interface: int = 0
    endpoint: int = 0


class Device(Closeable):
    """Open device. The constructor opens it; leaving the context stops and closes it."""

    info: DeviceInfo

    @abstractmethod
    def io(self) -> DeviceIO:
        """Return the addresses for the servo loop, valid until `close`."""

    def arm(self) -> None:
        """Switch on the force and its safeguards (a watchdog, a session that times out).

        The servo thread calls it once, right before the first tick, after everything slow is done. A device with
        nothing to switch on does nothing. Raises DeviceError.
        """

    @abstractmethod
    def stop(self) -> None:
        """Command zero force and disarm. May be called from any thread, repeatedly, and after an error."""

    @abstractmethod
    def close(self) -> None:
        """Stop, then release the device. May be called repeatedly."""

    def reason(self) -> str:
        """Return the device's explanation of its last failure; empty without one. Call it after the end of the loop."""
        return ""

    def warning(self) -> str:
        """Return a problem that does not end the run, such as hot motors; empty if there is none.

        May be called from any thread. Return the same text until the problem changes: each text is reported once.
        """
        return ""

    def zero_failure(self) -> str:
        """Return why the zero of the last `stop` is not confirmed; empty if it is.

        `stop` itself does not raise for a device that is gone or silent.
        """
        return ""

    def hand(self) -> LeadableHand | None:
        """Return the simulated hand, or None if a person or another source moves the device."""
        return None

    def zero_command(self) -> ZeroCommand | None:
        """Return the means of another process to command zero; None if there are none."""
        return None

    def thread_ids(self) -> list[int]:
        """Return the native ids of threads that pass forces to the device; they get a real-time priority."""
        return []

    def counts(self) -> dict[str, int]:
        """Return the driver's counters since the device was opened, by name; empty without counters.

        While the servo runs, each is a momentary value.
        """
        return {}
