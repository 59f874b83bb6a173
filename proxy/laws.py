"""The objects' friction and torsion as kernel laws, all of one type: one law is compiled for a scene."""

from __future__ import annotations

from softfinger.config import schema
from softfinger.proxy.kernels import model

FrictionLaw = model.Friction | model.SpeedFriction | model.Anisotropic | model.PaperFriction | None
TorsionLaw = model.Torsion | model.PowerTorsion | model.LimitSurface | model.SoftFingerProxy | None

_SMOOTH = schema.Friction(static=0.0, kinetic=0.0)
_LIMP = schema.Torsion(stiffness_nm_per_rad=1.0, friction_length_m=0.0)


def friction_laws(scene: schema.Scene) -> list[FrictionLaw]:
    """A law for each object, None for all if none has friction.

    They are of the type that the richest of them needs; where an object has less, the rest of its law does
    nothing: no friction is a coefficient of 0, no Stribeck curve a speed of 0, alike in all directions a scale of 1.
    """
    given = [thing.material.friction for thing in scene.object]
    present = [friction for friction in given if friction is not None]
    if not present:
        return [None for _ in given]
    literal = scene.rolling is not None and scene.rolling.state_machine == "paper"
    curved = any(friction.stribeck_speed_m_per_s is not None for friction in present)
    viscous = any(friction.viscous_s_per_m is not None for friction in present)
    directed = any(friction.direction_x is not None for friction in present)
    laws: list[FrictionLaw] = []
    for friction in given:
        f = friction or _SMOOTH
        if literal:
            laws.append(model.PaperFriction(f.static, f.kinetic))
            continue
        law: model.Friction | model.SpeedFriction = model.Friction(f.static, f.kinetic)
        if curved or viscous:
            stribeck = model.Stribeck(f.stribeck_speed_m_per_s or 0.0) if curved else None
            law = model.SpeedFriction(f.static, f.kinetic, stribeck, f.viscous_s_per_m or 0.0)
        laws.append(_directed(law, f) if directed else law)
    return laws


def torsion_laws(scene: schema.Scene) -> list[TorsionLaw]:
    """A law for each object, None for all if none has torsion; of one type, as the friction laws are."""
    given = [thing.material.torsion for thing in scene.object]
    present = [torsion for torsion in given if torsion is not None]
    if not present:
        return [None for _ in given]
    growing = any(torsion.exponent is not None for torsion in present)
    models = {torsion.model for torsion in present}
    laws: list[TorsionLaw] = []
    for torsion in given:
        t = torsion or _LIMP
        law: model.Torsion | model.PowerTorsion = model.Torsion(t.stiffness_nm_per_rad, t.friction_length_m)
        if growing:
            law = model.PowerTorsion(t.stiffness_nm_per_rad, t.friction_length_m, t.exponent or 0.0)
        if "limit_surface" in models:
            laws.append(model.LimitSurface(law))
        elif "soft_finger_proxy" in models:
            # With the same limit for sticking and slipping this proxy is that of the independent model.
            kinetic = t.friction_length_m if t.kinetic_friction_length_m is None else t.kinetic_friction_length_m
            laws.append(model.SoftFingerProxy(law, kinetic / t.friction_length_m if t.friction_length_m > 0.0 else 1.0))
        else:
            laws.append(law)
    return laws


def _directed(law: model.Friction | model.SpeedFriction, friction: schema.Friction) -> model.Anisotropic:
    direction = friction.direction_x or (1.0, 0.0, 0.0)
    static, kinetic = friction.static_scale or (1.0, 1.0), friction.kinetic_scale or (1.0, 1.0)
    return model.Anisotropic(law, _unit(direction), *static, *kinetic)


def _unit(v: model.Vec3) -> model.Vec3:
    largest = max(abs(c) for c in v)
    if largest == 0.0:
        return (1.0, 0.0, 0.0)
    x, y, z = (c / largest for c in v)
    length = (x * x + y * y + z * z) ** 0.5
    return (x / length, y / length, z / length)
