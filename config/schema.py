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
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Final, Literal

import msgspec
from msgspec import Meta, Struct

from softfinger.config import limits, materials

Complaint = tuple[str, Any, str]
"""Key within the struct, the value seen (UNSET: a whole table), and what is wrong with it."""

RealtimeMode = Literal["auto", "require", "off"]
RollingMethod = Literal["euler_zxz", "euler_zyx", "rotation_vector", "midpoint", "montana_rk4", "montana_rk45"]


StateMachine = Literal["default", "paper"]
TorsionModel = Literal["independent", "limit_surface", "soft_finger_proxy"]


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
    "_rad_per_s": "rad/s",
    "_nm_per_rad": "N m/rad",
    "_nm_per_s": "N m/s",
    "_ns_per_m": "N s/m",
    "_n_per_m": "N/m",
    "_n_per_s": "N/s",
    "_m_per_s": "m/s",
    "_s_per_m": "s/m",
    "_hz": "Hz",
    "_nm": "N m",
    "_rad": "rad",
    "_kg": "kg",
    "_ticks": "ticks",
    "_m": "m",
    "_n": "N",
    "_s": "s",
}


def unit(key: str) -> str:
    """Unit that the end of a key says, longest ending first; empty for a plain number or a text."""
    return next((name for suffix, name in _UNITS.items() if key.endswith(suffix)), "")


Coordinate = Annotated[float, Meta(ge=limits.COORDINATE_M.low, le=limits.COORDINATE_M.high)]
Length = Annotated[float, Meta(ge=limits.LENGTH_M.low, le=limits.LENGTH_M.high)]
Component = Annotated[float, Meta(ge=limits.QUATERNION.low, le=limits.QUATERNION.high)]
Inside = Annotated[bool, said("touched from inside: a hollow, and the fingertip in it", False)]


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
    tolerance: (
        Annotated[
            float,
            within(
                limits.ROLL_TOLERANCE,
                "error of a sub-step relative to the fingertip's radius; montana_rk45 only, which has 1e-9 without it",
                1e-9,
            ),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        if known(self.method, self.tolerance) and self.tolerance is not None and self.method != "montana_rk45":
            yield "tolerance", self.tolerance, f"is for montana_rk45; {self.method} takes a fixed step: leave it out"

    state_machine: Annotated[
        StateMachine,
        said("when rolling passes to sliding; paper: the paper's rule to the letter, for study only", "default"),
    ] = "default"


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


Scale = Annotated[float, Meta(ge=limits.FRICTION_SCALE.low, le=limits.FRICTION_SCALE.high)]


class Friction(Table, frozen=True, kw_only=True):
    """Coulomb friction, and what may be added to it; without this table the object is frictionless."""

    static: Annotated[float, within(limits.FRICTION, "coefficient of static friction (mu_s)", 0.6)]
    kinetic: Annotated[float, within(limits.FRICTION, "coefficient of kinetic friction (mu_d), at most static", 0.5)]
    stribeck_speed_m_per_s: (
        Annotated[
            float,
            within(
                limits.STRIBECK_SPEED_M_PER_S,
                "slip speed (v_s) over which friction falls from static to kinetic; absent: it falls at once",
                0.02,
            ),
        ]
        | None
    ) = None
    viscous_s_per_m: (
        Annotated[float, within(limits.VISCOUS_S_PER_M, "rise of the coefficient with the slip speed", 0.5)] | None
    ) = None
    direction_x: (
        Annotated[
            tuple[Component, Component, Component],
            said(
                "the direction called along, in the object's frame, laid onto the surface; absent: alike in all "
                "directions",
                [1.0, 0.0, 0.0],
            ),
        ]
        | None
    ) = None
    static_scale: (
        Annotated[tuple[Scale, Scale], said("factors of static friction along and across", [1.0, 0.5])] | None
    ) = None
    kinetic_scale: (
        Annotated[tuple[Scale, Scale], said("factors of kinetic friction along and across", [1.0, 0.5])] | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        if known(self.static, self.kinetic) and self.kinetic > self.static:
            yield "kinetic", self.kinetic, f"must be at most static = {self.static:g}, the friction before it slides"
        if not known(self.direction_x, self.static_scale, self.kinetic_scale):
            return
        if self.direction_x is None:
            for key in ("static_scale", "kinetic_scale"):
                if getattr(self, key) is not None:
                    yield key, getattr(self, key), "needs direction_x, the direction that its first factor is for"
            return
        if not any(self.direction_x):
            yield "direction_x", self.direction_x, "all zero is no direction: [1, 0, 0] is the object's x axis"
        if known(self.static, self.kinetic) and self.kinetic <= self.static:
            static, kinetic = self.static_scale or (1.0, 1.0), self.kinetic_scale or (1.0, 1.0)
            for way, before, after in zip(("along", "across"), static, kinetic, strict=True):
                if self.kinetic * after > self.static * before:
                    yield (
                        "kinetic_scale",
                        kinetic,
                        f"makes kinetic friction {self.kinetic * after:g} {way}, above the static "
                        f"{self.static * before:g}: lower it, or raise static_scale",
                    )


class Torsion(Table, frozen=True, kw_only=True):
    """Moment of a soft finger about the contact normal; without this table there is none."""

    stiffness_nm_per_rad: Annotated[float, within(limits.TORSION_NM_PER_RAD, "moment per angle of spin (k_z)", 0.05)]
    friction_length_m: Annotated[
        float,
        within(limits.FRICTION_LENGTH_M, "largest moment per normal force (mu_t); beyond it the contact spins", 0.004),
    ]
    exponent: (
        Annotated[
            float,
            within(
                limits.TORSION_EXPONENT,
                "growth of the contact patch (gamma): the largest moment is friction_length_m f_N (f_N / 1 N)^gamma",
                0.333,
            ),
        ]
        | None
    ) = None
    model: Annotated[
        TorsionModel,
        said(
            "independent: of the tangential force; limit_surface: both share one limit; soft_finger_proxy: static and "
            "kinetic torsional friction",
            "independent",
        ),
    ] = "independent"
    kinetic_friction_length_m: (
        Annotated[
            float,
            within(
                limits.FRICTION_LENGTH_M,
                "the same once it spins, for the model soft_finger_proxy; at most friction_length_m, its default",
                0.003,
            ),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        kinetic = self.kinetic_friction_length_m
        if not known(kinetic) or kinetic is None:
            return
        if known(self.model) and self.model != "soft_finger_proxy":
            yield (
                "kinetic_friction_length_m",
                kinetic,
                f'belongs to model = "soft_finger_proxy", this is "{self.model}": change the model or leave it out',
            )
        elif known(self.friction_length_m) and kinetic > self.friction_length_m:
            yield (
                "kinetic_friction_length_m",
                kinetic,
                f"must be at most friction_length_m = {self.friction_length_m:g} m, the limit before it spins",
            )


class Material(Table, frozen=True, kw_only=True):
    """What an object feels like."""

    library: ClassVar[Callable[[], Mapping[str, Mapping[str, Any]]]] = staticmethod(materials.library)
    """Materials that a scene may name; the values of the named one stand wherever it says nothing itself."""

    name: (
        Annotated[
            str, sized(limits.NAME_LENGTH, "a material of the library, whose other keys may be changed", "rubber")
        ]
        | None
    ) = None
    stiffness_n_per_m: Annotated[float, within(limits.STIFFNESS_N_PER_M, "normal stiffness (K_n)", 1000.0)]
    damping_ns_per_m: Annotated[float, within(limits.DAMPING_NS_PER_M, "normal damping", 0.0)] = 0.0
    friction: Friction | None = None
    torsion: Torsion | None = None

    def faults(self) -> Iterator[Complaint]:
        if not known(self.friction, self.torsion) or self.torsion is None:
            return
        if self.torsion.model == "limit_surface" and self.friction is None:
            yield (
                "torsion.model",
                self.torsion.model,
                "needs friction to share its limit with: give the material `friction`, or take the model independent",
            )


# --- effects -------------------------------------------------------------------------------------


Force = Annotated[float, Meta(ge=-limits.EFFECT_FORCE_N.high, le=limits.EFFECT_FORCE_N.high)]
Middle = Annotated[tuple[Coordinate, Coordinate, Coordinate], said("where its middle is in the world", [0.0, 0.0, 0.0])]
Edges = Annotated[tuple[Length, Length, Length], said("edges of a box along the axes of the world", [0.2, 0.2, 0.2])]
BallRadius = Annotated[float, within(limits.LENGTH_M, "radius of a ball in place of the box", 0.1)]
Direction = Annotated[
    tuple[Component, Component, Component], said("direction in the world; its length does not count", [0.0, 0.0, 1.0])
]
EffectDamping = Annotated[float, within(limits.DAMPING_NS_PER_M, "force against the velocity, per speed", 2.0)]
EffectStiffness = Annotated[float, within(limits.STIFFNESS_N_PER_M, "force per length", 200.0)]
ForceVector = Annotated[tuple[Force, Force, Force], said("force on the hand in the world", [0.0, 0.0, -1.0])]
Amplitude = Annotated[float, within(limits.EFFECT_FORCE_N, "amplitude of the force", 0.5)]
Frequency = Annotated[float, within(limits.FREQUENCY_HZ, "cycles per second", 100.0)]


def _extent_faults(size: object, radius: object) -> Iterator[Complaint]:
    if known(size, radius) and (size is None) == (radius is None):
        yield "radius_m", msgspec.UNSET, "give either size_m, for a box, or radius_m, for a ball"


def _direction_faults(key: str, direction: tuple[float, float, float] | None) -> Iterator[Complaint]:
    if known(direction) and direction is not None and not any(direction):
        yield key, direction, "all zero is no direction: [0, 0, 1] is the z axis"


class Region(Table, frozen=True, kw_only=True):
    """Where an effect of the workspace acts; without this table everywhere."""

    position_m: Middle = (0.0, 0.0, 0.0)
    size_m: Edges | None = None
    radius_m: BallRadius | None = None
    edge_m: Annotated[
        float, within(limits.EDGE_M, "depth inside the border at which the effect is whole; 0 is a step", 0.005)
    ] = 0.0

    def faults(self) -> Iterator[Complaint]:
        yield from _extent_faults(self.size_m, self.radius_m)


class EffectBase(Table, frozen=True, kw_only=True):
    """What every effect has: a kind, which selects its other keys."""

    kind: ClassVar[str]


class Viscosity(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="viscosity"):
    """A thick liquid: a force against the velocity of the probe."""

    kind: ClassVar[str] = "viscosity"
    damping_ns_per_m: EffectDamping
    region: Region | None = None


class ConstantForce(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="constant_force"):
    """A force that does not change: a weight, a wind."""

    kind: ClassVar[str] = "constant_force"
    force_n: ForceVector
    region: Region | None = None


class Spring(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="spring"):
    """A spring to a point of the world."""

    kind: ClassVar[str] = "spring"
    position_m: Annotated[
        tuple[Coordinate, Coordinate, Coordinate], said("the point it is fixed to, in the world", [0.0, 0.0, 0.05])
    ]
    stiffness_n_per_m: EffectStiffness
    rest_length_m: Annotated[
        float, within(limits.EDGE_M, "distance at which it neither pulls nor pushes; it pushes when nearer", 0.0)
    ] = 0.0
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "it never pulls or pushes harder", 3.0)]
    region: Region | None = None


class Vibration(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="vibration"):
    """A sinusoidal force, starting at zero."""

    kind: ClassVar[str] = "vibration"
    amplitude_n: Amplitude
    frequency_hz: Frequency
    direction: Direction
    region: Region | None = None

    def faults(self) -> Iterator[Complaint]:
        yield from _direction_faults("direction", self.direction)


class Boundary(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="boundary"):
    """The end of the workspace: a spring and damper that push the probe's centre back in."""

    kind: ClassVar[str] = "boundary"
    position_m: Middle = (0.0, 0.0, 0.0)
    size_m: Edges | None = None
    radius_m: BallRadius | None = None
    stiffness_n_per_m: EffectStiffness
    damping_ns_per_m: EffectDamping = 0.0
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "it never pushes harder", 5.0)]

    def faults(self) -> Iterator[Complaint]:
        yield from _extent_faults(self.size_m, self.radius_m)


Effect = Viscosity | ConstantForce | Spring | Vibration | Boundary
"""Any effect of the workspace."""


class ObjectViscosity(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="viscosity"):
    """A sticky film: a force against the velocity over the object, while it is touched."""

    kind: ClassVar[str] = "viscosity"
    damping_ns_per_m: EffectDamping


class ObjectForce(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="constant_force"):
    """A force that does not change, while the object is touched."""

    kind: ClassVar[str] = "constant_force"
    force_n: ForceVector


class ObjectVibration(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="vibration"):
    """A running machine: a sinusoidal force, starting at zero on touch."""

    kind: ClassVar[str] = "vibration"
    amplitude_n: Amplitude
    frequency_hz: Frequency
    direction: (
        Annotated[
            tuple[Component, Component, Component],
            said("direction in the world; left out: along the normal of the contact", [1.0, 0.0, 0.0]),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        yield from _direction_faults("direction", self.direction)


class Magnet(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="magnet"):
    """Attraction to the nearest point of the object's surface: force * (1 - gap / range)^exponent."""

    kind: ClassVar[str] = "magnet"
    force_n: Annotated[float, within(limits.EFFECT_FORCE_N, "pull at the surface, and while it is touched", 2.0)]
    range_m: Annotated[float, within(limits.LENGTH_M, "gap from which on there is no pull", 0.02)]
    exponent: Annotated[float, within(limits.EXPONENT, "how steeply the pull falls; 1 is a straight line", 2.0)] = 1.0


class StickSlip(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="stick_slip"):
    """A texture that holds the finger with a spring along the surface and lets go with a jerk."""

    kind: ClassVar[str] = "stick_slip"
    stiffness_n_per_m: EffectStiffness
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "force at which it lets go", 0.5)]


ObjectEffect = ObjectViscosity | ObjectForce | ObjectVibration | Magnet | StickSlip
"""Any effect of an object."""


# --- motions -------------------------------------------------------------------------------------


Axis = Annotated[
    tuple[Component, Component, Component],
    said("axis of the rotation in the object's frame; its length does not count", [0.0, 0.0, 1.0]),
]


class Sinusoid(Table, frozen=True, kw_only=True, tag_field="kind", tag="sinusoid"):
    """To and fro about where the object rests, in its own frame."""

    kind: ClassVar[str] = "sinusoid"
    translation_m: Annotated[
        tuple[Coordinate, Coordinate, Coordinate], said("amplitude of the way, in the object's frame", [0.0, 0.0, 0.01])
    ] = (0.0, 0.0, 0.0)
    rotation_rad: Annotated[float, within(limits.ANGLE_RAD, "amplitude of the rotation about the axis", 0.2)] = 0.0
    axis: Axis = (0.0, 0.0, 1.0)
    frequency_hz: Annotated[float, within(limits.MOTION_FREQUENCY_HZ, "cycles per second", 1.0)]
    phase_rad: Annotated[float, within(limits.ANGLE_RAD, "where in its cycle it starts", 0.0)] = 0.0

    def faults(self) -> Iterator[Complaint]:
        yield from _direction_faults("axis", self.axis)


class Turntable(Table, frozen=True, kw_only=True, tag_field="kind", tag="turntable"):
    """Turning steadily about an axis of the object."""

    kind: ClassVar[str] = "turntable"
    rate_rad_per_s: Annotated[float, within(limits.TURN_RATE_RAD_PER_S, "angular velocity, right-handed", 1.0)]
    axis: Axis = (0.0, 0.0, 1.0)
    pivot_m: Annotated[
        tuple[Coordinate, Coordinate, Coordinate],
        said("a point of the axis, in the object's frame", [0.0, 0.0, 0.0]),
    ] = (0.0, 0.0, 0.0)

    def faults(self) -> Iterator[Complaint]:
        yield from _direction_faults("axis", self.axis)


class Driven(Table, frozen=True, kw_only=True, tag_field="kind", tag="driven"):
    """Moved from outside while running, by a command or a script; it rests where its pose says until then."""

    kind: ClassVar[str] = "driven"


Motion = Sinusoid | Turntable | Driven
"""Any motion of an object."""


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
    effect: Annotated[tuple[ObjectEffect, ...], sized(limits.EFFECTS, "what it does to the hand besides")] = ()
    motion: Annotated[Motion | None, said("how it moves by itself; without this table it stands still")] = None

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

    def tight(self, fingertip_m: float) -> Iterator[Complaint]:
        """What leaves no room for a fingertip of this radius, m, on the side that is touched."""
        yield from ()


class Plane(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="plane"):
    """A half-space: the plane through the object's origin, outward normal its z axis."""

    shape: ClassVar[str] = "plane"


class Sphere(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="sphere"):
    """A sphere about the object's origin."""

    shape: ClassVar[str] = "sphere"
    radius_m: Annotated[float, within(limits.LENGTH_M, "radius of the sphere", 0.05)]
    inside: Inside = False

    def tight(self, fingertip_m: float) -> Iterator[Complaint]:
        if known(self.radius_m, self.inside) and self.inside and self.radius_m <= fingertip_m:
            yield "radius_m", self.radius_m, _too_tight(fingertip_m)


class Cylinder(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="cylinder"):
    """A cylinder about the object's z axis, centred on its origin, with flat ends or without ends."""

    shape: ClassVar[str] = "cylinder"
    radius_m: Annotated[float, within(limits.LENGTH_M, "radius of the cylinder", 0.05)]
    length_m: Annotated[float, within(limits.LENGTH_M, "from end to end; absent: no ends", 0.2)] | None = None
    inside: Inside = False

    def tight(self, fingertip_m: float) -> Iterator[Complaint]:
        if not known(self.inside) or not self.inside:
            return
        if known(self.radius_m) and self.radius_m <= fingertip_m:
            yield "radius_m", self.radius_m, _too_tight(fingertip_m)
        if known(self.length_m) and self.length_m is not None and self.length_m <= 2.0 * fingertip_m:
            yield "length_m", self.length_m, _too_tight(2.0 * fingertip_m, "diameter")


class Capsule(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="capsule"):
    """A cylinder about the object's z axis with round ends, centred on its origin."""

    shape: ClassVar[str] = "capsule"
    radius_m: Annotated[float, within(limits.LENGTH_M, "radius of the cylinder and of its ends", 0.02)]
    length_m: Annotated[float, within(limits.LENGTH_M, "between the centres of the ends", 0.1)]
    inside: Inside = False

    def tight(self, fingertip_m: float) -> Iterator[Complaint]:
        if known(self.radius_m, self.inside) and self.inside and self.radius_m <= fingertip_m:
            yield "radius_m", self.radius_m, _too_tight(fingertip_m)


class Box(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="box"):
    """A box along the object's axes, centred on its origin."""

    shape: ClassVar[str] = "box"
    size_m: Annotated[tuple[Length, Length, Length], said("full lengths of the edges along x, y, z", [0.1, 0.1, 0.04])]
    inside: Inside = False

    def tight(self, fingertip_m: float) -> Iterator[Complaint]:
        if known(self.size_m, self.inside) and self.inside and min(self.size_m) <= 2.0 * fingertip_m:
            yield "size_m", self.size_m, _too_tight(2.0 * fingertip_m, "diameter", "every edge")


class Ellipsoid(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="ellipsoid"):
    """An ellipsoid along the object's axes, centred on its origin."""

    shape: ClassVar[str] = "ellipsoid"
    semi_axes_m: Annotated[tuple[Length, Length, Length], said("half lengths along x, y, z", [0.06, 0.04, 0.03])]
    inside: Inside = False

    def tight(self, fingertip_m: float) -> Iterator[Complaint]:
        if not known(self.semi_axes_m, self.inside) or not self.inside:
            return
        sharpest = min(self.semi_axes_m) ** 2 / max(self.semi_axes_m)
        if sharpest <= fingertip_m:
            seen = f"the smallest radius of curvature, shortest^2 / longest = {sharpest:g} m,"
            yield "semi_axes_m", self.semi_axes_m, _too_tight(fingertip_m, "radius", seen)


class Torus(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="torus"):
    """A ring about the object's z axis, centred on its origin."""

    shape: ClassVar[str] = "torus"
    major_radius_m: Annotated[float, within(limits.LENGTH_M, "from the centre to the middle of the tube", 0.06)]
    minor_radius_m: Annotated[float, within(limits.LENGTH_M, "radius of the tube; below major_radius_m", 0.02)]
    inside: Inside = False

    def faults(self) -> Iterator[Complaint]:
        yield from super().faults()
        major, minor = self.major_radius_m, self.minor_radius_m
        if known(major, minor) and minor >= major:
            yield "minor_radius_m", minor, f"must be below major_radius_m = {major:g} m, or the ring has no hole"

    def tight(self, fingertip_m: float) -> Iterator[Complaint]:
        major, minor = self.major_radius_m, self.minor_radius_m
        if not known(major, minor, self.inside):
            return
        if self.inside and minor <= fingertip_m:
            yield "minor_radius_m", minor, _too_tight(fingertip_m)
        # A fingertip stuck in the hole would touch a whole circle of points at once.
        if not self.inside and minor < major <= minor + fingertip_m:
            hole = f"major_radius_m - minor_radius_m = {major - minor:g} m, the radius of the hole,"
            yield "major_radius_m", major, _too_tight(fingertip_m, "radius", hole)


def _too_tight(least_m: float, measure: str = "radius", what: str = "") -> str:
    """Why the fingertip does not fit; `least_m` is its radius or diameter."""
    room = f"must be above {least_m:g} m, the {measure} of the fingertip that has to fit in"
    return f"{what} {room}".strip() + ": widen it, or take a smaller fingertip.radius_m"


Object = Plane | Sphere | Cylinder | Capsule | Box | Ellipsoid | Torus
"""Any object: the key `shape` tells them apart."""


class Scene(Table, frozen=True, kw_only=True):
    """What is touched and which effects are modelled."""

    fingertip: Fingertip
    rolling: Rolling | None = None
    coupling: Coupling = Coupling()
    probe: Probe = Probe()
    object: Annotated[tuple[Object, ...], sized(limits.OBJECTS, "what can be touched")]
    effect: Annotated[tuple[Effect, ...], sized(limits.EFFECTS, "what the workspace does to the hand")] = ()

    def faults(self) -> Iterator[Complaint]:
        yield from _coupling_faults(self)
        yield from _object_faults(self)
        yield from _law_faults(self)
        yield from _method_faults(self)
        yield from _tight_faults(self)


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


_CLOSED_FORM: Final = ("plane", "sphere", "cylinder", "capsule", "box")
"""Shapes on which `rotation_vector` is in closed form."""


def _method_faults(scene: Scene) -> Iterator[Complaint]:
    if not known(scene.rolling, scene.object) or scene.rolling is None or scene.rolling.method != "rotation_vector":
        return
    for index, item in enumerate(scene.object):
        if known(item) and item.shape not in _CLOSED_FORM:
            yield (
                "rolling.method",
                "rotation_vector",
                f"has no closed form on object[{index}], which is of shape {item.shape}: choose montana_rk4, "
                "or midpoint for half the cost",
            )


def _tight_faults(scene: Scene) -> Iterator[Complaint]:
    if not known(scene.fingertip, scene.object) or not known(scene.fingertip.radius_m):
        return
    for index, item in enumerate(scene.object):
        if known(item):
            for key, seen, text in item.tight(scene.fingertip.radius_m):
                yield f"object[{index}].{key}", seen, text


def _law_faults(scene: Scene) -> Iterator[Complaint]:
    """Laws that cannot stand in one scene: one law is compiled for all objects."""
    if not known(scene.object, scene.rolling):
        return
    literal = scene.rolling is not None and scene.rolling.state_machine == "paper"
    coupled: dict[bool, str] = {}
    for index, item in enumerate(scene.object):
        if not known(item) or not known(item.material) or not known(item.material.friction, item.material.torsion):
            continue
        friction, torsion = item.material.friction, item.material.torsion
        where = f"object[{index}].material"
        if literal and friction is not None:
            for key in ("stribeck_speed_m_per_s", "viscous_s_per_m", "direction_x"):
                if getattr(friction, key) is not None:
                    yield f"{where}.friction.{key}", getattr(friction, key), _not_in_the_paper("Coulomb friction")
        if torsion is None or not known(torsion.model):
            continue
        if literal and torsion.model == "limit_surface":
            yield f"{where}.torsion.model", torsion.model, _not_in_the_paper("independent limits")
        coupled.setdefault(torsion.model == "limit_surface", f"object[{index}]")
        if len(coupled) > 1:
            yield (
                f"{where}.torsion.model",
                torsion.model,
                f"{coupled[torsion.model != 'limit_surface']} has another: either all objects with torsion have the "
                "model limit_surface, or none has",
            )
            return


def _not_in_the_paper(known_law: str) -> str:
    return f'rolling.state_machine = "paper" has {known_law} only: leave this out, or take the default machine'


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
