"""Conversion of the objects' normal force, friction and torsion to kernel laws.

All objects have laws of the same type, so that one law of each kind is compiled for a scene.
"""

from __future__ import annotations

from math import exp, lgamma

from softfinger.config import schema
from softfinger.proxy.kernels import model

NormalLaw = model.LinearNormal | model.PowerNormal | model.HuntCrossley
FrictionLaw = model.Friction | model.SpeedFriction | model.AnisotropicFriction | model.PaperFriction | None
TorsionLaw = model.Torsion | model.PowerTorsion | model.PatchTorsion | model.LimitSurface | model.SoftFingerProxy | None

_NO_FRICTION = schema.Friction(static=0.0, kinetic=0.0)
_NO_TORSION = schema.Torsion(stiffness_nm_per_rad=1.0, friction_length_m=0.0)


def compile_normal_laws(scene: schema.Scene) -> list[NormalLaw]:
    """Return a law for each object, of the most general type needed: a linear spring has the exponent 1."""
    pairs = [(obj.material, obj.material.normal or schema.Normal()) for obj in scene.object]
    curved = any(normal.exponent != 1.0 for _, normal in pairs)
    crossed = any(normal.damping_s_per_m is not None for _, normal in pairs)
    laws: list[NormalLaw] = []
    for material, normal in pairs:
        stiffness, damping = material.stiffness_n_per_m, material.damping_ns_per_m
        law: model.LinearNormal | model.PowerNormal = model.LinearNormal(stiffness, damping)
        if curved:
            coefficient = stiffness * normal.depth_m ** (1.0 - normal.exponent)
            law = model.PowerNormal(coefficient, normal.exponent, damping)
        laws.append(model.HuntCrossley(law, normal.damping_s_per_m or 0.0) if crossed else law)
    return laws


def compile_friction_laws(scene: schema.Scene) -> list[FrictionLaw]:
    """Return a law for each object; None for all if none has friction.

    All are of the most general type needed. The unused parameters of an object are neutral: coefficient 0 without
    friction, speed 0 without a Stribeck curve, scale 1 without a direction.
    """
    parameters = [obj.material.friction for obj in scene.object]
    present = [friction for friction in parameters if friction is not None]
    if not present:
        return [None for _ in parameters]
    literal = scene.rolling is not None and scene.rolling.state_machine == "paper"
    curved = any(friction.stribeck_speed_m_per_s is not None for friction in present)
    viscous = any(friction.viscous_s_per_m is not None for friction in present)
    directed = any(friction.direction_x is not None for friction in present)
    laws: list[FrictionLaw] = []
    for friction in parameters:
        f = friction or _NO_FRICTION
        if literal:
            laws.append(model.PaperFriction(f.static, f.kinetic))
            continue
        law: model.Friction | model.SpeedFriction = model.Friction(f.static, f.kinetic)
        if curved or viscous:
            stribeck = model.Stribeck(f.stribeck_speed_m_per_s or 0.0) if curved else None
            law = model.SpeedFriction(f.static, f.kinetic, stribeck, f.viscous_s_per_m or 0.0)
        laws.append(_make_anisotropic(law, f) if directed else law)
    return laws


def compile_torsion_laws(scene: schema.Scene) -> list[TorsionLaw]:
    """Return a law for each object, all of one type; None for all if none has torsion."""
    parameters = [obj.material.torsion for obj in scene.object]
    present = [torsion for torsion in parameters if torsion is not None]
    if not present:
        return [None for _ in parameters]
    growing = any(torsion.exponent is not None for torsion in present)
    models = {torsion.model for torsion in present}
    laws: list[TorsionLaw] = []
    for obj in scene.object:
        t, friction = obj.material.torsion or _NO_TORSION, obj.material.friction or _NO_FRICTION
        length = t.friction_length_m or 0.0
        kinetic = length if t.kinetic_friction_length_m is None else t.kinetic_friction_length_m
        share = kinetic / length if length > 0.0 else 1.0
        law: model.Torsion | model.PowerTorsion | model.PatchTorsion
        if scene.soft:
            law = model.PatchTorsion(0.0 if obj.material.torsion is None else friction.static)
            if t.friction_length_m is None and friction.static > 0.0:
                share = friction.kinetic / friction.static
        elif growing:
            law = model.PowerTorsion(t.stiffness_nm_per_rad or 1.0, length, t.exponent or 0.0)
        else:
            law = model.Torsion(t.stiffness_nm_per_rad or 1.0, length)
        if "limit_surface" in models:
            laws.append(model.LimitSurface(law))
        elif "soft_finger_proxy" in models:
            # With equal limits for sticking and slipping, this proxy is the one of the independent model.
            laws.append(model.SoftFingerProxy(law, share))
        else:
            laws.append(law)
    return laws


def compute_shear_compliances(scene: schema.Scene) -> list[float | None]:
    """Return 1/G of each object, m^2/N, 0 for a rigid one; None for all if no fingertip has a patch."""
    moduli = [obj.material.shear_modulus_pa for obj in scene.object]
    if not scene.soft:
        return [None for _ in moduli]
    return [0.0 if modulus is None else 1.0 / modulus for modulus in moduli]


def compile_patch(patch: schema.Patch | None) -> model.HertzPatch | model.PowerPatch | None:
    """Return the fingertip's patch for the kernels."""
    if patch is None:
        return None
    rolling = None if patch.rolling_loss is None else model.RollingLoss(patch.rolling_loss)
    compliance = 1.0 / patch.shear_modulus_pa
    if patch.radius_m is None:
        return model.HertzPatch(compliance, rolling)
    return model.PowerPatch(
        at_newton=patch.radius_m,
        exponent=1.0 / 3.0 if patch.exponent is None else patch.exponent,
        lever=compute_lever(2.0 if patch.pressure_exponent is None else patch.pressure_exponent),
        compliance=compliance,
        rolling=rolling,
    )


def compute_lever(k: float) -> float:
    """Return the mean distance from the centre, over the radius, of the pressure (1 - x^k)^(1/k): 3 pi/16 for k = 2.

    B(3/k, 1 + 1/k) / B(2/k, 1 + 1/k), the integrals of x^2 and of x times the pressure. Source of the family: Xydas and
    Kao (1999).
    """
    return exp(lgamma(3.0 / k) + lgamma(1.0 + 3.0 / k) - lgamma(1.0 + 4.0 / k) - lgamma(2.0 / k))


def _make_anisotropic(
    law: model.Friction | model.SpeedFriction, friction: schema.Friction
) -> model.AnisotropicFriction:
    direction = friction.direction_x or (1.0, 0.0, 0.0)
    static, kinetic = friction.static_scale or (1.0, 1.0), friction.kinetic_scale or (1.0, 1.0)
    return model.AnisotropicFriction(law, _to_unit(direction), *static, *kinetic)


def _to_unit(v: model.Vec3) -> model.Vec3:
    largest = max(abs(c) for c in v)
    if largest == 0.0:
        return (1.0, 0.0, 0.0)
    x, y, z = (c / largest for c in v)
    length = (x * x + y * y + z * z) ** 0.5
    return (x / length, y / length, z / length)
