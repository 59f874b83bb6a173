"""Exceptions: every error that the program raises on purpose is a subclass of `HapticError`.

A message states the failure, the value, the allowed range and the remedy.
"""


class HapticError(Exception):
    """Base class of all errors raised on purpose; `exit_code` is the exit status of the command line."""

    exit_code = 1


class ConfigError(HapticError):
    """Unusable rig, scene or command-line value; the message lists every fault found."""

    exit_code = 2


class RecordingError(HapticError):
    """Recording of poses or results that cannot be read or written."""

    exit_code = 3


class DeviceError(HapticError):
    """Device that cannot be opened or that stopped answering."""

    exit_code = 4


class DeviceNotFound(DeviceError):
    """No such device is attached, or no such driver exists."""


class DeviceBusy(DeviceError):
    """Another process uses the device."""


class DevicePermission(DeviceError):
    """The user has no permission to open the device."""


class DeviceTimeout(DeviceError):
    """The device answered too late."""


class DeviceLost(DeviceError):
    """The device disconnected while it was in use."""


class RealtimeError(HapticError):
    """A required real-time setting was refused."""

    exit_code = 5


class SafetyStop(HapticError):
    """The servo stopped itself; force is zero."""

    exit_code = 6


class Unfit(HapticError):
    """`doctor` found a reason why this machine cannot run the rig, or `bench soak` found growth or a lost tick."""

    exit_code = 10


class AddressInUse(HapticError):
    """Endpoint that cannot be bound."""

    exit_code = 7


class Exhausted(HapticError):
    """The system lacks a resource that the program needs: files, memory or disk space."""

    exit_code = 11


class Different(HapticError):
    """A replay differs from its recording; the message starts with the first difference."""

    exit_code = 13


class CommandRefused(HapticError):
    """A running daemon refused a command; the message starts with the name of the error."""

    exit_code = 12
