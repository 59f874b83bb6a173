"""The contract every device keeps.

A driver gives the servo loop three integers: the addresses of two C functions and a handle that
both receive. The loop calls them without the GIL; it does not know which device is behind.

    int64 read(int64 handle, double sample[SAMPLE_SIZE])    -> status
    int64 write(int64 handle, const double wrench[6])       -> status

`sample` is position (m), orientation quaternion w, x, y, z (fingertip to world), device time (s),
buttons, and opening of the gripper (rad; 0 without one); `wrench` is force (N) and torque (N m) on
the hand. Both are in the world frame: vendor axes are turned inside the driver and nowhere else.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, NamedTuple, Protocol, Self

from softfinger.proxy.kernels.model import Quaternion, Vec3

OK: Final = 0
"""A new sample was read, or the wrench was taken. Not for a sample of before: how far a hand may have come is judged by
the time since the last new one."""
STALE: Final = 1
"""Read: no new sample, the last one is repeated. Write: taken, but limited by the device."""
END: Final = 2
"""Read: a recording has come to its end; the servo stops in order."""
WITHHELD: Final = 3
"""Read or write: the driver commands zero in place of the force (a silence, no pose, not armed); the guard fades in
anew once it does not."""
HELD: Final = 4
"""Write: not taken, the device keeps the force of before. The guard counts on from that one, so that the next that is
taken is a limited change from what the hand feels."""
LOST: Final = -1
"""The device is gone."""
TIMEOUT: Final = -2
"""The device did not answer in time."""
PROTOCOL: Final = -3
"""The device answered something that is not in its protocol."""
FORCE_OFF: Final = -4
"""The device answers, but has turned its own force off; `Device.reason` says why."""

SAMPLE_SIZE: Final = 10
SAMPLE_TIME: Final = 7
SAMPLE_BUTTONS: Final = 8
SAMPLE_GRIPPER: Final = 9


class DeviceIO(NamedTuple):
    """C function addresses and the handle they are called with."""

    read: int
    write: int
    handle: int


class Led(Protocol):
    """A hand that is computed, and that a program may lead. One thread only."""

    def lead(self, position_m: Vec3, orientation: Quaternion | None = None) -> None:
        """Have it want to be at `position_m`, turned so (unit quaternion; None: as it is), and stay."""

    def hold(self) -> None:
        """Have it want to stay where it wants to be now, and so turned, whatever it is on the way to."""

    def release(self) -> None:
        """Have it go back to what it does by itself."""

    def intends(self) -> tuple[Vec3, Quaternion]:
        """Where it wants to be by now, (3,) m, and how turned, device's frame: up to a tick old."""


@dataclass(frozen=True)
class DeviceInfo:
    """What a device can do; the guard never commands more than this.

    `own_clock` says that each read advances the device by one nominal period, whatever the wall
    clock does (a recording, a simulation); the contact step then uses the nominal dt, so that a
    run is reproducible to the bit.
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
    def holds_a_force(self) -> bool:
        """Whether a force that nobody renews stays in somebody's hand."""
        return self.actuated_dof > 0 and not self.own_clock


def names(devices: Iterable[Device]) -> str:
    """Names of devices, for people."""
    return ", ".join(device.info.name for device in devices)


class LastWord(NamedTuple):
    """Path of a device's node, its open file descriptor, and the bytes that command zero when they are written there.

    A process that inherits the descriptor does not have to open the node: a serial port that is open for one user alone
    stays so as long as anybody holds it.
    """

    node: str
    fd: int
    zero: bytes


class Device(ABC):
    """An open device. Opening happens in the constructor; leaving the context stops and closes it."""

    info: DeviceInfo

    @abstractmethod
    def io(self) -> DeviceIO:
        """Addresses for the servo loop, valid until `close`."""

    def arm(self) -> None:  # noqa: B027  (a device that has nothing to switch on does nothing)
        """Switch on force and what watches over it (a watchdog, a session that times out).

        Called once, by the thread that runs the loop, as the last act before the first tick: whatever takes long
        is done. Raises DeviceError. A device that has nothing to switch on does nothing.
        """

    @abstractmethod
    def stop(self) -> None:
        """Command zero force and disarm. From any thread, any number of times, also after an error."""

    @abstractmethod
    def close(self) -> None:
        """Stop, then release the device. Any number of times."""

    def reason(self) -> str:
        """What the device itself says of its last failure; empty where it says nothing. After the loop has ended."""
        return ""

    def warning(self) -> str:
        """What the device has to say while it goes on working, such as that its motors get hot; empty: nothing.

        From any thread. The same words as long as nothing changes: each is told once.
        """
        return ""

    def zero_failure(self) -> str:
        """Return why the zero of the last `stop` is not confirmed; empty if it is.

        `stop` itself does not raise for a device that is gone or silent.
        """
        return ""

    def hand(self) -> Led | None:
        """The hand on it, where it is computed and may be led; None where a person's is, or something else leads it."""
        return None

    def last_word(self) -> LastWord | None:
        """What another process needs to command zero; None where none can."""
        return None

    def counts(self) -> dict[str, int]:
        """What the driver has counted since the device was opened, by name; empty where it counts nothing.

        While the servo runs: each number as it was just now.
        """
        return {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
