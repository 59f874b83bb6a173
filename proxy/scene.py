"""From a validated scene file to the tree the kernels are compiled for."""

from __future__ import annotations

from typing import Any

from softfinger.config import schema
from softfinger.proxy.actions import kernel_effects, kernel_motion
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.effects import start_states
from softfinger.proxy.laws import friction_laws, torsion_laws
from softfinger.proxy.state import FREE


def build_scene(scene: schema.Scene) -> model.Scene:
    """The scene as named tuples of float64; a table the file leaves out becomes None."""
    materials = _materials(scene)
    bodies = []
    for number, (thing, material) in enumerate(zip(scene.object, materials, strict=True)):
        motion, effects = kernel_motion(thing.motion), kernel_effects(thing.effect)
        for part, (shape, position, orientation) in enumerate(shape_bodies(thing)):
            shape, pose = _placed(shape, thing, position, orientation, motion)
            # Several walls of one object do together what the object does once.
            own = effects if part == 0 else ()
            made_of = material if isinstance(pose, model.Pose) else _facing(material, thing.orientation_wxyz)
            bodies.append(model.Object(shape, pose, motion, made_of, float(number), own))
    return model.Scene(
        radius=scene.fingertip.radius_m,
        objects=tuple(bodies),
        rolling=_rolling(scene),
        coupling=model.Coupling(scene.coupling.stiffness_n_per_m, scene.coupling.damping_ns_per_m),
        velocity_time_constant=scene.probe.velocity_time_constant_s,
        position_resolution=scene.probe.position_resolution_m,
        effects=kernel_effects(scene.effect),
    )


def start_state(scene: model.Scene) -> model.State:
    """State before the first pose."""
    still = model.Pose(model.ZERO, (1.0, 0.0, 0.0, 0.0))
    effects = (start_states(scene.effects), tuple(start_states(body.effects) for body in scene.objects))
    return model.State(
        started=0.0,
        time=0.0,
        position=model.ZERO,
        orientation=still.orientation,
        velocity=model.ZERO,
        mode=float(FREE),
        first=-1.0,
        second=-1.0,
        third=-1.0,
        object=still,
        center=model.ZERO,
        normal=(0.0, 0.0, 1.0),
        deflection=model.ZERO,
        rolled_part=model.ZERO,
        spin=0.0,
        slip_speed=0.0,
        slip_deflection=0.0,
        spin_slip_speed=0.0,
        spin_slip_angle=0.0,
        rolled=0.0,
        effects=effects,
    )


def _placed(
    shape: Any, thing: schema.Object, position: model.Vec3, orientation: model.Quaternion, motion: Any
) -> tuple[Any, Any]:
    """A shape and the least pose it needs: none for what stands still and can be given in the world."""
    turn = thing.orientation_wxyz  # parts are moved against their object, not turned
    moved = _rotated(thing.orientation_wxyz, position)
    at = (moved[0] + thing.position_m[0], moved[1] + thing.position_m[1], moved[2] + thing.position_m[2])
    if motion is not None:
        return shape, model.Pose(at, turn)
    if isinstance(shape, model.Plane):
        normal = _rotated(turn, shape.normal)
        return model.Plane(normal, shape.offset + sum(n * p for n, p in zip(normal, at, strict=True))), None
    if isinstance(shape, model.Sphere) or turn == (1.0, 0.0, 0.0, 0.0):
        return shape, (model.Place(at) if any(at) else None)
    return shape, model.Pose(at, turn)


def _rotated(q: model.Quaternion, v: model.Vec3) -> model.Vec3:
    """`v` (3,) turned by the unit quaternion `q`; in Python, since compiling a kernel for it would delay the start."""
    w, x, y, z = q
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    a, b, c = (sum(r * e for r, e in zip(row, v, strict=True)) for row in rows)
    return (a, b, c)


def _facing(material: model.Material, turn: model.Quaternion) -> model.Material:
    """The material of a shape that is given in the world: its directions are given there too."""
    law = material.friction
    if not isinstance(law, model.Anisotropic):
        return material
    return material._replace(friction=law._replace(direction=_rotated(turn, law.direction)))


def _materials(scene: schema.Scene) -> list[model.Material]:
    """A material for each object, all of the same parts."""
    return [
        model.Material(thing.material.stiffness_n_per_m, thing.material.damping_ns_per_m, friction, torsion)
        for thing, friction, torsion in zip(scene.object, friction_laws(scene), torsion_laws(scene), strict=True)
    ]


def shape_bodies(thing: schema.Object) -> list[tuple[Any, model.Vec3, model.Quaternion]]:
    """What an object's shape is made of: kernel shapes, each with its place (m) and turn in the object's frame.

    Most shapes are one body. The inside of a box or of a cylinder with ends is several walls that
    hold the fingertip at once, one body each.
    """
    return [(shape, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)) for shape in _kernel_shapes(thing)]


def _kernel_shapes(thing: schema.Object) -> list[Any]:
    match thing:
        case schema.Plane():
            return [model.Plane((0.0, 0.0, 1.0), 0.0)]
        case schema.Sphere():
            return [model.Sphere(thing.radius_m, _side(thing.inside))]
        case schema.Cylinder(length_m=None):
            return [model.Cylinder(thing.radius_m, _side(thing.inside))]
        case schema.Cylinder(length_m=float(length)):
            if not thing.inside:
                return [model.CappedCylinder(thing.radius_m, 0.5 * length)]
            return [model.Cylinder(thing.radius_m, -1.0), *_walls(2, 0.5 * length)]
        case schema.Capsule():
            return [model.Capsule(thing.radius_m, 0.5 * thing.length_m, _side(thing.inside))]
        case schema.Box():
            x, y, z = (0.5 * edge for edge in thing.size_m)
            if not thing.inside:
                return [model.Box((x, y, z))]
            return [*_walls(0, x), *_walls(1, y), *_walls(2, z)]
        case schema.Ellipsoid():
            return [model.Ellipsoid(thing.semi_axes_m, _side(thing.inside))]
        case schema.Torus():
            return [model.Torus(thing.major_radius_m, thing.minor_radius_m, _side(thing.inside))]
    raise TypeError(f"{type(thing).__name__} is no shape of config.schema")


def _side(inside: bool) -> float:
    return -1.0 if inside else 1.0


def _walls(axis: int, half: float) -> list[model.Plane]:
    """Two planes at +-half along an axis, facing each other."""
    return [
        model.Plane((toward if axis == 0 else 0.0, toward if axis == 1 else 0.0, toward if axis == 2 else 0.0), -half)
        for toward in (-1.0, 1.0)
    ]


def _rolling(scene: schema.Scene) -> Any:
    """The rolling method; None without one."""
    rolling = scene.rolling
    if rolling is None:
        return None
    given = rolling.torque_stiffness_n_per_m
    k_tau = scene.coupling.stiffness_n_per_m if given is None else given
    match rolling.method:
        case "euler_zxz":
            return model.EulerZxz(k_tau)
        case "euler_zyx":
            return model.EulerZyx(k_tau)
        case "rotation_vector":
            return model.RotationVector(k_tau)
        case "midpoint":
            return model.Midpoint(k_tau)
        case "montana_rk4":
            return model.MontanaRk4(k_tau)
        case "montana_rk45":
            return model.MontanaRk45(k_tau, 1e-9 if rolling.tolerance is None else rolling.tolerance)


def explain(scene: schema.Scene) -> str:
    """What is modelled and what is left out, in a line."""
    materials = [thing.material for thing in scene.object]
    parts = {
        "rolling" if scene.rolling is None else f"rolling ({scene.rolling.method})": scene.rolling is not None,
        "friction": any(material.friction is not None for material in materials),
        "torsion": any(material.torsion is not None for material in materials),
        "passivity" if scene.passivity is None else f"passivity ({scene.passivity.mode})": scene.passivity is not None,
    }
    shapes = ", ".join(thing.shape for thing in scene.object)
    have = ", ".join(name for name, present in parts.items() if present)
    lack = ", ".join(name for name, present in parts.items() if not present)
    return f"{shapes}" + (f" with {have}" if have else "") + (f"; without {lack}" if lack else "")
