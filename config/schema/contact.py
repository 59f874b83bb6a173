"""Tables of a fingertip: its shape, contact patch, rolling, coupling to the probe, the probe, and passivity."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.fields import (
    Complaint,
    Lengths,
    Orientation,
    Resolved,
    Table,
    TopicPart,
    check_orientation,
    doc,
    is_usable,
    normalise_orientation,
    sized,
    within,
)
from softfinger.config.materials import FINGERTIPS, Library


class Patch(Table, frozen=True, kw_only=True):
    """Contact patch of a soft fingertip; it determines the torsional stiffness and limit in place of the material."""

    shear_modulus_pa: Annotated[
        float, within(limits.SHEAR_MODULUS_PA, "shear modulus of the incompressible pad (G)", 45e3)
    ]
    radius_m: (
        Annotated[
            float,
            within(
                limits.PATCH_RADIUS_M,
                "patch radius at 1 N (c), in a = c (f_N / 1 N)^gamma; default: Hertz, a = (3 f_N r / 16 G)^(1/3)",
                0.004,
            ),
        ]
        | None
    ) = None
    exponent: (
        Annotated[
            float,
            within(limits.TORSION_EXPONENT, "exponent of the patch radius (gamma); needs radius_m; default: 1/3", 0.25),
        ]
        | None
    ) = None
    pressure_exponent: (
        Annotated[
            float,
            within(
                limits.PRESSURE_EXPONENT,
                "exponent of the pressure p ~ (1 - (s / a)^k)^(1/k) at the distance s from the centre (k); needs "
                "radius_m; default: 2, Hertz",
                3.0,
            ),
        ]
        | None
    ) = None
    rolling_loss: (
        Annotated[
            float,
            within(
                limits.ROLLING_LOSS,
                "share of the elastic work lost in rolling (alpha), a resistance of 3/16 alpha a f_N; default: none",
                0.3,
            ),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.radius_m) or self.radius_m is not None:
            return
        for key in ("exponent", "pressure_exponent"):
            value = getattr(self, key)
            if is_usable(value) and value is not None:
                yield key, value, "applies to a patch with radius_m, not to that of Hertz: add radius_m, or remove it"


RollingMethod = Literal["euler_zxz", "euler_zyx", "rotation_vector", "midpoint", "montana_rk4", "montana_rk45"]
StateMachine = Literal["default", "paper"]
PassivityMode = Literal["observe", "control"]


class FingertipShape(Table, frozen=True, kw_only=True):
    """Rigid body centred on the probe: a sphere or an ellipsoid."""

    library: ClassVar[Library] = FINGERTIPS
    """Fingertips that a scene may name; an entry supplies the values that the scene leaves out."""

    pad: (
        Annotated[
            str,
            sized(
                limits.NAME_LENGTH,
                "fingertip of the library; other keys of the table override its values",
                "human-index",
            ),
        ]
        | None
    ) = None
    resolved: Resolved = None
    radius_m: (
        Annotated[float, within(limits.LENGTH_M, "radius of a sphere; required without pad or radii_m", 0.01)] | None
    ) = None
    radii_m: (
        Annotated[Lengths, doc("semi-axes of an ellipsoid, in place of radius_m", [0.008, 0.007, 0.012])] | None
    ) = None
    orientation_wxyz: (
        Annotated[
            Orientation,
            doc(
                "axes of the ellipsoid in the fingertip frame: quaternion w, x, y, z, normalised on load; default: "
                "no rotation",
                [1.0, 0.0, 0.0, 0.0],
            ),
        ]
        | None
    ) = None

    def __post_init__(self) -> None:
        normalise_orientation(self)

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.radius_m, self.radii_m, self.orientation_wxyz):
            return
        low, high = limits.LENGTH_M.low, limits.LENGTH_M.high
        if self.radius_m is None and self.radii_m is None:
            fault = (
                f"is missing: give a number from {low:g} to {high:g} m, such as radius_m = 0.01, or the radii_m of an "
                "ellipsoid"
            )
            yield "radius_m", msgspec.UNSET, fault
        elif self.radii_m is None:
            if self.orientation_wxyz is not None:
                fault = "applies to an ellipsoid, but the fingertip is a sphere: remove it"
                yield "orientation_wxyz", self.orientation_wxyz, fault
        elif self.radius_m is not None:
            yield "radius_m", self.radius_m, "describes a sphere, and radii_m an ellipsoid: remove one of them"
        elif max(self.radii_m) > limits.FINGERTIP_ASPECT.high * min(self.radii_m):
            most, why = limits.FINGERTIP_ASPECT.high, limits.FINGERTIP_ASPECT.reason
            yield "radii_m", self.radii_m, f"the longest must be at most {most:g} times the shortest ({why})"
        yield from check_orientation(self.orientation_wxyz)

    @property
    def radius_range_m(self) -> tuple[float, float]:
        """Smallest and largest radius, m, of a table without faults."""
        radii = self.radii_m or (self.radius_m or 0.0,)
        return min(radii), max(radii)


class Fingertip(FingertipShape, frozen=True, kw_only=True):
    """Rigid sphere or ellipsoid, centred on the probe."""

    patch: Patch | None = None


class Rolling(Table, frozen=True, kw_only=True):
    """Rolling contact; without this table, rotating the fingertip does not move the contact."""

    method: Annotated[RollingMethod, doc("integration of the rotation between two ticks", "euler_zxz")]
    torque_stiffness_n_per_m: (
        Annotated[
            float,
            within(
                limits.STIFFNESS_N_PER_M,
                "stiffness against a roll that the hand does not follow (k_tau); default and maximum: that of the "
                "coupling, the only value that conserves energy",
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
                "montana_rk45 only: error of a sub-step relative to the fingertip radius; default: 1e-9",
                1e-9,
            ),
        ]
        | None
    ) = None
    state_machine: Annotated[
        StateMachine,
        doc("rule between rolling and sliding; paper: the published rule verbatim, for study only", "default"),
    ] = "default"

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.method, self.tolerance) and self.tolerance is not None and self.method != "montana_rk45":
            yield "tolerance", self.tolerance, f"applies to montana_rk45; {self.method} has a fixed step: remove it"


class Coupling(Table, frozen=True, kw_only=True):
    """Tangential spring and damper between the proxy and the probe, and the damper of torsion."""

    stiffness_n_per_m: Annotated[float, within(limits.STIFFNESS_N_PER_M, "tangential stiffness (K_t)", 1000.0)] = 1000.0
    damping_ns_per_m: Annotated[
        float, within(limits.DAMPING_NS_PER_M, "tangential damping (B); acts while rolling only", 1.0)
    ] = 1.0
    torsional_damping_nms_per_rad: Annotated[
        float,
        within(
            limits.TORSIONAL_DAMPING_NMS_PER_RAD,
            "damping of torsion (B_z), within the torsional limit; objects that move by themselves need it",
            0.0002,
        ),
    ] = 0.0


class Probe(Table, frozen=True, kw_only=True):
    """Filtering of the measured pose."""

    velocity_time_constant_s: Annotated[
        float, within(limits.TIME_CONSTANT_S, "low-pass filter on the probe velocity; 0: difference quotient", 0.002)
    ] = 0.002
    position_resolution_m: Annotated[
        float, within(limits.RESOLUTION_M, "resolution of the device: smaller motions count as noise", 1e-5)
    ] = 0.0


class Finger(FingertipShape, frozen=True, kw_only=True):
    """One of several fingertips, each with its own device; replaces [fingertip]."""

    name: TopicPart
    device: Annotated[TopicPart, doc("[devices.NAME] of the rig that moves it; default: its name")] | None = None
    patch: Patch | None = None
    coupling: Coupling | None = None
    probe: Probe | None = None


class Passivity(Table, frozen=True, kw_only=True):
    """Passivity observer and controller; without this table energy is not monitored."""

    mode: Annotated[
        PassivityMode, doc("observe: energy in telemetry; control: also dissipate generated energy", "control")
    ]
    damping_max_ns_per_m: (
        Annotated[float, within(limits.DAMPING_NS_PER_M, "control only: largest damping added; default: 20", 20.0)]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        damping = self.damping_max_ns_per_m
        if is_usable(self.mode, damping) and damping is not None and self.mode != "control":
            yield "damping_max_ns_per_m", damping, 'applies to mode = "control": remove it'
