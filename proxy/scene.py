"""Conversion of a validated scene file to the tree of named tuples for which the kernels are compiled."""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from typing import Any, NamedTuple

import numba
import numpy as np

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import apply_overrides
from softfinger.proxy.actions import compile_effects, compile_motion
from softfinger.proxy.bodies import compile_bodies
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.effects.forces import start_states
from softfinger.proxy.kernels.jit.arrays import Mutable, ReadOnly
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.numerics import mat3
from softfinger.proxy.kernels.query.container import POSE_MEMORY_SIZE
from softfinger.proxy.laws import (
    compile_friction_laws,
    compile_normal_laws,
    compile_patch,
    compile_torsion_laws,
    compute_shear_compliances,
)
from softfinger.proxy.many import make_many, search_for
from softfinger.proxy.record import FREE
from softfinger.proxy.rotation import make_matrix
from softfinger.proxy.textures import compile_texture


class Body(NamedTuple):
    """Kernel shape with its position (m) and orientation in the frame of the object of which it is a part."""

    shape: Any
    position: model.Vec3 = (0.0, 0.0, 0.0)
    orientation: model.Quaternion = (1.0, 0.0, 0.0, 0.0)


def build_scene(scene: schema.Scene, before: model.Scene | None = None) -> model.Scene:
    """Return the scene as named tuples of float64; a missing table becomes None.

    Parameters
    ----------
    scene
        Validated scene.
    before
        Scene built earlier with other parameters: the bodies of its world continue in the new one.

    Raises
    ------
    ConfigError
        If the file of a texture or a height map cannot be used.
    """
    materials, rigid = _compile_materials(scene), compile_bodies(scene, before)
    bodies = list[model.Object]()
    carriers = list[model.Carrier]()
    attached = list[float]()
    for number, (obj, material) in enumerate(zip(scene.object, materials, strict=True)):
        motion, effects = compile_motion(obj.motion, rigid), compile_effects(obj.effect)
        attached.append(0.0 if motion is None else motion.body)
        texture = compile_texture(obj)
        for part, (shape, position, orientation) in enumerate(shape_bodies(obj)):
            fixed = motion is None and texture is None
            shape, pose = _place_shape(shape, obj, position, orientation, fixed)
            if effects and part == 0:  # an object of several walls has its effects once
                carriers.append(model.Carrier(float(len(bodies)), effects))
            world_material = material if isinstance(pose, model.Pose) else _to_world(material, obj.orientation_wxyz)
            bodies.append(model.Object(shape, pose, motion, world_material, float(number), texture=texture))
    fingers, rolling = (
        tuple(_compile_finger(finger, scene.rolling) for finger in scene.fingers),
        _compile_rolling(scene),
    )
    return model.Scene(
        fingers=fingers,
        objects=make_many(bodies, tuple(carriers), fingers, rolling)
        if len(bodies) > 1 or rigid is not None
        else model.Single(bodies[0], tuple(carriers), search_for(bodies)),
        rolling=rolling,
        effects=compile_effects(scene.effect),
        bodies=None if rigid is None else rigid.kernel(tuple(attached)),
        elastic=_compile_elastic(scene, bodies),
    )


def _compile_elastic(scene: schema.Scene, bodies: list[model.Object]) -> Any:
    """Return the compliance of the only object if it is elastic, otherwise None."""
    obj = scene.elastic_object
    if obj is None or obj.elastic is None:
        return None
    from softfinger.proxy.elastic.prepared import compile_elastic

    return compile_elastic(obj, obj.elastic, bodies[0].shape.row[0])


def has_same_model(first: Any, second: Any) -> bool:
    """Return whether two scenes have the same compiled code and, of many objects, room for as many."""
    counts = (getattr(scene.objects, "size", 1.0) for scene in (first, second))
    return bool(numba.typeof(first) == numba.typeof(second)) and len(set(counts)) == 1


def describe_model_change(scene: schema.Scene, changes: Mapping[str, Any]) -> str:
    """Return a message that names the changes to a scene that require another compiled model."""
    built = build_scene(scene)
    alone = [key for key, value in changes.items() if not _keeps_model(scene, built, {key: value})]
    return f"{', '.join(alone or changes)}: that is another model, which must be compiled"


def _keeps_model(scene: schema.Scene, built: model.Scene, changes: Mapping[str, Any]) -> bool:
    """Return True if `changes` leave the model the same; False if the changed scene is invalid."""
    try:
        return has_same_model(build_scene(apply_overrides(scene, changes, "")), built)
    except ConfigError:
        return False


def _compile_finger(parts: schema.FingerParts, rolling: schema.Rolling | None) -> model.Finger:
    coupling, probe = parts.coupling, parts.probe
    k_tau = None if rolling is None else rolling.torque_stiffness_n_per_m
    return model.Finger(
        radius=parts.radius_m,
        coupling=model.Coupling(
            coupling.stiffness_n_per_m, coupling.damping_ns_per_m, coupling.torsional_damping_nms_per_rad
        ),
        torque_stiffness=coupling.stiffness_n_per_m if k_tau is None else k_tau,
        velocity_time_constant=probe.velocity_time_constant_s,
        position_resolution=probe.position_resolution_m,
        patch=compile_patch(parts.patch),
        form=None if parts.radii_m is None else model.EllipsoidTip(parts.radii_m, parts.orientation_wxyz),
    )


def start_state(scene: model.Scene) -> model.State:
    """Return the state before the first pose."""
    effects = (start_states(scene.effects), tuple(start_states(objects.effects) for objects in scene.objects.effects))
    finger = model.FingerState(
        started=0.0,
        probe=model.Probe(position=model.ZERO, orientation=(1.0, 0.0, 0.0, 0.0), velocity=model.ZERO),
        mode=float(FREE),
        center=model.ZERO,
        contacts=(model.NO_CONTACT,) * count_contacts(scene.objects),
        rolled=0.0,
        stuck_ticks=0.0,
        effects=effects,
    )
    poses = _make_memory(scene.objects)
    was = None if isinstance(scene.objects, model.Many) else poses
    world = model.World(started=0.0, time=0.0, poses=poses, last_pose=was, surfaces=_make_surfaces(scene))
    return model.State(world=world, fingers=(finger,) * len(scene.fingers))


def _make_memory(objects: model.Single | model.Many) -> Any:
    """Room for the poses of objects that can move."""
    if isinstance(objects, model.Many):
        return Mutable(np.zeros(POSE_MEMORY_SIZE * int(objects.size)))
    return None if objects.body.motion is None else objects.body.pose


def _make_surfaces(scene: model.Scene) -> Any:
    """Return the displacement under each finger before the first pose, None without an elastic object."""
    if scene.elastic is None:
        return None
    count, surface = range(len(scene.fingers)), model.Surface(model.ZERO, model.ZERO, (), model.ZERO, model.ZERO, 0.0)
    return tuple(surface._replace(inverse=tuple(mat3.IDENTITY if i == j else mat3.ZEROS for j in count)) for i in count)


def count_contacts(objects: model.Single | model.Many) -> int:
    """Return the largest number of contacts of a fingertip: 1 with one object that is not a mesh, otherwise 3."""
    return 1 if isinstance(objects, model.Single) and not isinstance(objects.body.shape, model.Mesh) else 3


def _place_shape(
    shape: Any, obj: schema.Object, position: model.Vec3, orientation: model.Quaternion, fixed: bool
) -> tuple[Any, Any]:
    """Return a shape and its simplest pose: none if it is `fixed` and can be expressed in the world frame."""
    turn = obj.orientation_wxyz  # parts are translated relative to their object, not rotated
    moved = _rotate(obj.orientation_wxyz, position)
    center = (moved[0] + obj.position_m[0], moved[1] + obj.position_m[1], moved[2] + obj.position_m[2])
    if not fixed:
        return shape, model.Pose(center, turn)
    if isinstance(shape, model.Plane):
        normal = _rotate(turn, shape.normal)
        return model.Plane(normal, shape.offset + sum(n * p for n, p in zip(normal, center, strict=True))), None
    if isinstance(shape, model.Sphere) or turn == (1.0, 0.0, 0.0, 0.0):
        return shape, (model.Place(center) if any(center) else None)
    return shape, model.Pose(center, turn)


def _rotate(q: model.Quaternion, v: model.Vec3) -> model.Vec3:
    """Rotate `v` (3,) by the unit quaternion `q`."""
    a, b, c = (sum(r * e for r, e in zip(row, v, strict=True)) for row in make_matrix(q))
    return (a, b, c)


def _to_world(material: model.Material, turn: model.Quaternion) -> model.Material:
    """Return the material of a shape expressed in the world frame, with its directions rotated there, too."""
    law = material.friction
    if not isinstance(law, model.AnisotropicFriction):
        return material
    return material._replace(friction=law._replace(direction=_rotate(turn, law.direction)))


def _compile_materials(scene: schema.Scene) -> list[model.Material]:
    """Return a material for each object, all with the same types of laws."""
    return [
        model.Material(*laws)
        for laws in zip(
            compile_normal_laws(scene),
            compile_friction_laws(scene),
            compile_torsion_laws(scene),
            compute_shear_compliances(scene),
            strict=True,
        )
    ]


@singledispatch
def shape_bodies(shape: Any) -> list[Body]:
    """Return the bodies of an object's shape. Another package registers a function for the table of its shape.

    Most shapes are one body. The inside of a box or of a cylinder with ends consists of several walls that
    can support the fingertip simultaneously, one body each.
    """
    match shape:
        case schema.Plane():
            return [Body(model.Plane((0.0, 0.0, 1.0), 0.0))]
        case schema.Sphere():
            return [Body(model.Sphere(shape.radius_m, _find_side(shape.inside)))]
        case schema.Cylinder(length_m=None):
            return [Body(model.Cylinder(shape.radius_m, _find_side(shape.inside)))]
        case schema.Cylinder(length_m=float(length), inside=False):
            return [Body(model.CappedCylinder(shape.radius_m, 0.5 * length))]
        case schema.Cylinder(length_m=float(length)):
            return [Body(model.Cylinder(shape.radius_m, -1.0)), *_make_walls(2, 0.5 * length)]
        case schema.Capsule():
            return [Body(model.Capsule(shape.radius_m, 0.5 * shape.length_m, _find_side(shape.inside)))]
        case schema.Box():
            x, y, z = (0.5 * edge for edge in shape.size_m)
            return (
                [*_make_walls(0, x), *_make_walls(1, y), *_make_walls(2, z)]
                if shape.inside
                else [Body(model.Box((x, y, z)))]
            )
        case schema.Ellipsoid():
            return [Body(model.Ellipsoid(shape.semi_axes_m, _find_side(shape.inside)))]
        case schema.Torus():
            return [Body(model.Torus(shape.major_radius_m, shape.minor_radius_m, _find_side(shape.inside)))]
        case schema.Heightmap():
            from softfinger.proxy.heightmaps import compile_heightmap, read_heights

            return [Body(compile_heightmap(read_heights(shape), shape.pitch_m))]
        case schema.Mesh():
            return _compile_mesh(shape)
    raise TypeError(f"{type(shape).__name__} is not a shape: it is not registered with shape_bodies")


def _compile_mesh(mesh: schema.Mesh) -> list[Body]:
    from softfinger.proxy.meshes.prepared import prepare_tree

    tree = prepare_tree(mesh)
    x, y, z = tree.center.tolist()
    side = _find_side(mesh.inside) if tree.closed else 0.0
    triangles = model.Triangles(
        nodes=ReadOnly(tree.nodes),
        first=ReadOnly(tree.first),
        vertices=ReadOnly(tree.vertices),
        corners=ReadOnly(tree.corners),
        across=ReadOnly(tree.across),
        upward=ReadOnly(tree.upward),
        triangle_count=float(len(tree.corners)),
        center=(x, y, z),
        size=tree.size,
        side=side,
        shade=float(mesh.shading == "normals"),
    )
    return [Body(model.Mesh(Rows([triangles])))]


def _find_side(inside: bool) -> float:
    return -1.0 if inside else 1.0


def _make_walls(axis: int, half: float) -> list[Body]:
    """Return two planes at +-half along an axis, facing each other."""
    normals = [[toward if i == axis else 0.0 for i in range(3)] for toward in (-1.0, 1.0)]
    return [Body(model.Plane((x, y, z), -half)) for x, y, z in normals]


def _compile_rolling(scene: schema.Scene) -> Any:
    rolling = scene.rolling
    if rolling is None:
        return None
    match rolling.method:
        case "euler_zxz":
            return model.EulerZxz()
        case "euler_zyx":
            return model.EulerZyx()
        case "rotation_vector":
            return model.RotationVector()
        case "midpoint":
            return model.Midpoint()
        case "montana_rk4":
            return model.MontanaRk4()
        case "montana_rk45":
            return model.MontanaRk45(1e-9 if rolling.tolerance is None else rolling.tolerance)


def explain(scene: schema.Scene) -> str:
    """Return one line that lists the modelled and the omitted parts."""
    materials = [obj.material for obj in scene.object]
    parts = {
        "rolling" if scene.rolling is None else f"rolling ({scene.rolling.method})": scene.rolling is not None,
        "friction": any(material.friction is not None for material in materials),
        "torsion": any(material.torsion is not None for material in materials),
        "passivity" if scene.passivity is None else f"passivity ({scene.passivity.mode})": scene.passivity is not None,
    }
    shapes = ", ".join(obj.shape for obj in scene.object)
    have = ", ".join(name for name, present in parts.items() if present)
    lack = ", ".join(name for name, present in parts.items() if not present)
    return f"{shapes}" + (f" with {have}" if have else "") + (f"; without {lack}" if lack else "")
