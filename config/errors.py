"""The tree of errors: every error this program raises on purpose is a `HapticError`.

A message says what happened, the value seen, the range allowed and what to do.
"""


class HapticError(Exception):
    """Base of all errors raised on purpose; `exit_code` is what the command line returns."""

    exit_code = 1


class ConfigError(HapticError):
    """A rig, scene or command-line value that cannot be used; the message lists every fault found."""

    exit_code = 2


class RecordingError(HapticError):
    """A recording (poses or results) that cannot be read or written."""

    exit_code = 3


class DeviceError(HapticError):
    """A device that cannot be opened or that stopped answering."""

    exit_code = 4


class DeviceNotFound(DeviceError):
    """No such device is attached, or no such driver exists."""


class DeviceBusy(DeviceError):
    """Another process holds the device."""


class DevicePermission(DeviceError):
    """This user may not open the device."""


class DeviceTimeout(DeviceError):
    """The device answered too late."""


class DeviceLost(DeviceError):
    """The device went away while it was in use."""


class RealtimeError(HapticError):
    """A real-time setting was required and refused."""

    exit_code = 5


class SafetyStop(HapticError):
    """The servo stopped itself; force is zero."""

    exit_code = 6


class Unfit(HapticError):
    """`doctor` found something that keeps this machine from running the rig, or `bench soak` something that grows."""

    exit_code = 10


class AddressInUse(HapticError):
    """An endpoint that cannot be bound."""

    exit_code = 7


class Exhausted(HapticError):
    """The system has not what the program needs: files, memory, disk."""

    exit_code = 11


class Different(HapticError):
    """A replay does not give what was recorded; the message begins with where."""

    exit_code = 13


class CommandRefused(HapticError):
    """A running daemon did not do what it was asked; the message begins with the name of the error."""

    exit_code = 12
