"""A model of MuJoCo: read from its file, and its geoms as the objects of a scene.

A scene's [world] names the file. Every geom that can collide becomes an object of the same name, of our own exact
shape: it is touched by the fingers here, and by the other geoms in MuJoCo. An object of the scene file that has the
name of a geom takes its place.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input

if TYPE_CHECKING:
    import mujoco

SIZE_MAX: Final = 1 << 24
BODIES_MAX: Final = 1000


class Taken(NamedTuple):
    """A geom, and how it was taken: the object, or None and why not; `note` says what differs from MuJoCo's geom."""

    name: str
    object: schema.Object | None
    note: str


def mujoco_module() -> Any:
    """The package, which a scene with a [world] alone needs. ConfigError where it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise ConfigError(f"[world] needs MuJoCo ({error}): pip install 'softfinger[world]'") from error
    return mujoco


def read_model(path: str) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """The model of a file, as it was written and as it is simulated.

    Raises ConfigError with the file and what is wrong with it.
    """
    package, name = mujoco_module(), repr(path)[1:-1]
    try:
        text = read_input(path, SIZE_MAX).decode("utf-8-sig")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"world.model {name}: cannot be read: {reason}") from error
    _check_folders(text, Path(path), name)
    try:
        spec = package.MjSpec.from_file(path)
        model = spec.compile()
    except (ValueError, package.FatalError) as error:
        raise ConfigError(f"world.model {name}: {' '.join(str(error).split())}") from error
    if model.nbody > BODIES_MAX:
        raise ConfigError(f"world.model {name}: has {model.nbody} bodies; at most {BODIES_MAX} can be stepped in time")
    return spec, model


def _check_folders(text: str, path: Path, name: str) -> None:
    """A model is read with the files beside it and below, and no others."""
    from xml.etree import ElementTree

    if "<!ENTITY" in text:
        raise ConfigError(f"world.model {name}: declares entities, and MuJoCo knows none: write them out")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f"world.model {name}: is no XML: {error}") from error
    home = path.resolve().parent
    keys = ("file", "filename", "meshdir", "texturedir", "assetdir")
    for element in root.iter():
        for key in keys:
            given = element.get(key)
            if given and not Path(os.path.realpath(home / given.removeprefix("package://"))).is_relative_to(home):
                raise ConfigError(
                    f"world.model {name}: <{element.tag} {key}={given!r}> is outside of its folder: put the file "
                    "beside the model"
                )


def with_geoms(scene: schema.Scene) -> schema.Scene:
    """The scene with an object for each geom of its [world] that none stands for yet."""
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
    """How each geom of the model is taken, in their order. ConfigError for a model that cannot be used."""
    package = mujoco_module()
    spec, model = read_model(world.model)
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
        yield _object(name, geom.id, material, model, data)


def _material(world: schema.World, geom: Any) -> schema.Material | None:
    material = world.material
    for rule in world.geom:
        of_name = rule.name is None or rule.name == geom.name
        of_group = rule.group is None or rule.group == geom.group
        of_default = rule.default is None or (geom.classname is not None and rule.default == geom.classname.name)
        if of_name and of_group and of_default:
            material = rule.material
    return material


def _object(name: str, geom: int, material: schema.Material, model: Any, data: Any) -> Taken:
    kinds = mujoco_module().mjtGeom
    x, y, z = (float(each) for each in model.geom_size[geom])
    body = int(model.geom_bodyid[geom])
    place: dict[str, Any] = {"name": name, "material": material}
    if moves(model, body):
        place["motion"] = schema.Body(body=model.body(body).name or str(body))
        place["position_m"] = _numbers(model.geom_pos[geom])
        place["orientation_wxyz"] = _numbers(model.geom_quat[geom])
    else:
        place["position_m"] = _numbers(data.geom_xpos[geom])
        place["orientation_wxyz"] = _turned(data.xquat[body], model.geom_quat[geom])
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
    kind = kinds(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    return Taken(name, None, f"is of the type {kind}, which fingers do not touch")


def moves(model: Any, body: int) -> bool:
    """Whether a body can be anywhere else than where the model has put it."""
    at = body
    while at != 0:
        if model.body_dofnum[at] > 0 or model.body_mocapid[at] >= 0:
            return True
        at = int(model.body_parentid[at])
    return False


def _numbers(values: Any) -> Any:
    return tuple(float(each) for each in values)


def _turned(body: Any, geom: Any) -> Any:
    out = np.zeros(4)
    mujoco_module().mju_mulQuat(out, body, geom)
    return _numbers(out)
