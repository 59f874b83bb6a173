"""From a validated scene file to the tree the kernels are compiled for."""

from __future__ import annotations

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels import model


def build_scene(scene: schema.Scene) -> model.Scene:
    """The scene as named tuples of float64; a table the file leaves out becomes None.

    Raises ConfigError for what the schema allows and this version does not render.
    """
    if len(scene.object) != 1:
        raise ConfigError(
            f"object: {len(scene.object)} objects in the scene, but this version renders exactly one: "
            "keep one [[object]] table"
        )
    return model.Scene(
        radius=scene.fingertip.radius_m,
        objects=tuple(_object(thing) for thing in scene.object),
        rolling=_rolling(scene),
        coupling=model.Coupling(scene.coupling.stiffness_n_per_m, scene.coupling.damping_ns_per_m),
        velocity_time_constant=scene.probe.velocity_time_constant_s,
        position_resolution=scene.probe.position_resolution_m,
    )


def _object(thing: schema.Plane) -> model.Object:
    w, x, y, z = thing.orientation_wxyz
    normal = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
    offset = sum(n * p for n, p in zip(normal, thing.position_m, strict=True))
    material = thing.material
    friction = material.friction and model.Friction(material.friction.static, material.friction.kinetic)
    torsion = material.torsion and model.Torsion(
        material.torsion.stiffness_nm_per_rad, material.torsion.friction_length_m
    )
    return model.Object(
        model.Plane(normal, offset), material.stiffness_n_per_m, material.damping_ns_per_m, friction, torsion
    )


def _rolling(scene: schema.Scene) -> model.EulerZxz | None:
    if scene.rolling is None:
        return None
    given = scene.rolling.torque_stiffness_n_per_m
    return model.EulerZxz(scene.coupling.stiffness_n_per_m if given is None else given)


def explain(scene: schema.Scene) -> str:
    """What is modelled and what is left out, in a line."""
    materials = [thing.material for thing in scene.object]
    parts = {
        "rolling" if scene.rolling is None else f"rolling ({scene.rolling.method})": scene.rolling is not None,
        "friction": any(material.friction is not None for material in materials),
        "torsion": any(material.torsion is not None for material in materials),
    }
    shapes = ", ".join(thing.shape for thing in scene.object)
    have = ", ".join(name for name, present in parts.items() if present)
    lack = ", ".join(name for name, present in parts.items() if not present)
    return f"{shapes}" + (f" with {have}" if have else "") + (f"; without {lack}" if lack else "")
