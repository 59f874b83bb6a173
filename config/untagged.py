"""Faults of a table whose kind is missing or unknown, so that one pass over a file reports them too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from msgspec import UNSET, Struct, inspect

from softfinger.config.scalars import FaultCollector
from softfinger.config.words import join_key, missing, near

Read = Callable[[inspect.Type, object, str, FaultCollector], Any]
"""Reads a value of a type, and records its faults: type, value, key, report."""


class TableKinds(NamedTuple):
    """Kinds of a table.

    every  all kinds that it may have
    meant  those that it is likely to have: one with a similar name, or all
    """

    every: list[inspect.StructType]
    meant: list[inspect.StructType]


def read_untagged(
    kinds: TableKinds, table: Mapping[Any, Any], key: str, report: FaultCollector, read: Read
) -> tuple[type[Struct] | None, dict[str, Any]]:
    """Check a table of unknown kind against the kinds in `meant`, and report its faults.

    Returns the class for the checks across tables, and its values; a missing key is UNSET. The class is the kind if
    only one is meant, else the base class of all kinds, None if they share no key.
    """
    keys = {field.encode_name for kind in kinds.every for field in kind.fields}
    has_further_keys = any(getattr(kind.cls, "gathers", None) for kind in kinds.every)
    for name in table:
        if name != kinds.every[0].tag_field and name not in keys and not has_further_keys:
            dotted = join_key(key, name)
            report.add(dotted, f"{dotted} is not a key here{near(name, sorted(keys))}")
    values: dict[str, Any] = {}
    for field in (field for kind in kinds.meant for field in kind.fields):
        name, dotted = field.encode_name, join_key(key, field.encode_name)
        if field.name in values:
            continue
        if name in table:
            types = [same.type for kind in kinds.meant for same in kind.fields if same.encode_name == name]
            values[field.name] = _read_as_one(types, table[name], dotted, report, read)
        elif field.required:
            values[field.name] = UNSET
            if len(kinds.every) > 1 and all(_requires(kind, name) for kind in kinds.every):
                report.add(dotted, missing(field.type, dotted, name))
    cls = kinds.meant[0].cls if len(kinds.meant) == 1 else _shared_base(kinds.every)
    shared = () if cls is None else cls.__struct_fields__
    return cls, {name: value for name, value in values.items() if name in shared}


def _read_as_one(types: list[inspect.Type], value: object, key: str, report: FaultCollector, read: Read) -> Any:
    """Read a value as the first type that it fits; record its faults as the first type if it fits none."""
    attempts = []
    for candidate in types:
        attempt = FaultCollector("", {})
        result = read(candidate, value, key, attempt)
        if not attempt.faults:
            return result
        attempts.append((attempt, result))
    faults, result = attempts[0]
    for fault in faults.faults:
        report.add(fault.key, fault.message)
    return result


def _requires(kind: inspect.StructType, name: str) -> bool:
    return any(field.encode_name == name and field.required for field in kind.fields)


def _shared_base(kinds: list[inspect.StructType]) -> type[Struct] | None:
    """Return the base class of all kinds that has fields, None if there is none."""
    shared = (
        base
        for base in kinds[0].cls.__mro__
        if issubclass(base, Struct) and base is not Struct and all(issubclass(kind.cls, base) for kind in kinds)
    )
    return next((base for base in shared if base.__struct_fields__), None)
