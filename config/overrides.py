"""Changes of single values of a scene or rig by dotted keys, such as `object.table.position_m`."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from softfinger.config.arguments import check_mapping
from softfinger.config.errors import ConfigError
from softfinger.config.materials import FINGERTIPS, MATERIALS
from softfinger.config.scalars import Fault
from softfinger.config.words import format_value

_BY_NAME: Final = {"material": MATERIALS.key, "fingertip": FINGERTIPS.key}
"""Tables that a text may replace, with the key that the text becomes the value of."""
_DROPPING: Final = ("driver", *_BY_NAME.values())
"""Keys whose change drops other values of their table."""
CHANGES_EXAMPLE: Final = '{"object.table.material.stiffness_n_per_m": 800.0}'
_ENTRY: Final = re.compile(r"\[(\d+)\]")
_NUMBER: Final = re.compile(r"\.(\d+)(?=\.|$)")


class OverriddenMapping(NamedTuple):
    """Mapping with overrides.

    mapping          copy of the original, with the new values
    origins          source of each key that has a new value
    override_faults  faults of overrides with unknown keys
    """

    mapping: dict[str, Any]
    origins: dict[str, str]
    override_faults: list[Fault]


def change_values(
    original: Mapping[str, Any], overrides: Mapping[str, Any], sources: Mapping[str, str]
) -> OverriddenMapping:
    """Return a mapping with other values by dotted key; `sources` has the origin of each override for messages.

    Raises ConfigError for a value that is set twice, or if `overrides` is no mapping from keys.
    """
    check_mapping(overrides, "overrides", CHANGES_EXAMPLE)
    check_mapping(sources, "sources", CHANGES_EXAMPLE)
    mapping, origins, override_faults = copy.deepcopy(dict(original)), dict[str, str](), list[Fault]()
    indexed_keys = {dotted: to_indexed_key(mapping, dotted) for dotted in overrides}
    if len(set(indexed_keys.values())) < len(indexed_keys):
        source = sources.get(next(iter(indexed_keys)), "override")
        raise ConfigError(f"{source}: a value is set twice, by name and by index")
    expanded = [(key, dotted) for dotted in overrides for key in _expand_device_keys(mapping, indexed_keys[dotted])]
    for key, dotted in sorted(expanded, key=_rank):
        source = sources.get(dotted, "override")
        try:
            _override(mapping, key, overrides[dotted], source, origins)
        except LookupError as error:
            override_faults.append(Fault(source, dotted, f"{dotted}: {error.args[0]}"))
    return OverriddenMapping(mapping, origins, override_faults)


def _rank(keys: tuple[str, str]) -> tuple[int, bool, int]:
    """Return the rank of an override, an expanded key and the given one, in the order in which they are applied.

    A table comes before its parts, a key that drops other values of its table before these, and `device` before the
    single [devices.NAME].
    """
    key, given = keys
    return key.count("."), key.rpartition(".")[2] not in _DROPPING, given.count(".")


def to_indexed_key(mapping: Mapping[str, Any], dotted: str) -> str:
    """Return a key of `load_scene` with the index of each entry, `object.0` for `object.table` and `object[0]`."""
    head, _, remaining_path = dotted.partition(".")
    entries = mapping.get(head)
    if isinstance(entries, list | tuple) and not remaining_path.partition(".")[0].isdecimal():
        names = [
            (str(entry.get("name", "")), place) for place, entry in enumerate(entries) if isinstance(entry, Mapping)
        ]
        for name, place in sorted(names, key=lambda item: -len(item[0])):  # names may contain dots
            if name and (remaining_path == name or remaining_path.startswith(f"{name}.")):
                return _drop_brackets(f"{head}.{place}{remaining_path[len(name) :]}")
    return _drop_brackets(dotted)


def _drop_brackets(key: str) -> str:
    """Return a key with indices as parts: `object.0` for `object[0]`, as messages write it."""
    return _ENTRY.sub(r".\1", key)


def find_value(mapping: Any, dotted: str) -> Any:
    """Return the value of a mapping at a key of `load_scene`, with entries by index; None if it has no value."""
    for name in _drop_brackets(dotted).split("."):
        if isinstance(mapping, list):
            mapping = mapping[int(name)]
        elif isinstance(mapping, dict):
            mapping = mapping.get(name)
    return mapping


def _expand_device_keys(mapping: dict[str, Any], dotted: str) -> list[str]:
    """Return the keys to override; in a file with [devices.NAME], a key of `device` applies to each of them."""
    if dotted.partition(".")[0] == "device" and "device" not in mapping and isinstance(mapping.get("devices"), dict):
        return [f"devices.{name}{dotted.removeprefix('device')}" for name in mapping["devices"]]
    return [dotted]


def _override(mapping: dict[str, Any], dotted: str, value: Any, source: str, origins: dict[str, str]) -> None:
    """Set a value and create the tables above it; `origins` records the source of keys that are not from the file.

    Raises LookupError if the place does not exist.
    """
    path = dotted.split(".")
    at: Any = mapping
    for depth, name in enumerate(path, 1):
        key = _NUMBER.sub(r"[\1]", ".".join(path[:depth]))
        place: Any = name
        if isinstance(at, list):
            if not (re.fullmatch("[0-9]{1,9}", name) and int(name) < len(at)):
                entries = f"entries go from 0 to {len(at) - 1}{_join_names(at)}" if at else "the list is empty"
                raise LookupError(
                    f"there is no {key}: {entries}; to add an entry, set the complete list {path[depth - 2]}"
                )
            place = int(name)
        elif not isinstance(at, dict):
            raise LookupError(f"{key} would be in {format_value(at)}, which is not a table: set the complete table")
        elif depth < len(path) and name not in at:
            at[name], origins[key] = {}, source
        if depth == len(path):
            if path[-1] == "driver" and path[0] in ("device", "devices") and at.get("driver") != value:
                at.clear()
            _forget_entry(at, path, value)
            at[place], origins[key] = value, source
        else:
            if name in _BY_NAME and isinstance(at[place], str):
                at[place] = {_BY_NAME[name]: at[place]}
            at = at[place]


def _forget_entry(at: Any, path: list[str], value: Any) -> None:
    """Remove the values of the previous library entry if another entry is named."""
    if not isinstance(value, str):
        return
    if not isinstance(at, dict) or at.get(path[-1]) == value or at.get("resolved") is not True:
        return
    if path[-2:] == ["material", MATERIALS.key]:
        at.clear()
    elif path[-1] == FINGERTIPS.key:
        for key in ("resolved", "radius_m", "radii_m", "orientation_wxyz", "patch"):
            at.pop(key, None)


def _join_names(entries: list[Any]) -> str:
    names = [str(entry["name"]) for entry in entries if isinstance(entry, dict) and "name" in entry]
    return f", or by name {', '.join(names)}" if names else ""
