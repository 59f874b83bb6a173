"""Messages of the service and its clients: decoded with types and limits, encoded for the service's version.

Source: docs.haply.co/inverseSDK, pages "WebSocket Protocol", "Control Commands" and "Device Configuration" of 3.5; the
key `values` of 3.1 to 3.4 from Haply's public Python examples. The service silently ignores unknown keys, so a force
under the wrong key would not act.
"""

from __future__ import annotations

from math import hypot, isfinite, nan
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from msgspec import Meta, Struct

from softfinger.config.errors import DeviceError
from softfinger.proxy.kernels.model import Quaternion, Vec3

GROUPS: Final = ("inverse3", "inverse3x", "minverse")
"""Names of the lists of devices in a message."""
GRIPS: Final = ("wireless_verse_grip", "verse_grip", "custom_verse_grip")
"""Names of the lists of grips."""
FIRST_SUPPORTED: Final = (3, 1)
VECTOR_SINCE: Final = (3, 5)
FIRST_UNSUPPORTED: Final = (4, 0)

POSITION_MAX_M: Final = 10.0
"""Maximum distance of a cursor; beyond it is an invalid position."""
EXCERPT_CHARS: Final = 120
"""Characters of a message that an error quotes."""

Name = Annotated[str, Meta(pattern=r"^[\w.:-]{1,64}$")]
Number = float | None
"""JSON has no NaN; the maker's library writes null for it."""


class Malformed(Exception):
    """The message is not one of the service."""


class Missing(Exception):
    """The service does not list the device or its grip, or not with a usable state."""


class Vector(Struct):
    x: Number
    y: Number
    z: Number


class Rotation(Struct):
    w: Number
    x: Number
    y: Number
    z: Number


class Buttons(Struct):
    a: bool = False
    b: bool = False
    c: bool = False


class DeviceState(Struct):
    cursor_position: Vector
    transform: dict[str, Any] | None = None


class GripState(Struct):
    orientation: Rotation
    buttons: Buttons | None = None
    button: bool = False


class Status(Struct):
    calibrated: bool = True
    power_supply: bool = True
    ready: bool = True


class Switch(Struct):
    enabled: bool
    scaling_factor: float = 1.0


class Config(Struct):
    type: str = ""
    gravity_compensation: Switch | None = None
    torque_scaling: Switch | None = None
    home_return: Switch | None = None
    mount: dict[str, Any] | None = None


class DeviceEntry(Struct):
    device_id: Name
    state: DeviceState | None
    status: Status = msgspec.field(default_factory=Status)


class GripEntry(Struct):
    device_id: Name
    state: GripState | None


class Workspace(Struct):
    transform: dict[str, Any] | None = None


class InventoryEntry(Struct):
    """Entry of the inventory."""

    device_id: Name
    config: Config | None = msgspec.field(default_factory=Config)
    state: Workspace | None = msgspec.field(default_factory=Workspace)


class ServiceState(Struct):
    """Answer of the service to a message."""

    inverse3: list[DeviceEntry] = []
    inverse3x: list[DeviceEntry] = []
    minverse: list[DeviceEntry] = []
    wireless_verse_grip: list[GripEntry] = []
    verse_grip: list[GripEntry] = []
    custom_verse_grip: list[GripEntry] = []


class Inventory(Struct):
    """Device inventory that the service sends on connect."""

    session_id: int = 0
    inverse3: list[InventoryEntry] = []
    inverse3x: list[InventoryEntry] = []
    minverse: list[InventoryEntry] = []
    wireless_verse_grip: list[InventoryEntry] = []
    verse_grip: list[InventoryEntry] = []
    custom_verse_grip: list[InventoryEntry] = []

    def list_devices(self, groups: tuple[str, ...]) -> list[tuple[DeviceRef, InventoryEntry]]:
        return [(DeviceRef(group, entry.device_id), entry) for group in groups for entry in getattr(self, group)]


class DeviceRef(NamedTuple):
    """Device or grip: name of the list that contains it (GROUPS, GRIPS), and its id."""

    group: str
    name: str

    def __str__(self) -> str:
        return f"{self.group} {self.name}"


class PoseReading(NamedTuple):
    """Pose in the service's frame.

    position     (3,) m        NaN if unusable
    orientation  (4,)          w x y z, NaN if unusable
    buttons                    one bit each
    warning                    problems of the device; empty without any
    """

    position: Vec3
    orientation: Quaternion
    buttons: float
    warning: str = ""


_STATES: Final = msgspec.json.Decoder(ServiceState)
_INVENTORIES: Final = msgspec.json.Decoder(Inventory)
_ENCODER: Final = msgspec.json.Encoder()
_NO_POSITION: Final = (nan, nan, nan)
_IDENTITY: Final = (1.0, 0.0, 0.0, 0.0)


def read_inventory(message: bytes) -> Inventory:
    """Decode an inventory. Raises Malformed."""
    return _decode(_INVENTORIES, message)  # type: ignore[no-any-return]


def read_state(message: bytes, device: DeviceRef, grip: DeviceRef | None) -> PoseReading:
    """Return the pose of a device, with the orientation of its grip, from an answer. Raises Malformed, Missing."""
    state: ServiceState = _decode(_STATES, message)
    device_entry, device_state = _find_entry(state, device)
    if not is_identity(device_state.transform):
        raise Missing(format_moved(device))
    position, warning = _parse_position(device_state.cursor_position), _parse_warning(device_entry.status)
    if grip is None:
        return PoseReading(position, _IDENTITY, 0.0, warning)
    grip_state: GripState = _find_entry(state, grip)[1]
    pressed = grip_state.buttons
    mask = float(grip_state.button) if pressed is None else float(pressed.a + 2 * pressed.b + 4 * pressed.c)
    return PoseReading(position, _parse_quaternion(grip_state.orientation), mask, warning)


def encode_command(device: DeviceRef, key: str, force: Vec3, basis: bool = False) -> bytes:
    """Encode a message with a force (N, service's frame); the first of a session also sets the axes of the device."""
    x, y, z = force
    entry = {"device_id": device.name, "commands": {"set_cursor_force": {key: {"x": x, "y": y, "z": z}}}}
    message: dict[str, Any] = {device.group: [entry]}
    if basis:
        message["session"] = {"configure": {"basis": {"permutation": "XYZ"}}}
    return _ENCODER.encode(message)


def parse_version(version: str) -> tuple[int, int]:
    """Return major and minor number of a version; raises DeviceError if this driver does not support it."""
    parts = version.lstrip("v").split(".")
    try:
        parsed = int(parts[0]), int(parts[1])
    except (ValueError, IndexError):
        raise DeviceError(
            f"the Inverse Service has the version '{version[:EXCERPT_CHARS]}', which is not a version number: "
            "set version under [device]"
        ) from None
    if not FIRST_SUPPORTED <= parsed < FIRST_UNSUPPORTED:
        raise DeviceError(
            f"the Inverse Service is version {version[:EXCERPT_CHARS]}; this driver supports 3.1 to 3.x "
            "but not 3.0: install such a version with the Haply Hub"
        )
    return parsed


def find_force_key(version: tuple[int, int]) -> str:
    return "vector" if version >= VECTOR_SINCE else "values"


def is_identity(mount: dict[str, Any] | None) -> bool:
    """Return True if a mount, flat or below `transform`, changes neither position, orientation nor scale.

    A missing or empty mount is the identity; a mount of unknown form is not.
    """
    transform = {} if mount is None else mount.get("transform", mount)
    return transform == {} or (
        isinstance(transform, dict)
        and transform.get("position") == {"x": 0, "y": 0, "z": 0}
        and transform.get("rotation") in ({"w": 1, "x": 0, "y": 0, "z": 0}, {"w": -1, "x": 0, "y": 0, "z": 0})
        and transform.get("scale") == {"x": 1, "y": 1, "z": 1}
    )


def format_moved(device: DeviceRef) -> str:
    return f"{device}: the service moves, turns or scales its positions: reset mount and workspace in the Haply Hub"


def format_no_state(ref: DeviceRef) -> str:
    return f"{ref}: the service lists it without a state: switch it on, wait for its light, and start again"


def shorten(message: bytes) -> str:
    return repr(message[:EXCERPT_CHARS])[1:] + ("..." if len(message) > EXCERPT_CHARS else "")


def _decode(decoder: Any, message: bytes) -> Any:
    try:
        return decoder.decode(message)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise Malformed(f"the service answered {shorten(message)}: {error}") from None


def _find_entry(state: ServiceState, ref: DeviceRef) -> tuple[Any, Any]:
    """Return the entry of a device or grip, and its state."""
    for entry in getattr(state, ref.group):
        if entry.device_id == ref.name:
            if entry.state is None:
                raise Missing(format_no_state(ref))
            return entry, entry.state
    raise Missing(f"{ref} is no longer in the service's list")


def _parse_warning(status: Status) -> str:
    if status.power_supply and status.calibrated and status.ready:
        return ""
    problems = (
        "" if status.power_supply else "it has no power supply and exerts no force",
        "" if status.calibrated else "it is not calibrated, so its position may be off: calibrate it in the Haply Hub",
        "" if status.ready else "it is not ready",
    )
    return "the Inverse Service reports: " + "; ".join(filter(None, problems))


def _parse_position(vector: Vector) -> Vec3:
    x, y, z = vector.x, vector.y, vector.z
    if x is None or y is None or z is None or not hypot(x, y, z) <= POSITION_MAX_M:
        return _NO_POSITION
    return (x, y, z)


def _parse_quaternion(turn: Rotation) -> Quaternion:
    w, x, y, z = turn.w, turn.x, turn.y, turn.z
    if w is None or x is None or y is None or z is None:
        return (nan, *_NO_POSITION)
    size = hypot(w, x, y, z)
    if not (isfinite(size) and 0.5 < size < 2.0):
        return (nan, *_NO_POSITION)
    return (w / size, x / size, y / size, z / size)
