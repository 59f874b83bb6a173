"""A rig: the device, the servo loop, the guard before the hand, the telemetry."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Final, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.schema.fields import Complaint, Table, known, said, sized, within

RealtimeMode = Literal["auto", "require", "off"]


class DeviceConfig(Table, frozen=True, kw_only=True):
    """Which driver, and the options it has; the driver checks those with its own struct."""

    gathers: ClassVar[str] = "options"
    """All keys of [device] but `driver` go into this field."""

    driver: Annotated[str, sized(limits.NAME_LENGTH, "name of the driver", "replay")]
    options: dict[str, Any] = msgspec.field(default_factory=dict)


class Servo(Table, frozen=True, kw_only=True):
    """The loop and its thread."""

    rate_hz: Annotated[float, within(limits.RATE_HZ, "ticks per second", 1000.0)] = 1000.0
    realtime: Annotated[
        RealtimeMode, said("auto: take what is granted; require: do not start without; off: ask for nothing", "auto")
    ] = "auto"
    priority: Annotated[int, within(limits.PRIORITY, "SCHED_FIFO priority of the servo thread", 80)] = 80
    cpu: Annotated[int, within(limits.CPU, "processor to stay on; absent: any", 1)] | None = None


class Guard(Table, frozen=True, kw_only=True):
    """What stands between the contact step and the hand."""

    force_max_n: Annotated[float, within(limits.FORCE_MAX_N, "largest force; its direction is kept", 12.0)] = 12.0
    torque_max_nm: Annotated[float, within(limits.TORQUE_MAX_NM, "largest torque; its direction is kept", 0.3)] = 0.3
    force_slew_n_per_s: Annotated[float, within(limits.FORCE_SLEW_N_PER_S, "fastest change of the force", 2000.0)] = (
        2000.0
    )
    torque_slew_nm_per_s: Annotated[
        float, within(limits.TORQUE_SLEW_NM_PER_S, "fastest change of the torque", 50.0)
    ] = 50.0
    ramp_s: Annotated[float, within(limits.RAMP_S, "time over which force fades in after engaging", 0.5)] = 0.5


class Telemetry(Table, frozen=True, kw_only=True):
    """What is published, and where."""

    endpoint: Annotated[
        str,
        sized(limits.ENDPOINT_LENGTH, "ZeroMQ address to bind: tcp on a loopback host, or ipc", "tcp://127.0.0.1:5555"),
    ] = "tcp://127.0.0.1:5555"
    every: Annotated[int, within(limits.EVERY, "publish one tick in so many", 1)] = 1

    def faults(self) -> Iterator[Complaint]:
        complaint = endpoint_complaint(self.endpoint) if known(self.endpoint) else None
        if complaint is not None:
            yield "endpoint", self.endpoint, complaint


_TCP: Final = re.compile(r"tcp://(\[[^\]]*\]|[^:/@\[\]]+):(\*|[0-9]{1,5})")
_LOOPBACK: Final = re.compile(r"localhost|127(\.[0-9]{1,3}){3}|\[::1\]")
_IPC_PATH_MAX: Final = 107  # bytes of a Unix socket's path


def endpoint_complaint(endpoint: str) -> str | None:
    """What is wrong with a ZeroMQ address to bind; None if nothing is."""
    if endpoint.startswith("ipc://"):
        size = len(endpoint.removeprefix("ipc://").encode(errors="replace"))
        return None if 0 < size <= _IPC_PATH_MAX else f"must have a path of 1 to {_IPC_PATH_MAX} bytes"
    match = _TCP.fullmatch(endpoint)
    if match is None or (match[2] != "*" and int(match[2]) > 65535):
        return "must be tcp://HOST:PORT, port 0 to 65535 or *, or ipc://PATH; such as tcp://127.0.0.1:5555"
    if not _LOOPBACK.fullmatch(match[1]):
        return "is open to the network, and telemetry is not encrypted: bind tcp://127.0.0.1:PORT or ipc://PATH"
    return None


class Rig(Table, frozen=True, kw_only=True):
    """The device and the machine."""

    device: DeviceConfig
    servo: Servo = Servo()
    guard: Guard = Guard()
    telemetry: Telemetry = Telemetry()
