"""What a scene and a rig may say: structs whose field names carry their unit.

An absent table is `None` for whatever is then not modelled (rolling, friction, torsion): the
contact step is compiled without it. Values are SI. Structs built in code are not range-checked;
`load.build` does that, with the ranges given here and in `limits`.

A struct may have `faults()`, for what concerns several of its fields. `load.build` calls it on the
struct as far as it could be read: a field with an unusable value holds `UNSET`, hence `known`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Final, Literal

import msgspec
from msgspec import Meta, Struct

from softfinger.config import limits

Complaint = tuple[str, Any, str]
"""Key within the struct, the value seen (UNSET: a whole table), and what is wrong with it."""

RealtimeMode = Literal["auto", "require", "off"]
RollingMethod = Literal["euler_zxz"]


def known(*values: object) -> bool:
    """Whether none of these fields was unusable in the file."""
    return not any(value is msgspec.UNSET for value in values)


def within(span: limits.Range, meaning: str, example: Any = None) -> Meta:
    """Range, meaning and example of a number; for the structs here and the drivers' options."""
    examples = None if example is None else [example]
    return Meta(ge=span.low, le=span.high, description=meaning, examples=examples, extra={"reason": span.reason})


def sized(span: limits.Range, meaning: str, example: Any = None) -> Meta:
    """Length, meaning and example of a text or a list."""
    examples = None if example is None else [example]
    return Meta(min_length=int(span.low), max_length=int(span.high), description=meaning, examples=examples)


def said(meaning: str, example: Any = None) -> Meta:
    """Meaning and example of a field that is not a single number."""
    return Meta(description=meaning, examples=None if example is None else [example])


_UNITS: Final = {
    "_nm_per_rad": "N m/rad",
    "_nm_per_s": "N m/s",
    "_ns_per_m": "N s/m",
    "_n_per_m": "N/m",
    "_n_per_s": "N/s",
    "_hz": "Hz",
    "_nm": "N m",
    "_rad": "rad",
    "_m": "m",
    "_n": "N",
    "_s": "s",
}


def unit(key: str) -> str:
    """Unit that the end of a key says, longest ending first; empty for a plain number or a text."""
    return next((name for suffix, name in _UNITS.items() if key.endswith(suffix)), "")


Coordinate = Annotated[float, Meta(ge=limits.COORDINATE_M.low, le=limits.COORDINATE_M.high)]
Component = Annotated[float, Meta(ge=limits.QUATERNION.low, le=limits.QUATERNION.high)]


class Table(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Common options of all tables."""


# --- scene ---------------------------------------------------------------------------------------


class Fingertip(Table, frozen=True, kw_only=True):
    """The rigid sphere carried by the probe."""

    radius_m: Annotated[float, within(limits.LENGTH_M, "radius of the fingertip sphere", 0.01)]


class Rolling(Table, frozen=True, kw_only=True):
    """Rolling of the fingertip over the object; without this table it does not roll."""

    method: Annotated[RollingMethod, said("how a rotation between two ticks is turned into a roll", "euler_zxz")]
    torque_stiffness_n_per_m: (
        Annotated[
            float,
            within(
                limits.STIFFNESS_N_PER_M,
                "force per length of roll the hand has not followed (k_tau); at most the coupling stiffness, which is "
                "its default and its only conservative value",
                1000.0,
            ),
        ]
        | None
    ) = None


class Coupling(Table, frozen=True, kw_only=True):
    """Tangential spring and damper between the proxy and the probe."""

    stiffness_n_per_m: Annotated[float, within(limits.STIFFNESS_N_PER_M, "tangential stiffness (K_t)", 1000.0)] = 1000.0
    damping_ns_per_m: Annotated[
        float, within(limits.DAMPING_NS_PER_M, "tangential damping (B), acting while rolling only", 1.0)
    ] = 1.0


class Probe(Table, frozen=True, kw_only=True):
    """How the measured pose is taken."""

    velocity_time_constant_s: Annotated[
        float, within(limits.TIME_CONSTANT_S, "low-pass of the probe velocity; 0 is the plain difference", 0.002)
    ] = 0.002
    position_resolution_m: Annotated[
        float, within(limits.RESOLUTION_M, "step of the device's encoders, below which a motion is noise", 1e-5)
    ] = 0.0


class Friction(Table, frozen=True, kw_only=True):
    """Coulomb friction; without this table the object is frictionless."""

    static: Annotated[float, within(limits.FRICTION, "coefficient of static friction (mu_s)", 0.6)]
    kinetic: Annotated[float, within(limits.FRICTION, "coefficient of kinetic friction (mu_d), at most static", 0.5)]

    def faults(self) -> Iterator[Complaint]:
        if known(self.static, self.kinetic) and self.kinetic > self.static:
            yield "kinetic", self.kinetic, f"must be at most static = {self.static:g}, the friction before it slides"


class Torsion(Table, frozen=True, kw_only=True):
    """Moment of a soft finger about the contact normal; without this table there is none."""

    stiffness_nm_per_rad: Annotated[float, within(limits.TORSION_NM_PER_RAD, "moment per angle of spin (k_z)", 0.05)]
    friction_length_m: Annotated[
        float,
        within(limits.FRICTION_LENGTH_M, "largest moment per normal force (mu_t); beyond it the contact spins", 0.004),
    ]


class Material(Table, frozen=True, kw_only=True):
    """What an object feels like."""

    stiffness_n_per_m: Annotated[float, within(limits.STIFFNESS_N_PER_M, "normal stiffness (K_n)", 1000.0)]
    damping_ns_per_m: Annotated[float, within(limits.DAMPING_NS_PER_M, "normal damping", 0.0)] = 0.0
    friction: Friction | None = None
    torsion: Torsion | None = None


class ObjectBase(Table, frozen=True, kw_only=True):
    """What every object has, whatever its shape. A shape adds its own dimensions and its tag."""

    shape: ClassVar[str]

    name: Annotated[str, sized(limits.NAME_LENGTH, "name of the object, unlike any other in the scene", "table")]
    position_m: Annotated[
        tuple[Coordinate, Coordinate, Coordinate], said("origin of the object's frame in the world", [0.0, 0.0, 0.0])
    ] = (0.0, 0.0, 0.0)
    orientation_wxyz: Annotated[
        tuple[Component, Component, Component, Component],
        said("quaternion w, x, y, z, object to world; normalised on load", [1.0, 0.0, 0.0, 0.0]),
    ] = (1.0, 0.0, 0.0, 0.0)
    material: Material

    def __post_init__(self) -> None:
        if not known(self.orientation_wxyz):
            return
        norm = math.hypot(*self.orientation_wxyz)
        # A quaternion that is unit to the last bits stays as it is, so that a scene survives a round trip.
        if norm > 0.0 and math.isfinite(norm) and abs(norm - 1.0) > 1e-15:
            w, x, y, z = self.orientation_wxyz
            msgspec.structs.force_setattr(self, "orientation_wxyz", (w / norm, x / norm, y / norm, z / norm))

    def faults(self) -> Iterator[Complaint]:
        if known(self.orientation_wxyz) and not any(self.orientation_wxyz):
            zero = self.orientation_wxyz
            yield "orientation_wxyz", zero, "all zero is no orientation: [1, 0, 0, 0] leaves the object unturned"
        if known(self.name) and not (self.name.isprintable() and self.name.strip()):
            yield "name", self.name, "must have printable characters only, and not blanks alone"


class Plane(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="plane"):
    """A half-space: the plane through the object's origin, outward normal its z axis."""

    shape: ClassVar[str] = "plane"


Object = Plane
"""Any object. More shapes join as a union, `Plane | Sphere`: the key `shape` tells them apart."""


class Scene(Table, frozen=True, kw_only=True):
    """What is touched and which effects are modelled."""

    fingertip: Fingertip
    rolling: Rolling | None = None
    coupling: Coupling = Coupling()
    probe: Probe = Probe()
    object: Annotated[tuple[Object, ...], sized(limits.OBJECTS, "what can be touched")]

    def faults(self) -> Iterator[Complaint]:
        yield from _coupling_faults(self)
        yield from _object_faults(self)


def _coupling_faults(scene: Scene) -> Iterator[Complaint]:
    if not known(scene.rolling, scene.coupling) or scene.rolling is None:
        return
    k_tau, k_t = scene.rolling.torque_stiffness_n_per_m, scene.coupling.stiffness_n_per_m
    if known(k_tau, k_t) and k_tau is not None and k_tau > k_t:
        yield (
            "rolling.torque_stiffness_n_per_m",
            k_tau,
            f"must be at most coupling.stiffness_n_per_m = {k_t:g} N/m, or a roll gives back more than was put in; "
            "leave it out to have the coupling's",
        )


def _object_faults(scene: Scene) -> Iterator[Complaint]:
    if not known(scene.object):
        return
    first: dict[str, int] = {}
    for index, item in enumerate(scene.object):
        if not known(item) or not known(item.name):
            continue
        if item.name in first:
            earlier = f"object[{first[item.name]}]"
            yield f"object[{index}].name", item.name, f"is the name of {earlier} already: choose another"
        first.setdefault(item.name, index)
    materials = [item.material if known(item) else msgspec.UNSET for item in scene.object]
    if scene.rolling is None or not known(scene.rolling, *materials):
        return
    if all(item.material.friction is None for item in scene.object):
        yield (
            "rolling",
            msgspec.UNSET,
            "needs friction to roll on, and no object has any: give one "
            "`friction = { static = 0.6, kinetic = 0.5 }` in its material, or leave [rolling] out",
        )


# --- rig -----------------------------------------------------------------------------------------


class DeviceConfig(Table, frozen=True, kw_only=True):
    """Which driver, and the options it has; the driver checks those with its own struct."""

    gathers: ClassVar[str] = "options"
    """All keys of [device] but `driver` go into this field."""

    driver: Annotated[str, sized(limits.NAME_LENGTH, "name of the driver", "replay")]
    options: dict[str, Any] = {}


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
