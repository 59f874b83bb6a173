"""MuJoCo models: reading of a file, and conversion of its geoms to objects of a scene.

[world] of a scene names the file. Every geom that can collide becomes an object of the same name, with one of our exact
shapes: fingers touch it here, and other geoms touch it in MuJoCo. An object of the scene file with the name of a geom
replaces the object of that geom.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.config import limits, schema
from softfinger.config.arrays.grids import Grid
from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input
from softfinger.config.mjcf_size import SIZE_MAX, check_files
from softfinger.config.urdf import complete, is_urdf

if TYPE_CHECKING:
    import mujoco

NO_MASSES: Final[Mapping[str, float]] = {}
SQUARE: Final = 1e-6
"""Relative difference of the sides of a pixel that counts as rounding of sizes in a file: 1 pixel in a million."""


class Taken(NamedTuple):
    """Geom and the object made of it; None if it cannot be touched.

    `note` gives the reason, or the difference from MuJoCo's geom.
    """

    name: str
    object: schema.Object | None
    note: str


def mujoco_module() -> Any:
    """Return the package, needed only for a scene with [world]. Raises ConfigError if it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise ConfigError(f"[world] needs MuJoCo ({error}): pip install 'softfinger[world]'") from error
    return mujoco


def read_model(path: str, mass_kg: Mapping[str, float] = NO_MASSES) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Read a model and return its specification, as in the file, and the compiled model for the simulation.

    Parameters
    ----------
    path
        MJCF or URDF file.
    mass_kg
        Masses by name of the body, which replace the model's in the simulation.

    Raises
    ------
    ConfigError
        With the file and its fault, or for a body that has no mass.
    """
    package, name = mujoco_module(), repr(path)[1:-1]
    try:
        text = read_input(path, SIZE_MAX).decode("utf-8-sig")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"world.model {name}: cannot be read: {reason}") from error
    check_files(text, Path(path), name)
    try:
        spec = package.MjSpec.from_file(path)
        if is_urdf(path):
            complete(spec, Path(path).parent)
        model = spec.compile()
        _set_masses(spec, model, mass_kg)
    except (ValueError, package.FatalError) as error:
        raise ConfigError(f"world.model {name}: {' '.join(str(error).split())}") from error
    return spec, model


def _set_masses(spec: mujoco.MjSpec, model: mujoco.MjModel, mass_kg: Mapping[str, float]) -> None:
    """Set masses of the compiled model, regardless of their origin: geoms, <inertial>, densities, a total.

    The inertia is scaled as if the density had changed. MuJoCo then computes the quantities that depend on both, except
    the damping of actuators with `dampratio`: a drive stays tuned to the model's own mass.
    """
    package = mujoco_module()
    for name, mass in mass_kg.items():
        body = package.mj_name2id(model, package.mjtObj.mjOBJ_BODY, name)
        if body <= 0 or not model.body_mass[body] > 0.0:
            names = ", ".join(model.body(each).name for each in range(1, model.nbody) if model.body_mass[each] > 0.0)
            raise ValueError(f"mass_kg: {name!r} is no body with a mass; it has {names or 'none'}")
        model.body_inertia[body] *= mass / model.body_mass[body]
        model.body_mass[body] = mass
    if mass_kg:
        package.mj_setConst(model, package.MjData(model))
        if model.nv and np.isnan(spec.stat.meaninertia):  # only the compiler computes it, unless the file gives it
            model.stat.meaninertia = model.dof_M0.mean()


def with_geoms(scene: schema.Scene) -> schema.Scene:
    """Return the scene with an object for each geom of its [world] that no object replaces."""
    if scene.world is None:
        return scene
    have = {thing.name for thing in scene.object}
    geoms = list(taken(scene.world))
    added = [each.object for each in geoms if each.object is not None and each.name not in have]
    if not scene.object and not added:
        why = "; ".join(f"{each.name} {each.note}" for each in geoms[:5]) or "it has none"
        raise ConfigError(f"world.model {scene.world.model}: no geom can be touched: {why}")
    return msgspec.structs.replace(scene, object=(*scene.object, *added))


def taken(world: schema.World) -> Iterator[Taken]:
    """Convert each geom of the model, in their order. Raises ConfigError for an unusable model."""
    package = mujoco_module()
    spec, model = read_model(world.model, world.mass_kg)
    data = package.MjData(model)
    package.mj_kinematics(model, data)
    for geom in spec.geoms:
        name = geom.name or f"geom-{geom.id}"
        if not geom.contype and not geom.conaffinity:
            yield Taken(name, None, "does not collide (contype and conaffinity are 0)")
            continue
        material = _material(world, geom)
        if material is None:
            yield Taken(name, None, "has no material: give [world.material], or a [[world.geom]] that fits it")
            continue
        source = _source(world, spec, model, geom)
        if isinstance(source, str):
            yield Taken(name, None, source)
        else:
            yield _object(name, geom.id, material, model, data, source)


def _material(world: schema.World, geom: Any) -> schema.Material | None:
    material = world.material
    for rule in world.geom:
        of_name = rule.name is None or rule.name == geom.name
        of_group = rule.group is None or rule.group == geom.group
        of_default = rule.default is None or (geom.classname is not None and rule.default == geom.classname.name)
        if of_name and of_group and of_default:
            material = rule.material
    return material


def _no_file_of_ours(mesh: Any) -> str:
    """Return why a mesh cannot be touched; empty if it can."""
    if not mesh.file.lower().endswith(schema.Mesh.endings):
        return f"is a mesh from no file that ends in {', '.join(schema.Mesh.endings)}"
    if len(set(mesh.scale)) > 1 or mesh.scale[0] <= 0.0:
        return f"is a mesh with the scale {mesh.scale.tolist()}, which has to be the same along x, y and z, and above 0"
    if any(mesh.refpos) or list(mesh.refquat) != [1.0, 0.0, 0.0, 0.0]:
        return "is a mesh with refpos or refquat: move its geom instead"
    return ""


def _source(world: schema.World, spec: Any, model: Any, geom: Any) -> dict[str, Any] | str:
    """Return the keys from a file of a geom's object, none for most geoms; or why the geom cannot be touched."""
    kinds = mujoco_module().mjtGeom
    match model.geom_type[geom.id]:
        case kinds.mjGEOM_MESH:
            mesh = spec.mesh(geom.meshname)
            folder = Path(world.model).parent / (spec.meshdir or "")
            return _no_file_of_ours(mesh) or {"file": str(folder / mesh.file), "scale": float(mesh.scale[0])}
        case kinds.mjGEOM_HFIELD:
            return _hfield(world, model, int(model.geom_dataid[geom.id]))
    return {}


def _hfield(world: schema.World, model: Any, number: int) -> dict[str, Any] | str:
    rows, columns = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
    x, y, z = (float(each) for each in model.hfield_size[number][:3])
    across, along = 2.0 * x / (columns - 1), 2.0 * y / (rows - 1)
    if abs(across - along) > SQUARE * along:
        sides = f"{across:.6g} m along x and {along:.6g} m along y"
        return f"is a height field with pixels of {sides}: make them square, by its size or by resampling"
    if rows * columns > limits.GRID_VALUES.high:
        return f"is a height field of {rows} x {columns}: {limits.GRID_VALUES.high:,} values are the most"
    return {"file": world.model, "hfield": model.hfield(number).name, "pitch_m": across, "level_m": z}


def read_hfield(path: str, name: str) -> Grid:
    """Return the elevations (rows, columns) of a model's height field, 0 to 1, as MuJoCo reads them from any file.

    Columns run along x, rows along y, lowest coordinate first. Raises ConfigError if no height field has that name.
    """
    _, model = read_model(path)
    for number in range(model.nhfield):
        if model.hfield(number).name == name:
            rows, columns = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
            first = int(model.hfield_adr[number])
            return np.array(model.hfield_data[first : first + rows * columns], np.float64).reshape(rows, columns)
    names = ", ".join(model.hfield(number).name for number in range(model.nhfield)) or "none"
    raise ConfigError(f"{path}: has no height field {name!r}; it has: {names}")


def _object(name: str, geom: int, material: schema.Material, model: Any, data: Any, source: dict[str, Any]) -> Taken:
    kinds = mujoco_module().mjtGeom
    x, y, z = (float(each) for each in model.geom_size[geom])
    body = int(model.geom_bodyid[geom])
    place: dict[str, Any] = {"name": name, "material": material}
    there = model.geom_pos[geom], model.geom_quat[geom]
    if model.geom_type[geom] == kinds.mjGEOM_MESH:  # MuJoCo stores vertices in the mesh's inertial frame
        number = model.geom_dataid[geom]
        there = _on(there, _inverse((model.mesh_pos[number], model.mesh_quat[number])))
    if moves(model, body):
        place["motion"] = schema.Body(body=model.body(body).name or str(body))
    else:
        there = _on((data.xpos[body], data.xquat[body]), there)
    place["position_m"], place["orientation_wxyz"] = map(_numbers, there)
    match model.geom_type[geom]:
        case kinds.mjGEOM_PLANE:
            return Taken(name, schema.Plane(**place), "without an end" if x or y else "")
        case kinds.mjGEOM_SPHERE:
            return Taken(name, schema.Sphere(radius_m=x, **place), "")
        case kinds.mjGEOM_CAPSULE:
            return Taken(name, schema.Capsule(radius_m=x, length_m=2.0 * y, **place), "")
        case kinds.mjGEOM_ELLIPSOID:
            return Taken(name, schema.Ellipsoid(semi_axes_m=(x, y, z), **place), "")
        case kinds.mjGEOM_CYLINDER:
            return Taken(name, schema.Cylinder(radius_m=x, length_m=2.0 * y, **place), "")
        case kinds.mjGEOM_BOX:
            return Taken(name, schema.Box(size_m=(2.0 * x, 2.0 * y, 2.0 * z), **place), "")
        case kinds.mjGEOM_HFIELD:
            return Taken(name, schema.Heightmap(**source, **place), "smooth between its heights, level beyond its rim")
        case kinds.mjGEOM_MESH:
            return Taken(name, schema.Mesh(**source, **place), "is touched as it is; other geoms meet its convex hull")
    kind = kinds(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    return Taken(name, None, f"is of the type {kind}, which fingers do not touch")


def moves(model: Any, body: int) -> bool:
    """Return whether a body can leave the pose that the model gives it."""
    at = body
    while at != 0:
        if model.body_dofnum[at] > 0 or model.body_mocapid[at] >= 0:
            return True
        at = int(model.body_parentid[at])
    return False


def _numbers(values: Any) -> Any:
    return tuple(float(each) for each in values)


def _on(outer: Any, inner: Any) -> Any:
    """Return the pose `inner`, given in the frame `outer`, in the parent frame of `outer`."""
    package, place, turn = mujoco_module(), np.zeros(3), np.zeros(4)
    package.mju_mulPose(place, turn, outer[0], outer[1], inner[0], inner[1])
    return place, turn


def _inverse(pose: Any) -> Any:
    """Return the pose of the outer frame in the inner one."""
    package, place, turn = mujoco_module(), np.zeros(3), np.zeros(4)
    package.mju_negPose(place, turn, pose[0], pose[1])
    return place, turn
