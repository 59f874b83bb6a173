"""Friction laws: limits of the tangential force, and their dependence on the direction.

    remove_direction(law) -> law                                      without the directions of an anisotropic law
    compute_cone(law, normal_force, slip_speed) -> static, kinetic     largest forces of an isotropic law, N
    find_viscosity(law) -> s/m or None                              slope of its kinetic coefficient with the speed
    compute_scales(law, normal, v, breaking) -> d1, d2, s1, s2         principal directions and their scales
    measure_load(law, normal, load) -> N                          magnitude to compare with the static cone
    cut_to_limit(law, normal, longest, breaking, deflection) -> deflection, slip, length

`breaking` is 1 in the tick of the exit from the static cone; otherwise 0, which selects the kinetic cone.
"""

from math import exp, sqrt
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import AnisotropicFriction, Quaternion, SpeedFriction, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.ellipsoid import multiplier, shrink

Scales = tuple[Vec3, Vec3, float, float]
Cut = tuple[Vec3, float, float]

MIN_TANGENT_LENGTH = 1e-6
"""Length of a direction's tangential part below which it is considered parallel to the normal."""


@jit
def remove_direction(law: Any) -> Any:
    """Return the law in a direction of scale 1."""
    return law.law if isinstance(law, AnisotropicFriction) else law


@jit
def compute_cone(law: Any, normal_force: float, slip_speed: float) -> tuple[float, float]:
    """Return the limits of an isotropic law.

    SpeedFriction: mu(v) = mu_d + (mu_s - mu_d) exp(-(v / v_s)^2) + c v. Source: the general kinetic model in
    Armstrong-Helouvry, Dupont, Canudas de Wit (1994), exponent 2.
    """
    kinetic: float = law.kinetic
    if isinstance(law, SpeedFriction):
        drop = (law.static - law.kinetic) * compute_remaining_drop(law.stribeck, slip_speed)
        kinetic = law.kinetic + drop + law.viscous * slip_speed
    return law.static * normal_force, kinetic * normal_force


@jit
def compute_remaining_drop(stribeck: Any, slip_speed: float) -> float:
    """Return the fraction of the drop from static to kinetic friction that remains at a slip speed."""
    if stribeck is None or stribeck.speed <= 0.0:
        return 0.0
    ratio = slip_speed / stribeck.speed
    return exp(-ratio * ratio)


@jit
def find_viscosity(law: Any) -> Any:
    """Return the increase of an isotropic law's kinetic coefficient with the slip speed, s/m, None without one."""
    return law.viscous if isinstance(law, SpeedFriction) else None


@jit
def compute_scales(law: Any, normal: Vec3, v: Vec3, breaking: float) -> Scales:
    if isinstance(law, AnisotropicFriction):
        along = project_direction(law.direction, normal)
        across = vec3.cross(normal, along)
        if breaking != 0.0:
            return along, across, law.static_along, law.static_across
        return along, across, law.kinetic_along, law.kinetic_across
    length = vec3.norm(v)
    if length > 0.0:
        return vec3.scale(1.0 / length, v), (0.0, 0.0, 0.0), 1.0, 1.0
    return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 1.0


@jit
def cut_to_limit(law: Any, normal: Vec3, longest: float, breaking: float, deflection: Vec3) -> Cut:
    """Project radially onto a circle, which is the nearest point; never extend, so friction only resists.

    With an anisotropic law, project onto the nearest point of the ellipse: the slip is then along its normal (maximum
    dissipation).
    """
    if isinstance(law, AnisotropicFriction):
        return cut_to_ellipse(law, normal, longest, breaking, deflection)
    length = vec3.norm(deflection)
    slip = max(length - longest, 0.0)
    if slip > 0.0:
        deflection = vec3.scale(longest / length, deflection)
        length = longest
    return deflection, slip, length


@jit
def measure_load(law: Any, normal: Vec3, load: Vec3) -> float:
    if not isinstance(law, AnisotropicFriction):
        return vec3.norm(load)
    along, across, s1, s2 = compute_scales(law, normal, load, 1.0)
    a, b = vec3.dot(load, along) / s1, vec3.dot(load, across) / s2
    return sqrt(a * a + b * b)


@jit
def rotate_law(law: Any, rotation: Quaternion) -> Any:
    """Return the law with its directions rotated with the object."""
    if isinstance(law, AnisotropicFriction):
        return replace(law, "direction", rotations.rotate(rotation, law.direction))
    return law


@jit
def scale_law(law: Any, factor: float) -> Any:
    """Return the law with all its coefficients multiplied by `factor`."""
    if law is None:
        return law
    if isinstance(law, AnisotropicFriction):
        return replace(law, "law", scale_isotropic(law.law, factor))
    return scale_isotropic(law, factor)


@jit
def scale_isotropic(law: Any, factor: float) -> Any:
    scaled = replace(law, "static", factor * law.static, "kinetic", factor * law.kinetic)
    return replace(scaled, "viscous", factor * law.viscous) if isinstance(law, SpeedFriction) else scaled


# --- anisotropic -----------------------------------------------------------------------------------


@jit
def project_direction(direction: Vec3, normal: Vec3) -> Vec3:
    """Return the unit tangent along the projection of `direction`.

    If that is parallel to the normal, return the first axis of `rotations.tangent_frame`.
    """
    along = vec3.reject(direction, normal)
    length = vec3.norm(along)
    if length < MIN_TANGENT_LENGTH:
        return rotations.tangent_frame(normal)[0]
    return vec3.scale(1.0 / length, along)


@jit
def cut_to_ellipse(law: AnisotropicFriction, normal: Vec3, longest: float, breaking: float, deflection: Vec3) -> Cut:
    if longest <= 0.0:
        return (0.0, 0.0, 0.0), vec3.norm(deflection), 0.0
    along, across, s1, s2 = compute_scales(law, normal, deflection, breaking)
    x, y = vec3.dot(deflection, along) / (s1 * longest), vec3.dot(deflection, across) / (s2 * longest)
    if x * x + y * y <= 1.0:
        return deflection, 0.0, vec3.norm(deflection)
    a, b = 1.0 / (s1 * s1), 1.0 / (s2 * s2)
    m = multiplier((x, y, 0.0), (a, b, 1.0))
    x, y, _ = shrink((x, y, 0.0), (a, b, 1.0), m)
    nearest = vec3.add_scaled(vec3.scale(s1 * longest * x, along), s2 * longest * y, across)
    return nearest, vec3.norm(vec3.sub(deflection, nearest)), vec3.norm(nearest)
