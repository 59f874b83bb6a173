"""Rig: device, servo loop, guard of the hand, telemetry, commands, recordings, keys and metrics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Final, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.fields import (
    Complaint,
    Orientation,
    Table,
    TopicPart,
    check_orientation,
    doc,
    is_usable,
    normalise_orientation,
    sized,
    within,
)
from softfinger.config.schema.addresses import check_endpoint, is_public, make_commands_address
from softfinger.config.schema.guard import Guard, HandlePosition

RealtimeMode = Literal["auto", "require", "off"]


class Tool(Table, frozen=True, kw_only=True):
    """Tool mounted on the handle, such as a stylus; its tip is the fingertip."""

    offset_m: Annotated[HandlePosition, doc("offset from handle to tip, in the handle frame", [0.0, 0.0, -0.1])] = (
        0.0, 0.0, 0.0,
    )  # fmt: skip
    orientation_wxyz: Annotated[
        Orientation, doc("tip to handle: quaternion w, x, y, z, normalised on load", [1.0, 0.0, 0.0, 0.0])
    ] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        normalise_orientation(self)

    def faults(self) -> Iterator[Complaint]:
        yield from check_orientation(self.orientation_wxyz)


class DeviceConfig(Table, frozen=True, kw_only=True):
    """Driver of the device. The other keys are options of the driver, see the page of the device."""

    gathers: ClassVar[str] = "options"
    """Field that collects all keys of [device] except the ones below."""

    driver: Annotated[str, sized(limits.NAME_LENGTH, "name of the driver", "replay")]
    tool: Annotated[Tool | None, doc("mounted tool; without this table the handle is the fingertip")] = None
    options: dict[str, Any] = msgspec.field(default_factory=dict)


class Servo(Table, frozen=True, kw_only=True):
    """Servo loop and its thread."""

    rate_hz: Annotated[float, within(limits.RATE_HZ, "ticks per second", 1000.0)] = 1000.0
    realtime: Annotated[
        RealtimeMode,
        doc(
            "real-time settings; auto: use those that the system grants; require: refuse to start without them; "
            "off: request none",
            "auto",
        ),
    ] = "auto"
    priority: Annotated[int, within(limits.PRIORITY, "SCHED_FIFO priority of the servo thread", 80)] = 80
    cpu: Annotated[int, within(limits.CPU, "processor to run on; default: any", 1)] | None = None


class Telemetry(Table, frozen=True, kw_only=True):
    """Telemetry publisher."""

    endpoint: Annotated[
        str,
        sized(
            limits.ENDPOINT_LENGTH,
            "ZeroMQ address to bind: ipc, tcp on a loopback host, or with [security] tcp on any host",
            "tcp://127.0.0.1:5555",
        ),
    ] = "tcp://127.0.0.1:5555"
    every: Annotated[int, within(limits.EVERY, "publish one tick in this many", 1)] = 1

    def faults(self) -> Iterator[Complaint]:
        complaint = check_endpoint(self.endpoint) if is_usable(self.endpoint) else None
        if complaint is not None:
            yield "endpoint", self.endpoint, complaint


OFF: Final = "off"


class Commands(Table, frozen=True, kw_only=True):
    """Command socket and heartbeat."""

    endpoint: (
        Annotated[
            str,
            sized(
                limits.ENDPOINT_LENGTH,
                "ZeroMQ address to bind, or off; default: a socket of this user only, or, if telemetry is open to "
                "the network, the next port",
                "tcp://127.0.0.1:5556",
            ),
        ]
        | None
    ) = None
    heartbeat_s: (
        Annotated[
            float,
            within(
                limits.HEARTBEAT_S,
                "the force is removed after this long without a command; default: no heartbeat required",
                0.5,
            ),
        ]
        | None
    ) = None
    ramp_s: Annotated[
        float,
        within(limits.PARAMETER_RAMP_S, "time over which parameter changes take effect on the force; 0: at once", 0.1),
    ] = 0.1

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.endpoint) and self.endpoint not in (None, OFF):
            complaint = check_endpoint(self.endpoint)
            if complaint is not None:
                yield "endpoint", self.endpoint, f"{complaint}; or off"
        if is_usable(self.endpoint, self.heartbeat_s) and self.endpoint == OFF and self.heartbeat_s is not None:
            yield "heartbeat_s", self.heartbeat_s, "no client can send a heartbeat while commands are off: remove it"


class Recording(Table, frozen=True, kw_only=True):
    """Recordings made by command."""

    directory: Annotated[
        str,
        sized(
            limits.FILE_NAME_LENGTH, "folder below which record_start writes, from the working directory of run", "."
        ),
    ] = "."


class Security(Table, frozen=True, kw_only=True):
    """Keys for access from other machines, made by `softfinger keys`; paths are relative to the rig file."""

    key: Annotated[
        str, sized(limits.FILE_NAME_LENGTH, "file of the server's secret key, mode 600", "keys/rig.key_secret")
    ]
    readers: (
        Annotated[
            str, sized(limits.FILE_NAME_LENGTH, "folder of the public keys that may read telemetry", "keys/readers")
        ]
        | None
    ) = None
    commanders: (
        Annotated[str, sized(limits.FILE_NAME_LENGTH, "folder of the public keys that may command", "keys/commanders")]
        | None
    ) = None


class Metrics(Table, frozen=True, kw_only=True):
    """HTTP endpoint for Prometheus."""

    endpoint: (
        Annotated[
            str,
            sized(
                limits.ENDPOINT_LENGTH, "loopback address and port to serve metrics on; default: off", "127.0.0.1:9464"
            ),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.endpoint) or self.endpoint is None:
            return
        if check_endpoint(f"tcp://{self.endpoint}") is not None or self.endpoint.endswith(":*"):
            yield "endpoint", self.endpoint, "must be HOST:PORT, port 0 to 65535, such as 127.0.0.1:9464"
        elif is_public(f"tcp://{self.endpoint}"):
            yield "endpoint", self.endpoint, "is open to the network without protection: use 127.0.0.1:PORT"


class Rig(Table, frozen=True, kw_only=True):
    """Device or devices, servo loop, safety limits, and interfaces."""

    device: DeviceConfig | None = None
    devices: Annotated[dict[TopicPart, DeviceConfig], doc("one device for each finger, by name")] = msgspec.field(
        default_factory=dict
    )
    servo: Servo = Servo()
    guard: Guard = Guard()
    telemetry: Telemetry = Telemetry()
    commands: Commands = Commands()
    recording: Recording = Recording()
    security: Annotated[Security | None, doc("keys for access from other machines")] = None
    metrics: Metrics = Metrics()

    @property
    def tables(self) -> dict[str, DeviceConfig]:
        """All devices, by the name of their table."""
        if self.device is not None:
            return {"device": self.device}
        return {f"devices.{name}": device for name, device in self.devices.items()}

    @property
    def commands_endpoint(self) -> str | None:
        """Address for commands: as configured, else derived from the telemetry; None if commands are off."""
        endpoint = self.commands.endpoint
        if endpoint is not None:
            return None if endpoint == OFF else endpoint
        return make_commands_address(self.telemetry.endpoint)

    def faults(self) -> Iterator[Complaint]:
        yield from self._check_device_tables()
        yield from self._check_endpoints()

    def _check_device_tables(self) -> Iterator[Complaint]:
        if not is_usable(self.device, self.devices):
            return
        if self.device is None and not self.devices:
            fault = "is missing: add the table [device], or a table [devices.NAME] for each of several fingers"
            yield "device", msgspec.UNSET, fault
        if self.device is not None and self.devices:
            fault = "cannot be combined with [devices]: it is for a single finger; remove one of them"
            yield "device", msgspec.UNSET, fault

    def _check_endpoints(self) -> Iterator[Complaint]:
        if not is_usable(self.telemetry, self.commands) or not is_usable(
            self.telemetry.endpoint, self.commands.endpoint
        ):
            return
        if check_endpoint(self.telemetry.endpoint) is not None:
            return
        commands = self.commands_endpoint
        reason = None if commands is None or self.commands.endpoint is not None else check_endpoint(commands)
        if reason is not None:
            fault = (
                f"{commands}, derived from the telemetry endpoint, {reason}: set another endpoint, or XDG_RUNTIME_DIR"
            )
            yield "commands.endpoint", msgspec.UNSET, fault
        elif commands == self.telemetry.endpoint and not commands.endswith((":*", ":0")):
            yield "commands.endpoint", commands, "is also the telemetry endpoint: use another"
        elif is_usable(self.security):
            yield from self._check_public_endpoints(commands)

    def _check_public_endpoints(self, commands: str | None) -> Iterator[Complaint]:
        """Require keys of the permitted users for each endpoint that is open to the network."""
        for key, endpoint, folder, use in (
            ("telemetry.endpoint", self.telemetry.endpoint, "readers", "read"),
            ("commands.endpoint", commands, "commanders", "command"),
        ):
            if endpoint is not None and is_public(endpoint) and getattr(self.security, folder, None) is None:
                fault = (
                    f"is open to the network, but without keys of clients that may {use}: add [security] with key and "
                    f"{folder} (`softfinger keys` creates them), or use tcp://127.0.0.1:PORT or ipc://PATH"
                )
                yield key, endpoint, fault
                if self.commands.endpoint is None:  # it is derived, and its fault would be a repetition
                    return
