"""Read scenes and rigs: TOML to structs, all faults at once.

    scene = load_scene("paper-plane")                     # shipped
    rig = load_rig("bench.toml", {"servo.rate_hz": 500.0}, {"servo.rate_hz": "command line --rate"})

Nothing here knows what a driver's options mean: the driver's own struct goes through `build`.
"""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.schema import Rig, Scene
from softfinger.config.validate import Fault, examine
from softfinger.config.words import near, shown

T = TypeVar("T", bound=msgspec.Struct)

_HERE: Final = Path(__file__).resolve().parent
FOLDERS: Final[Mapping[type[msgspec.Struct], Path]] = {Scene: _HERE / "scenes", Rig: _HERE / "rigs"}
_KINDS: Final[Mapping[type[msgspec.Struct], str]] = {Scene: "scene", Rig: "rig"}
_SIZE_MAX: Final = 1 << 20


class FaultyConfig(ConfigError):
    """A ConfigError that keeps its faults apart, for those who list them."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        lines = [str(fault) for fault in faults]
        super().__init__(lines[0] if len(lines) == 1 else "\n  ".join([f"{len(lines)} faults:", *lines]))


def load_scene(
    path_or_name: str | Path, overrides: Mapping[str, Any] | None = None, sources: Mapping[str, str] | None = None
) -> Scene:
    """A scene from a file, or one of the shipped ones by name.

    `overrides` maps dotted keys to values put in the file's place; `sources` says where each came
    from, for the message. Raises ConfigError with every fault found.
    """
    return _load(Scene, path_or_name, overrides or {}, sources or {})


def load_rig(
    path_or_name: str | Path, overrides: Mapping[str, Any] | None = None, sources: Mapping[str, str] | None = None
) -> Rig:
    """A rig from a file, or one of the shipped ones by name; see `load_scene`.

    A `device.driver` other than the file's drops the file's device options: they are another driver's.
    """
    return _load(Rig, path_or_name, overrides or {}, sources or {})


def build(struct_type: type[T], mapping: object, where: str) -> T:
    """`mapping` as a `struct_type`; ConfigError with every fault, each naming `where` and its key."""
    return _built(struct_type, mapping, where, {})


def describe(config: msgspec.Struct) -> dict[str, Any]:
    """A scene or rig as the mapping its file would hold; `build` takes it back."""
    return _plain(msgspec.to_builtins(config))  # type: ignore[no-any-return]


def shipped(struct_type: type[msgspec.Struct]) -> list[str]:
    """Names of the scenes or rigs that come with the program."""
    return sorted(path.stem for path in FOLDERS[struct_type].glob("*.toml"))


def find(path_or_name: str | Path, struct_type: type[msgspec.Struct]) -> Path:
    """Where a scene or rig is. A text without a folder and without .toml is a shipped name first.

    The path need not exist, unless the text is neither a shipped name nor a file: then ConfigError.
    """
    path = Path(path_or_name)
    if isinstance(path_or_name, Path) or path.name != path_or_name or path.suffix == ".toml":
        return path
    names = shipped(struct_type)
    if path_or_name in names:
        return FOLDERS[struct_type] / f"{path_or_name}.toml"
    try:
        if path.exists():
            return path
    except (OSError, ValueError):
        pass
    kind = _KINDS[struct_type]
    raise ConfigError(
        f"no {kind} is called {shown(path_or_name)}{near(path_or_name, names)}; "
        f"shipped are {', '.join(names)}; a file of your own is named with its ending, such as my-{kind}.toml"
    )


def read_toml(path: str | Path, where: str | None = None) -> dict[str, Any]:
    """The tables of a TOML file. Raises ConfigError with the file, and line and column of a syntax error."""
    name = _named(path) if where is None else where
    text = _text(Path(path), name)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not TOML: {error}") from error
    except (ValueError, RecursionError) as error:
        # tomllib lets through what Python itself refuses: 5000-digit numbers, a thousand brackets.
        raise ConfigError(f"{name}: not usable: {error}") from error


def _text(path: Path, name: str) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(_SIZE_MAX + 1)
    except FileNotFoundError as error:
        raise ConfigError(f"{name}: no such file{_sibling(path)}") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{name}: is a folder: name a .toml file in it") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"{name}: cannot be read: {reason}") from error
    if len(data) > _SIZE_MAX:
        raise ConfigError(f"{name}: larger than {_SIZE_MAX} bytes: this is no scene or rig")
    try:
        return data.decode("utf-8-sig")  # editors on Windows put a byte order mark in front
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            f"{name}: not UTF-8: byte 0x{data[error.start]:02x} at line {line}: save the file as UTF-8"
        ) from error


def _named(path: str | Path) -> str:
    """A path as messages name it: whole, but on one line whatever is in it."""
    return repr(str(path))[1:-1]


def _sibling(path: Path) -> str:
    """A hint for a missing file: a similar name beside it, or a shipped name."""
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
    mapping = _with_overrides(read_toml(path, name), overrides)
    return _built(struct_type, mapping, name, {key: sources.get(key, "command line") for key in overrides})


def _built(struct_type: type[T], mapping: object, where: str, sources: Mapping[str, str]) -> T:
    value, faults = examine(struct_type, mapping, where, sources)
    if faults:
        raise FaultyConfig(faults)
    assert isinstance(value, struct_type)
    return value


def _with_overrides(mapping: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    result = copy.deepcopy(mapping)
    for dotted in sorted(overrides, key=lambda key: key != "device.driver"):
        *tables, last = dotted.split(".")
        at: Any = result
        for name in tables:
            at = at.setdefault(name, {}) if isinstance(at, dict) else None
        if dotted == "device.driver" and isinstance(at, dict) and at.get("driver") != overrides[dotted]:
            at.clear()
        if isinstance(at, dict):  # else the file's own fault is reported
            at[last] = overrides[dotted]
    return result


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        kept = {key: _plain(item) for key, item in value.items() if item is not None}
        if isinstance(kept.get("device"), dict):
            kept["device"] = {**kept["device"].pop("options", {}), **kept["device"]}
        return kept
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
