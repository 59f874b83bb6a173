"""Loading of scenes, rigs and faults to inject: TOML to structs, with all mistakes in one error.

    scene = load_scene("paper-plane")                     # shipped
    rig = load_rig("bench.toml", {"servo.rate_hz": 500.0}, {"servo.rate_hz": "command line --rate"})

Options of a driver are not interpreted here: the driver's struct goes through `build`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from softfinger.config.arguments import check_mapping
from softfinger.config.errors import ConfigError, HapticError
from softfinger.config.fields import is_usable
from softfinger.config.overrides import CHANGES_EXAMPLE, change_values
from softfinger.config.scalars import Fault
from softfinger.config.schema import Faults, Heightmap, Mesh, Object, Rig, Scene, Textured
from softfinger.config.sources import FOLDERS, choose_folder, find, format_path, read_toml
from softfinger.config.validate import examine

T = TypeVar("T", bound=msgspec.Struct)
R = TypeVar("R")
SceneSource = str | Path | Mapping[str, Any] | Scene
"""Accepted forms of a scene: file, name of a shipped scene, mapping, or `Scene`."""

_FAULTS_LISTED_MAX: Final = 12
"""Faults listed in a message. A file with more usually repeats one mistake, and the first ones remain on the screen."""


class FaultyConfig(ConfigError):
    """ConfigError for callers that list the faults.

    faults  all of them, with their source
    config  the scene, rig or experiment with UNSET for unusable values, for further checks
    """

    def __init__(self, faults: Sequence[Fault | str], config: Any = None) -> None:
        self.faults, self.config = tuple(faults), config
        lines = [str(fault) for fault in faults[:_FAULTS_LISTED_MAX]]
        if more := len(faults) - len(lines):
            lines.append(f"and {more} more: correct these first")
        super().__init__(lines[0] if len(faults) == 1 else "\n  ".join([f"{len(faults)} faults:", *lines]))


def attempt(load: Callable[[], R], faults: list[str]) -> R | None:
    """Return the result of a function; if it raises an error, append its faults to `faults`, and return None."""
    try:
        return load()
    except FaultyConfig as error:
        faults += map(str, error.faults)
    except HapticError as error:
        faults.append(str(error))
    return None


def load_scene(
    scene: SceneSource, overrides: Mapping[str, Any] | None = None, sources: Mapping[str, str] | None = None
) -> Scene:
    """Load a scene.

    Parameters
    ----------
    scene
        File, name of a shipped scene, mapping with the contents of a file, or `Scene`.
    overrides
        Values by dotted key, which replace values of the scene. An entry of a list is selected by its index or name:
        `object.0.position_m`, `object.table.position_m`.
    sources
        Origin of each override, for the message.

    Returns
    -------
    Scene
        Files that it names are relative to the folder of the scene file, or to the working directory for a mapping. If
        the scene file is a symbolic link and a file is not in the folder of the link, it is relative to its target's.

    Raises
    ------
    ConfigError
        With every fault found, or for an override of a place that does not exist.

    Examples
    --------
    >>> from softfinger import load_scene
    >>> load_scene("sphere", {"object.sphere.radius_m": 0.03}).object[0].radius_m
    0.03
    >>> wall = {"name": "wall", "shape": "plane", "material": {"stiffness_n_per_m": 800.0}}
    >>> load_scene({"fingertip": {"radius_m": 0.008}, "object": [wall]}).fingertip.radius_m
    0.008
    >>> load_scene("sphere", {"object.sphere.radius_m": -1.0})   # doctest: +ELLIPSIS
    Traceback (most recent call last):
      ...
    softfinger.config.load.FaultyConfig: override: object[0].radius_m = -1.0: must be a number from 1e-05 to 1000 m ...
    """
    overrides = {} if overrides is None else check_mapping(overrides, "overrides", CHANGES_EXAMPLE)
    sources = {} if sources is None else sources
    if isinstance(scene, Scene):
        return apply_overrides(scene, overrides, "override") if overrides else scene
    if isinstance(scene, Mapping):
        return add_objects_of_world(build_changed(Scene, scene, "scene", overrides, sources))
    file = find(scene, Scene)
    try:
        loaded = _load(Scene, scene, overrides, sources)
    except FaultyConfig as error:
        raise FaultyConfig(error.faults, _resolve_files(file, error.config)) from error
    return add_objects_of_world(_resolve_files(file, loaded))


def load_rig(
    path_or_name: str | Path, overrides: Mapping[str, Any] | None = None, sources: Mapping[str, str] | None = None
) -> Rig:
    """Load a rig from a file, or a shipped one by name; parameters and errors as for `load_scene`.

    An override that changes `device.driver` drops the device options of the file, since they belong to another driver.
    An override of `device` applies to each [devices.NAME] of the file. Paths in [security] are relative to the folder
    of the file, as those of a scene.
    """
    rig = _load(Rig, path_or_name, {} if overrides is None else overrides, {} if sources is None else sources)
    if rig.security is None:
        return rig
    file = find(path_or_name, Rig)
    paths = {key: str(choose_folder(file, path) / path) for key, path in describe(rig.security).items()}
    return msgspec.structs.replace(rig, security=msgspec.structs.replace(rig.security, **paths))


def load_faults(path_or_name: str | Path) -> Faults:
    """Load faults to inject from a file, or shipped ones by name; raises as `load_scene`."""
    return _load(Faults, path_or_name, {}, {})


def build(struct_type: type[T], mapping: object, where: str) -> T:
    """Convert `mapping` to a `struct_type`; raises ConfigError with every fault, each naming `where` and its key."""
    value, faults = examine(struct_type, mapping, where)
    return _raise_faults(struct_type, value, faults)


def build_changed(
    struct_type: type[T], table: Mapping[str, Any], where: str, overrides: Mapping[str, Any], sources: Mapping[str, str]
) -> T:
    """Convert a mapping with overrides by dotted key, which have the origins `sources`; raises as `build`."""
    mapping, origins, override_faults = change_values(table, overrides, sources)
    value, faults = examine(struct_type, mapping, where, origins)
    # A fault of the file may be the cause of faults of overrides.
    return _raise_faults(struct_type, value, faults or override_faults)


def apply_overrides(config: T, changes: Mapping[str, Any], where: str) -> T:
    """Return `config` with changed values, keys as for `load_scene`.

    Raises ConfigError with every fault, each naming `where`.
    """
    sources = dict.fromkeys(check_mapping(changes, where, CHANGES_EXAMPLE), where)
    return build_changed(type(config), describe(config), where, changes, sources)


def describe(config: msgspec.Struct) -> dict[str, Any]:
    """Return a scene or rig as the mapping in its file; `build` is the inverse."""
    return _to_plain(msgspec.to_builtins(config))  # type: ignore[no-any-return]


def _load(
    struct_type: type[T], path_or_name: str | Path, overrides: Mapping[str, Any], sources: Mapping[str, str]
) -> T:
    path = find(path_or_name, struct_type)
    name = path.name if path.parent == FOLDERS[struct_type] else format_path(path)
    return build_changed(struct_type, read_toml(path, name), name, overrides, sources)


def add_objects_of_world(scene: Scene) -> Scene:
    """Add an object for each geom of the scene's world, and check the objects of the result against each other.

    `load_scene` does this already. Raises ConfigError for an unusable model.
    """
    if scene.world is None:
        return scene
    from softfinger.config.mjcf_geoms import with_geoms  # it needs MuJoCo

    return build(Scene, describe(with_geoms(scene)), f"{scene.world.model} in the scene")


def _resolve_files(scene_file: Path, scene: Scene) -> Scene:
    objects, world = scene.object, scene.world
    if is_usable(objects):
        objects = tuple(_resolve_path(scene_file, obj) if is_usable(obj) else obj for obj in objects)
    if is_usable(world) and world is not None and is_usable(world.model, world.root):
        folder = choose_folder(scene_file, world.model)
        root = None if world.root is None else str(folder / world.root)
        world = msgspec.structs.replace(world, model=str(folder / world.model), root=root)
    return msgspec.structs.replace(scene, object=objects, world=world)


def _resolve_path(scene_file: Path, obj: Object) -> Object:
    elastic = getattr(obj, "elastic", None)
    if is_usable(elastic) and elastic is not None and is_usable(elastic.solution) and elastic.solution is not None:
        folder = choose_folder(scene_file, elastic.solution)
        elastic = msgspec.structs.replace(elastic, solution=str(folder / elastic.solution))
        obj = msgspec.structs.replace(obj, elastic=elastic)
    if isinstance(obj, Heightmap | Mesh) and is_usable(obj.file, obj.root):
        folder = choose_folder(scene_file, obj.file)
        root = None if obj.root is None else str(folder / obj.root)
        return msgspec.structs.replace(obj, file=str(folder / obj.file), root=root)
    if isinstance(obj, Textured) and is_usable(obj.texture) and obj.texture is not None and is_usable(obj.texture.file):
        folder, texture = choose_folder(scene_file, obj.texture.file), obj.texture
        texture = msgspec.structs.replace(texture, file=str(folder / texture.file))
        return msgspec.structs.replace(obj, texture=texture)
    return obj


def _raise_faults(struct_type: type[T], value: Any, faults: Sequence[Fault]) -> T:
    if faults:
        raise FaultyConfig(faults, value)
    assert isinstance(value, struct_type)
    return value


def _to_plain(value: Any) -> Any:
    if isinstance(value, dict):
        plain = {key: _to_plain(item) for key, item in value.items() if item is not None}
        return {**plain.pop("options"), **plain} if {"driver", "options"} <= plain.keys() else plain
    return [_to_plain(item) for item in value] if isinstance(value, list | tuple) else value
