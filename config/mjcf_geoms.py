"""Geoms of a MuJoCo model as objects of a scene.

[world] of a scene names the file. Every geom that can collide becomes an object of the same name, with one of our exact
shapes: fingers touch it here, and other geoms touch it in MuJoCo. An object of the scene file with the name of a geom
replaces the object of that geom.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.config import limits, schema
from softfinger.config.errors import ConfigError
from softfinger.config.mjcf import compile_model, find_body_number, import_mujoco, read_model
from softfinger.config.mjcf_files import has_groups
from softfinger.config.schema.world import GeomMaterial
from softfinger.config.words import format_value

SQUARE_TOLERANCE: Final = 1e-6
"""Relative difference of the sides of a pixel that counts as rounding of sizes in a file: 1 pixel in a million."""
NAMES_MAX: Final = 8
"""Names of geoms listed in a message."""
CONVEX_TOLERANCE: Final = 0.01
"""Relative volume by which a convex hull exceeds a mesh that counts as convex."""


class ConvertedGeom(NamedTuple):
    """Geom and the object made of it; None if it cannot be touched.

    `note` gives the reason, or the difference from MuJoCo's geom. `is_lost`: it collides and has a material, but no
    object can be made of it.
    """

    name: str
    object: schema.Object | None
    note: str
    is_lost: bool = False


def with_geoms(scene: schema.Scene) -> schema.Scene:
    """Return the scene with an object for each geom of its [world] that no object replaces."""
    if scene.world is None:
        return scene
    model = read_model(scene.world)  # checks masses and keyframe
    for obj in scene.object:
        if isinstance(obj.motion, schema.Body):
            find_body_number(model, scene.world, obj.motion.body)
    names = {obj.name for obj in scene.object}
    geoms = list(convert_geoms(scene.world))
    added = [geom.object for geom in geoms if geom.object is not None and geom.name not in names]
    if not scene.object and not added:
        why = "; ".join(f"{geom.name} {geom.note}" for geom in geoms[:5]) or "it has none"
        raise ConfigError(f"world.model {scene.world.model}: no geom can be touched: {why}")
    return msgspec.structs.replace(scene, object=(*scene.object, *added))


def convert_geoms(world: schema.World) -> Iterator[ConvertedGeom]:
    """Convert each geom of the model, in their order, then its flexes. Raises ConfigError for an unusable model."""
    package = import_mujoco()
    spec, model, _ = compile_model(world.model, world.root)
    _check_rules(world, spec.geoms)
    data = package.MjData(model)
    package.mj_kinematics(model, data)
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    for geom in spec.geoms:
        name = geom.name or f"geom-{geom.id}"
        if not geom.contype and not geom.conaffinity and geom.id not in paired:
            yield ConvertedGeom(name, None, "does not collide (contype and conaffinity are 0, and it is in no <pair>)")
            continue
        rules = (rule.material for rule in reversed(world.geom) if _matches_rule(rule, geom))
        material = next(rules, world.material)
        if material is None:
            yield ConvertedGeom(
                name, None, "has no material: add [world.material], or a [[world.geom]] that matches it"
            )
            continue
        if geom.meshname and model.geom_type[geom.id] == package.mjtGeom.mjGEOM_MESH:
            _check_groups(name, spec, int(model.geom_dataid[geom.id]))
        yield _make_object(name, geom.id, world, material, model, data)
    for number in range(model.nflex):
        if model.flex_contype[number] or model.flex_conaffinity[number]:
            name = package.mj_id2name(model, package.mjtObj.mjOBJ_FLEX, number) or f"flex-{number}"
            yield ConvertedGeom(name, None, "is a flexible body, which fingers cannot touch", is_lost=True)


def find_ignored(scene: schema.Scene) -> list[ConvertedGeom]:
    """Return the geoms that collide and have a material, but that fingers pass through."""
    if scene.world is None:
        return []
    names = {obj.name for obj in scene.object}
    return [geom for geom in convert_geoms(scene.world) if geom.is_lost and geom.name not in names]


def _check_rules(world: schema.World, geoms: Sequence[Any]) -> None:
    """Raise ConfigError for an entry of world.geom that fits no geom: its material would be ignored."""
    for index, rule in enumerate(world.geom):
        if not any(_matches_rule(rule, geom) for geom in geoms):
            keys = [(key, getattr(rule, key)) for key in ("name", "group", "default")]
            given = ", ".join(f"{key} = {format_value(value)}" for key, value in keys if value is not None)
            names = [geom.name for geom in geoms if geom.name]
            raise ConfigError(
                f"world.geom[{index}] fits no geom of {world.model}: {given}; "
                f"it has {', '.join(names[:NAMES_MAX]) or 'none with a name'}"
            )


def _matches_rule(rule: GeomMaterial, geom: Any) -> bool:
    default = None if geom.classname is None else geom.classname.name
    keys = (rule.name, geom.name), (rule.group, geom.group), (rule.default, default)
    return all(required is None or required == actual for required, actual in keys)


def _make_object(
    name: str, geom: int, world: schema.World, material: schema.Material, model: Any, data: Any
) -> ConvertedGeom:
    kinds = import_mujoco().mjtGeom
    x, y, z = (float(size) for size in model.geom_size[geom])
    body, number = int(model.geom_bodyid[geom]), int(model.geom_dataid[geom])
    place: dict[str, Any] = {"name": name, "material": material}
    pose = model.geom_pos[geom], model.geom_quat[geom]
    if can_move(model, body):
        place["motion"] = schema.Body(body=model.body(body).name or str(body))
    else:
        pose = _on((data.xpos[body], data.xquat[body]), pose)
    place["position_m"], place["orientation_wxyz"] = (tuple(map(float, part)) for part in pose)
    match model.geom_type[geom]:
        case kinds.mjGEOM_PLANE:
            return ConvertedGeom(name, schema.Plane(**place), "without an end" if x or y else "")
        case kinds.mjGEOM_SPHERE:
            return ConvertedGeom(name, schema.Sphere(radius_m=x, **place), "")
        case kinds.mjGEOM_CAPSULE:
            return ConvertedGeom(name, schema.Capsule(radius_m=x, length_m=2.0 * y, **place), "")
        case kinds.mjGEOM_ELLIPSOID:
            return ConvertedGeom(name, schema.Ellipsoid(semi_axes_m=(x, y, z), **place), "")
        case kinds.mjGEOM_CYLINDER:
            return ConvertedGeom(name, schema.Cylinder(radius_m=x, length_m=2.0 * y, **place), "")
        case kinds.mjGEOM_BOX:
            return ConvertedGeom(name, schema.Box(size_m=(2.0 * x, 2.0 * y, 2.0 * z), **place), "")
        case kinds.mjGEOM_HFIELD:
            source = _read_hfield(world, model, number)
            if isinstance(source, str):
                return ConvertedGeom(name, None, source, is_lost=True)
            return ConvertedGeom(
                name, schema.Heightmap(**source, **place), "smooth between its heights, flat beyond its border"
            )
        case kinds.mjGEOM_MESH:
            source = {"file": world.model, "root": world.root, "mesh": model.mesh(number).name}
            return ConvertedGeom(name, schema.Mesh(**source, **place), _describe_hull(model, number))
    kind = kinds(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    return ConvertedGeom(name, None, f"is of type {kind}, which fingers cannot touch", is_lost=True)


def _check_groups(name: str, spec: Any, number: int) -> None:
    file = next((mesh.file for mesh in spec.meshes if mesh.id == number), "")
    if file.lower().endswith(".obj") and has_groups(file):
        raise ConfigError(
            f"geom {name!r}: {file} has faces in several groups, but MuJoCo reads only the first: export it without "
            "groups"
        )


def _describe_hull(model: Any, number: int) -> str:
    """Return how a mesh differs from its convex hull, with which other geoms collide; empty if it is convex."""
    first, graph = int(model.mesh_vertadr[number]), int(model.mesh_graphadr[number])
    face = int(model.mesh_faceadr[number])
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[number]].astype(np.float64)
    mesh = _compute_volume(vertices, model.mesh_face[face : face + model.mesh_facenum[number]])
    if graph < 0:  # no other geom collides with it
        return ""
    corners, faces = (int(count) for count in model.mesh_graph[graph : graph + 2])
    start = graph + 2 + 3 * corners + 3 * faces  # after numbers of vertices and faces, vertices, edges
    hull = _compute_volume(vertices, model.mesh_graph[start : start + 3 * faces].reshape(-1, 3))
    if hull <= (1.0 + CONVEX_TOLERANCE) * mesh:
        return ""
    larger = f", which has {hull / mesh:.3g} times its volume" if mesh > 0.0 else ""
    return f"has its own shape for fingers; other geoms collide with its convex hull{larger}"


def _compute_volume(vertices: Any, faces: Any) -> float:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def _read_hfield(world: schema.World, model: Any, number: int) -> dict[str, Any] | str:
    rows, columns = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
    x, y, z = (float(size) for size in model.hfield_size[number][:3])
    across, along = 2.0 * x / (columns - 1), 2.0 * y / (rows - 1)
    if abs(across - along) > SQUARE_TOLERANCE * along:
        sides = f"{across:.6g} m along x and {along:.6g} m along y"
        return f"is a height field with pixels of {sides}: must be square; change its size, or resample it"
    if rows * columns > limits.GRID_VALUES.high:
        return f"is a height field of {rows} x {columns}: at most {limits.GRID_VALUES.high:,} values are allowed"
    source = {"file": world.model, "root": world.root, "hfield": model.hfield(number).name}
    return source | {"pitch_m": across, "level_m": z}


def can_move(model: Any, body: int) -> bool:
    """Return whether a body can leave the pose that the model gives it."""
    at = body
    while at != 0:
        if model.body_dofnum[at] > 0 or model.body_mocapid[at] >= 0:
            return True
        at = int(model.body_parentid[at])
    return False


def _on(outer: Any, inner: Any) -> Any:
    """Return the pose `inner`, given in the frame `outer`, in the parent frame of `outer`."""
    package, place, turn = import_mujoco(), np.zeros(3), np.zeros(4)
    package.mju_mulPose(place, turn, outer[0], outer[1], inner[0], inner[1])
    return place, turn
