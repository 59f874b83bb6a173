"""Loading of scenes, rigs and faults to inject: TOML to structs, with all mistakes in one error.

    scene = load_scene("paper-plane")                     # shipped
    rig = load_rig("bench.toml", {"servo.rate_hz": 500.0}, {"servo.rate_hz": "command line --rate"})

Options of a driver are not interpreted here: the driver's struct goes through `build`.
"""

from __future__ import annotations

import copy
import errno
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input
from softfinger.config.materials import FINGERTIPS, MATERIALS
from softfinger.config.schema import Faults, Heightmap, Mesh, Object, Rig, Scene, Textured
from softfinger.config.toml import parse_toml
from softfinger.config.validate import Fault, examine
from softfinger.config.words import near, shown

T = TypeVar("T", bound=msgspec.Struct)
SceneSource = str | Path | Mapping[str, Any] | Scene
"""Accepted forms of a scene: file, name of a shipped scene, mapping, or `Scene`."""

_HERE: Final = Path(__file__).resolve().parent
FOLDERS: Final[Mapping[type[msgspec.Struct], Path]] = {
    Scene: _HERE / "scenes",
    Rig: _HERE / "rigs",
    Faults: _HERE / "faults",
}
EXPERIMENTS: Final = _HERE / "experiments"
_KINDS: Final[Mapping[type[msgspec.Struct], str]] = {Scene: "scene", Rig: "rig", Faults: "file of faults"}
_SIZE_MAX: Final = 1 << 20
_BY_NAME: Final = {"material": MATERIALS.key, "fingertip": FINGERTIPS.key}
"""Tables that a text may replace, with the key that the text becomes the value of."""
_ENTRY: Final = re.compile(r"\[(\d+)\]")
_LISTED: Final = 12
"""Faults listed in a message. A file with more usually repeats one mistake, and the first ones remain on the screen."""
_NUMBER: Final = re.compile(r"\.(\d+)(?=\.|$)")


class FaultyConfig(ConfigError):
    """ConfigError with the single faults in `faults`, for callers that list them."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        lines = [str(fault) for fault in faults[:_LISTED]]
        if more := len(faults) - len(lines):
            lines.append(f"and {more} more: mend these first")
        super().__init__(lines[0] if len(faults) == 1 else "\n  ".join([f"{len(faults)} faults:", *lines]))


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
        Files that it names are relative to the folder of the scene file, or to the working directory for a mapping.

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
    if isinstance(scene, Scene):
        return overridden(scene, overrides, "override") if overrides else scene
    if isinstance(scene, Mapping):
        return completed(_with_overrides(Scene, scene, "scene", overrides or {}, sources or {}))
    loaded = _load(Scene, scene, overrides or {}, sources or {})
    folder = find(scene, Scene).parent
    things = tuple(_beside(folder, thing) for thing in loaded.object)
    world = loaded.world
    if world is not None:
        root = None if world.root is None else str(folder / world.root)
        world = msgspec.structs.replace(world, model=str(folder / world.model), root=root)
    return completed(msgspec.structs.replace(loaded, object=things, world=world))


def load_rig(
    path_or_name: str | Path, overrides: Mapping[str, Any] | None = None, sources: Mapping[str, str] | None = None
) -> Rig:
    """Load a rig from a file, or a shipped one by name; parameters and errors as for `load_scene`.

    An override that changes `device.driver` drops the device options of the file, since they belong to another driver.
    An override of `device` applies to each [devices.NAME] of the file. Paths in [security] are relative to the folder
    of the file.
    """
    rig = _load(Rig, path_or_name, overrides or {}, sources or {})
    if rig.security is None:
        return rig
    folder = find(path_or_name, Rig).parent
    paths = {key: str(folder / path) for key, path in describe(rig.security).items()}
    return msgspec.structs.replace(rig, security=msgspec.structs.replace(rig.security, **paths))


def load_faults(path_or_name: str | Path) -> Faults:
    """Load faults to inject from a file, or shipped ones by name; raises as `load_scene`."""
    return _load(Faults, path_or_name, {}, {})


def build(struct_type: type[T], mapping: object, where: str) -> T:
    """Convert `mapping` to a `struct_type`; raises ConfigError with every fault, each naming `where` and its key."""
    return _built(struct_type, mapping, where, {})


def overridden(config: T, changes: Mapping[str, Any], where: str) -> T:
    """Return `config` with changed values, keys as for `load_scene`.

    Raises ConfigError with every fault, each naming `where`.
    """
    return _with_overrides(type(config), describe(config), where, changes, dict.fromkeys(changes, where))


def numbered(mapping: Mapping[str, Any], dotted: str) -> str:
    """Return a key of `load_scene` with the index of an entry in place of its name: `object.0` for `object.table`."""
    head, _, rest = dotted.partition(".")
    entries = mapping.get(head)
    if isinstance(entries, list | tuple) and not rest.partition(".")[0].isdecimal():
        names = [(str(each.get("name", "")), place) for place, each in enumerate(entries) if isinstance(each, Mapping)]
        for name, place in sorted(names, key=lambda each: -len(each[0])):  # names may contain dots
            if name and (rest == name or rest.startswith(f"{name}.")):
                return f"{head}.{place}{rest[len(name) :]}"
    return dotted


def value_at(mapping: Any, dotted: str) -> Any:
    """Return the value of a mapping at a key of `load_scene`, with entries by index; None if it has no value."""
    for name in _ENTRY.sub(r".\1", dotted).split("."):
        if isinstance(mapping, list):
            mapping = mapping[int(name)]
        elif isinstance(mapping, dict):
            mapping = mapping.get(name)
    return mapping


def describe(config: msgspec.Struct) -> dict[str, Any]:
    """Return a scene or rig as the mapping in its file; `build` is the inverse."""
    return _plain(msgspec.to_builtins(config))  # type: ignore[no-any-return]


def shipped(struct_type: type[msgspec.Struct]) -> list[str]:
    """Return the names of the shipped files of a kind."""
    return names_in(FOLDERS[struct_type])


def names_in(folder: Path) -> list[str]:
    """Return the names of the files in a folder of shipped files."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def find(path_or_name: str | Path, struct_type: type[msgspec.Struct]) -> Path:
    """Return the path of a scene, rig or file of faults: see `find_in`."""
    return find_in(FOLDERS[struct_type], _KINDS[struct_type], path_or_name)


def find_in(folder: Path, kind: str, path_or_name: str | Path) -> Path:
    """Return the path of a file; shipped files of its kind are in `folder`.

    A text without a folder and without .toml names a shipped file or, if there is none, an existing file. Raises
    ConfigError if it is neither. Any other path need not exist.
    """
    path = Path(path_or_name)
    if isinstance(path_or_name, Path) or path.name != path_or_name or path.suffix == ".toml":
        return path
    names = names_in(folder)
    if path_or_name in names:
        return folder / f"{path_or_name}.toml"
    try:
        if path.exists():
            return path
    except (OSError, ValueError):
        pass
    own = f"my-{kind.split()[-1]}.toml"
    raise ConfigError(
        f"no {kind} is called {shown(path_or_name)}{near(path_or_name, names)}; "
        f"shipped are {', '.join(names)}; give the path of another file with its suffix, such as {own}"
    )


def read_toml(path: str | Path, where: str | None = None) -> dict[str, Any]:
    """Read the tables of a TOML file; raises ConfigError with the file, and line and column of a syntax error."""
    name = _named(path) if where is None else where
    return parse_toml(_text(Path(path), name), name)


def _text(path: Path, name: str) -> str:
    try:
        data = read_input(path, _SIZE_MAX)
    except FileNotFoundError as error:
        raise ConfigError(f"{name}: no such file{_sibling(path)}") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{name}: is a folder: name a .toml file in it") from error
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno == errno.EFBIG:
            raise ConfigError(f"{name}: larger than {_SIZE_MAX} bytes: this is no scene or rig") from error
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"{name}: cannot be read: {reason}") from error
    try:
        return data.decode("utf-8-sig")  # editors on Windows put a byte order mark in front
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            f"{name}: not UTF-8: byte 0x{data[error.start]:02x} at line {line}: save the file as UTF-8"
        ) from error


def _named(path: str | Path) -> str:
    """Return a path for messages: complete, and on one line even with control characters."""
    return repr(str(path))[1:-1]


def _sibling(path: Path) -> str:
    """Return a hint for a missing file: a similar name in its folder, or a shipped name."""
    try:
        beside = [found.name for found in path.parent.glob("*.toml")]
    except (OSError, ValueError):
        beside = []
    hint = near(path.name, beside)
    names = [name for kind in FOLDERS for name in shipped(kind)]
    if not hint and path.suffix == ".toml":
        hint = near(path.stem, names)
        hint += " (shipped; named without folder and ending)" if hint else ""
    return hint


def _load(
    struct_type: type[T], path_or_name: str | Path, overrides: Mapping[str, Any], sources: Mapping[str, str]
) -> T:
    path = find(path_or_name, struct_type)
    name = path.name if path.parent == FOLDERS[struct_type] else _named(path)
    return _with_overrides(struct_type, read_toml(path, name), name, overrides, sources)


def _with_overrides(
    struct_type: type[T], given: Mapping[str, Any], where: str, overrides: Mapping[str, Any], sources: Mapping[str, str]
) -> T:
    mapping, origins, homeless = copy.deepcopy(dict(given)), dict[str, str](), []
    ways = {dotted: numbered(mapping, dotted) for dotted in overrides}
    if len(set(ways.values())) < len(ways):
        source = sources.get(next(iter(ways)), "override")
        raise ConfigError(f"{source}: a value is given twice, by a name and by its number")
    for dotted in sorted(overrides, key=lambda key: key != "device.driver"):
        source = sources.get(dotted, "override")
        try:
            for key in _for_each_device(mapping, ways[dotted]):
                _override(mapping, key, overrides[dotted], source, origins)
        except LookupError as error:
            homeless.append(f"{source}: {dotted}: {error.args[0]}")
    config = _built(struct_type, mapping, where, origins)
    if homeless:  # only if the file itself has no fault
        raise ConfigError("; ".join(homeless))
    return config


def completed(scene: Scene) -> Scene:
    """Add an object for each geom of the scene's world, and check the objects of the result against each other.

    `load_scene` does this already. Raises ConfigError for an unusable model.
    """
    if scene.world is None:
        return scene
    from softfinger.config.mjcf_geoms import with_geoms  # it needs MuJoCo

    return build(Scene, describe(with_geoms(scene)), f"{scene.world.model} in the scene")


def _beside(folder: Path, thing: Object) -> Object:
    if isinstance(thing, Heightmap | Mesh):
        root = None if thing.root is None else str(folder / thing.root)
        return msgspec.structs.replace(thing, file=str(folder / thing.file), root=root)
    if not isinstance(thing, Textured) or thing.texture is None:
        return thing
    texture = msgspec.structs.replace(thing.texture, file=str(folder / thing.texture.file))
    return msgspec.structs.replace(thing, texture=texture)


def _built(struct_type: type[T], mapping: object, where: str, sources: Mapping[str, str]) -> T:
    value, faults = examine(struct_type, mapping, where, sources)
    if faults:
        raise FaultyConfig(faults)
    assert isinstance(value, struct_type)
    return value


def _for_each_device(mapping: dict[str, Any], dotted: str) -> list[str]:
    """Return the keys to override; in a file with [devices.NAME], a key of `device` applies to each of them."""
    first, _, rest = dotted.partition(".")
    if first == "device" and "device" not in mapping and isinstance(mapping.get("devices"), dict):
        return [f"devices.{name}.{rest}" for name in mapping["devices"]]
    return [dotted]


def _override(mapping: dict[str, Any], dotted: str, value: Any, source: str, origins: dict[str, str]) -> None:
    """Set a value and create the tables above it; `origins` records the source of keys that are not from the file.

    An entry of a list is `object.0` or, as in messages, `object[0]`. Raises LookupError if the place does not exist.
    """
    way = _ENTRY.sub(r".\1", dotted).split(".")
    at: Any = mapping
    for depth, name in enumerate(way, 1):
        key = _NUMBER.sub(r"[\1]", ".".join(way[:depth]))
        place: Any = name
        if isinstance(at, list):
            if not (re.fullmatch("[0-9]{1,9}", name) and int(name) < len(at)):
                there = f"entries go from 0 to {len(at) - 1}{_names(at)}" if at else "the list is empty"
                raise LookupError(f"there is no {key}: {there}; to add one give all of {way[depth - 2]}")
            place = int(name)
        elif not isinstance(at, dict):
            raise LookupError(f"{key} would be in {shown(at)}, which is no table: give the complete table")
        elif depth < len(way) and name not in at:
            at[name], origins[key] = {}, source
        if depth == len(way):
            if way[-1] == "driver" and way[0] in ("device", "devices") and at.get("driver") != value:
                at.clear()
            _forget_entry(at, way, value)
            at[place], origins[key] = value, source
        else:
            if name in _BY_NAME and isinstance(at[place], str):
                at[place] = {_BY_NAME[name]: at[place]}
            at = at[place]


def _forget_entry(at: Any, way: list[str], value: Any) -> None:
    """Remove the values of the previous library entry if another entry is named."""
    if not isinstance(at, dict) or at.get(way[-1]) == value or at.get("resolved") is not True:
        return
    if way[-2:] == ["material", MATERIALS.key]:
        at.clear()
    elif way[-1] == FINGERTIPS.key:
        for key in ("resolved", "radius_m", "radii_m", "orientation_wxyz", "patch"):
            at.pop(key, None)


def _names(entries: list[Any]) -> str:
    names = [str(each["name"]) for each in entries if isinstance(each, dict) and "name" in each]
    return f", or by name {', '.join(names)}" if names else ""


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        kept = {key: _plain(item) for key, item in value.items() if item is not None}
        return {**kept.pop("options"), **kept} if {"driver", "options"} <= kept.keys() else kept
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
