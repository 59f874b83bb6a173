"""Contact properties of an object: normal force, friction and torsion."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from softfinger.config import limits
from softfinger.config.fields import Complaint, Resolved, Table, Vector, doc, is_usable, sized, within
from softfinger.config.materials import MATERIALS, Library

TorsionModel = Literal["independent", "limit_surface", "soft_finger_proxy"]
Scale = Annotated[float, Meta(ge=limits.FRICTION_SCALE.low, le=limits.FRICTION_SCALE.high)]


class Normal(Table, frozen=True, kw_only=True):
    """Law of the normal force; without this table the force is proportional to the depth."""

    exponent: Annotated[
        float, within(limits.NORMAL_EXPONENT, "exponent (p): 1 linear, 1.5 Hertz, above 1.5 soft fingertips", 1.5)
    ] = 1.0
    depth_m: Annotated[
        float, within(limits.NORMAL_DEPTH_M, "reference depth (d): f_N = stiffness_n_per_m d (depth / d)^p", 0.001)
    ] = 0.001
    damping_s_per_m: (
        Annotated[
            float,
            within(
                limits.NORMAL_DAMPING_S_PER_M,
                "Hunt-Crossley damping (c), in place of damping_ns_per_m: f_N (1 + c v), v the penetration speed",
                0.5,
            ),
        ]
        | None
    ) = None

    def depth_under(self, force_n: float, stiffness_n_per_m: float) -> float:
        """Return the penetration depth, m, at which the static normal force has this value."""
        relative: float = (force_n / (stiffness_n_per_m * self.depth_m)) ** (1.0 / self.exponent)
        return self.depth_m * relative


class Friction(Table, frozen=True, kw_only=True):
    """Coulomb friction; without this table the object is frictionless."""

    static: Annotated[float, within(limits.FRICTION, "coefficient of static friction (mu_s)", 0.6)]
    kinetic: Annotated[float, within(limits.FRICTION, "coefficient of kinetic friction (mu_d), at most static", 0.5)]
    stribeck_speed_m_per_s: (
        Annotated[
            float,
            within(
                limits.STRIBECK_SPEED_M_PER_S,
                "speed (v_s) around which friction falls from static to kinetic; default: at once",
                0.02,
            ),
        ]
        | None
    ) = None
    viscous_s_per_m: (
        Annotated[
            float,
            within(
                limits.VISCOUS_S_PER_M,
                "viscous term (c): the coefficient rises by c times the slip speed; default: none",
                0.5,
            ),
        ]
        | None
    ) = None
    direction_x: (
        Annotated[
            Vector,
            doc(
                "first principal direction of anisotropic friction, in the object frame, projected onto the surface; "
                "default: isotropic",
                [1.0, 0.0, 0.0],
            ),
        ]
        | None
    ) = None
    static_scale: Annotated[tuple[Scale, Scale], doc("factors along direction_x and across it", [1.0, 0.5])] | None = (
        None
    )
    kinetic_scale: Annotated[tuple[Scale, Scale], doc("factors along direction_x and across it", [1.0, 0.5])] | None = (
        None
    )

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.static, self.kinetic) and self.kinetic > self.static:
            yield "kinetic", self.kinetic, f"must be at most static = {self.static:g}"
        if not is_usable(self.direction_x, self.static_scale, self.kinetic_scale):
            return
        if self.direction_x is None:
            for key in ("static_scale", "kinetic_scale"):
                if getattr(self, key) is not None:
                    yield key, getattr(self, key), "needs direction_x, the direction of its first factor"
            return
        if not any(self.direction_x):
            yield "direction_x", self.direction_x, "all zero is not a direction: [1, 0, 0] is the object's x axis"
        if is_usable(self.static, self.kinetic) and self.kinetic <= self.static:
            static, kinetic = self.static_scale or (1.0, 1.0), self.kinetic_scale or (1.0, 1.0)
            for direction, before, after in zip(("along", "across"), static, kinetic, strict=True):
                if self.kinetic * after > self.static * before:
                    fault = (
                        f"makes kinetic friction {self.kinetic * after:g} {direction}, above the static "
                        f"{self.static * before:g}: lower it, or raise static_scale"
                    )
                    yield "kinetic_scale", kinetic, fault


class Torsion(Table, frozen=True, kw_only=True):
    """Torsional friction about the contact normal; without this table there is no torsional moment."""

    stiffness_nm_per_rad: (
        Annotated[
            float,
            within(limits.TORSION_NM_PER_RAD, "torsional stiffness (k_z); required without [fingertip.patch]", 0.05),
        ]
        | None
    ) = None
    friction_length_m: (
        Annotated[
            float,
            within(
                limits.FRICTION_LENGTH_M,
                "torsional limit over normal force (mu_t); required without [fingertip.patch]",
                0.004,
            ),
        ]
        | None
    ) = None
    exponent: (
        Annotated[
            float,
            within(
                limits.TORSION_EXPONENT,
                "growth of the limit with the load (gamma): friction_length_m f_N (f_N / 1 N)^gamma; default: 0",
                0.333,
            ),
        ]
        | None
    ) = None
    model: Annotated[
        TorsionModel,
        doc(
            "independent: separate limits for force and moment; limit_surface: one common limit; soft_finger_proxy: "
            "static and kinetic torsional friction",
            "independent",
        ),
    ] = "independent"
    kinetic_friction_length_m: (
        Annotated[
            float,
            within(
                limits.FRICTION_LENGTH_M,
                "soft_finger_proxy only: the kinetic limit; at most friction_length_m, the default",
                0.003,
            ),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        kinetic, static = self.kinetic_friction_length_m, self.friction_length_m
        if not is_usable(kinetic) or kinetic is None:
            return
        if is_usable(self.model) and self.model != "soft_finger_proxy":
            fault = f'applies to model = "soft_finger_proxy", not "{self.model}": change the model, or remove it'
            yield "kinetic_friction_length_m", kinetic, fault
        elif is_usable(static) and static is None:
            yield "kinetic_friction_length_m", kinetic, "needs friction_length_m, the static limit"
        elif is_usable(static) and static is not None and kinetic > static:
            fault = f"must be at most friction_length_m = {static:g} m, the static limit"
            yield "kinetic_friction_length_m", kinetic, fault


class Material(Table, frozen=True, kw_only=True):
    """Contact properties of an object."""

    library: ClassVar[Library] = MATERIALS
    """Materials that a scene may name; an entry supplies the values that the scene leaves out."""

    name: (
        Annotated[
            str,
            sized(limits.NAME_LENGTH, "material of the library; other keys of the table override its values", "rubber"),
        ]
        | None
    ) = None
    resolved: Resolved = None
    stiffness_n_per_m: Annotated[float, within(limits.STIFFNESS_N_PER_M, "normal stiffness (K_n)", 1000.0)]
    damping_ns_per_m: Annotated[
        float,
        within(
            limits.DAMPING_NS_PER_M,
            "normal damping (B_n), Kelvin-Voigt; the total normal force is limited to 0 to twice the spring force",
            0.0,
        ),
    ] = 0.0
    shear_modulus_pa: (
        Annotated[
            float, within(limits.SHEAR_MODULUS_PA, "shear modulus, used with [fingertip.patch]; default: rigid", 600e3)
        ]
        | None
    ) = None
    normal: Normal | None = None
    friction: Friction | None = None
    torsion: Torsion | None = None

    def depth_under(self, force_n: float) -> float:
        """Return the penetration depth, m, at which the static normal force has this value."""
        if self.normal is None:
            return force_n / self.stiffness_n_per_m
        return self.normal.depth_under(force_n, self.stiffness_n_per_m)

    def stiffness_under(self, force_n: float) -> float:
        """Return the slope of the force against the depth, N/m, at that force; it decides stability."""
        exponent = 1.0 if self.normal is None else self.normal.exponent
        return exponent * force_n / self.depth_under(force_n)

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.normal) and self.normal is not None:
            ours, plain = self.normal.damping_s_per_m, self.damping_ns_per_m
            if is_usable(ours, plain) and ours is not None and plain > 0.0:
                fault = f"replaces damping_ns_per_m, which is {plain:g} N s/m: set that to 0, or remove this key"
                yield "normal.damping_s_per_m", ours, fault
        if not is_usable(self.friction, self.torsion) or self.torsion is None:
            return
        if self.torsion.model == "limit_surface" and self.friction is None:
            fault = "needs friction, with which it shares a limit: add `friction`, or use the model independent"
            yield "torsion.model", self.torsion.model, fault
