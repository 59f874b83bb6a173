"""Conversion of effects and motions of a scene file to the named tuples of their kernels."""

from __future__ import annotations

from collections.abc import Iterable
from math import hypot
from typing import Any

from softfinger.config import schema
from softfinger.config.mjcf import find_body_number
from softfinger.proxy.bodies import RigidBodies
from softfinger.proxy.kernels import model


def compile_effects(effects: Iterable[schema.Effect | schema.ObjectEffect]) -> tuple[Any, ...]:
    """Return the kernel effects of the workspace or of one object, in the order of the file."""
    return tuple(_compile_effect(effect) for effect in effects)


def _compile_effect(effect: schema.Effect | schema.ObjectEffect) -> Any:
    touching = model.TouchCondition(1.0)
    match effect:
        case schema.Viscosity():
            return model.Viscosity(effect.damping_ns_per_m, _compile_region(effect.region))
        case schema.ObjectViscosity():
            return model.Viscosity(effect.damping_ns_per_m, touching)
        case schema.ConstantForce():
            return model.ConstantForce(effect.force_n, _compile_region(effect.region))
        case schema.ObjectForce():
            return model.ConstantForce(effect.force_n, touching)
        case schema.Spring():
            return model.Spring(
                effect.position_m,
                effect.stiffness_n_per_m,
                effect.rest_length_m,
                effect.force_max_n,
                _compile_region(effect.region),
            )
        case schema.Vibration():
            direction, region = _to_unit(effect.direction), _compile_region(effect.region)
            return model.Vibration(effect.amplitude_n, effect.frequency_hz, direction, region)
        case schema.ObjectVibration():
            if effect.direction is None:
                return model.NormalVibration(effect.amplitude_n, effect.frequency_hz)
            return model.Vibration(effect.amplitude_n, effect.frequency_hz, _to_unit(effect.direction), touching)
        case schema.Boundary():
            spring = effect.stiffness_n_per_m, effect.damping_ns_per_m, effect.force_max_n
            if effect.size_m is not None:
                return model.BoxBoundary(effect.position_m, _halve(effect.size_m), *spring)
            assert effect.radius_m is not None
            return model.SphereBoundary(effect.position_m, effect.radius_m, *spring)
        case schema.Magnet():
            return model.Magnet(effect.force_n, effect.range_m, effect.exponent)
        case schema.StickSlip():
            return model.StickSlip(effect.stiffness_n_per_m, effect.force_max_n)
    raise TypeError(f"{type(effect).__name__} is not an effect of config.schema")


def _compile_region(region: schema.Region | None) -> model.BoxRegion | model.SphereRegion | None:
    if region is None:
        return None
    if region.size_m is not None:
        return model.BoxRegion(region.position_m, _halve(region.size_m), region.edge_m)
    assert region.radius_m is not None
    return model.SphereRegion(region.position_m, region.radius_m, region.edge_m)


def compile_motion(motion: schema.Motion | None, bodies: RigidBodies | None = None) -> model.Motion | None:
    """Return the kernel motion of an object; None if it does not move.

    An object attached to a body needs the `bodies`.
    """
    match motion:
        case schema.Sinusoid():
            return model.NO_MOTION._replace(
                kind=model.SINUSOID, translation=motion.translation_m, axis=_to_unit(motion.axis),
                angle=motion.rotation_rad, frequency=motion.frequency_hz, phase=motion.phase_rad,
            )  # fmt: skip
        case schema.Turntable():
            axis, rate, pivot = _to_unit(motion.axis), motion.rate_rad_per_s, motion.pivot_m
            return model.NO_MOTION._replace(kind=model.TURNTABLE, axis=axis, rate=rate, pivot=pivot)
        case schema.Driven():
            return model.NO_MOTION._replace(kind=model.DRIVEN)
        case schema.Body() if bodies is not None:
            body = float(find_body_number(bodies.model, bodies.world, motion.body))
            return model.NO_MOTION._replace(kind=model.SIMULATED, block=bodies.block, body=body)
    return None


def _to_unit(v: model.Vec3) -> model.Vec3:
    length = hypot(*v)
    return (v[0] / length, v[1] / length, v[2] / length)


def _halve(v: model.Vec3) -> model.Vec3:
    return (0.5 * v[0], 0.5 * v[1], 0.5 * v[2])
