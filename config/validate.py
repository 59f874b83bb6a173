"""Conversion of a mapping to a struct, with all faults at once.

`msgspec.convert` stops at the first fault and knows neither units nor similar names. These functions walk the same type
descriptions (`msgspec.inspect`). For an unusable value they record the fault, store `UNSET` in its place and continue.
`config.load` calls `examine`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, Final

from msgspec import UNSET, Struct, inspect

from softfinger.config.materials import Library
from softfinger.config.scalars import Fault, FaultCollector, check_literal, check_number, check_text
from softfinger.config.words import (
    describe_allowed,
    describe_missing,
    describe_struct,
    format_choice,
    format_value,
    join_key,
    list_given_types,
    suggest,
    unwrap,
)

UNKNOWN_SHOWN: Final = 8
"""Unknown keys named per table. Fewer than a message lists, so that the message also shows how many more there are."""


def examine(
    struct_type: type[Struct], mapping: object, where: str, sources: Mapping[str, str] | None = None
) -> tuple[Any, list[Fault]]:
    """Convert `mapping` to the struct and return it with all faults; unusable fields are UNSET."""
    report = FaultCollector(where, sources or {})
    value = _read_struct(describe_struct(struct_type), mapping, "", report)
    return value, report.faults


def _read_value(info: inspect.Type, value: Any, key: str, report: FaultCollector) -> Any:
    if hasattr(value, "tolist"):  # an array or a number of NumPy
        value = value.tolist()
    kind, extra = unwrap(info)
    match kind:
        case inspect.UnionType():
            return _read_one_of(kind, value, key, report)
        case inspect.StructType():
            return _read_struct(kind, value, key, report)
        case inspect.FloatType() | inspect.IntType():
            return check_number(kind, extra, value, key, report)
        case inspect.TupleType() | inspect.VarTupleType() | inspect.ListType():
            return _list(kind, value, key, report)
        case inspect.StrType():
            return check_text(kind, value, key, report)
        case inspect.LiteralType():
            return check_literal(kind, value, key, report)
        case inspect.BoolType():
            usable = isinstance(value, bool)
        case inspect.DictType():
            return _read_named(kind, value, key, report)
        case inspect.NoneType():
            usable = value is None
        case inspect.AnyType():
            usable = True
        case _:
            raise TypeError(f"{key}: a field of type {kind!r} cannot be read from a file")
    return value if usable else report.add(key, f"{key} = {format_value(value)}: must be {describe_allowed(kind, key)}")


def _read_one_of(kind: inspect.UnionType, value: object, key: str, report: FaultCollector) -> Any:
    """Read an optional value, a struct selected by its tag, or the first member of a union that fits."""
    members = list_given_types(kind)
    if value is None and len(members) < len(kind.types):
        return None
    if len(members) == 1:
        return _read_value(members[0], value, key, report)
    structs = [bare for bare, _ in map(unwrap, members) if isinstance(bare, inspect.StructType) and bare.tag_field]
    if len(structs) == len(members):
        return _read_tagged(structs, value, key, report)
    for option in members:
        attempt = FaultCollector("", {})
        result = _read_value(option, value, key, attempt)
        if not attempt.faults:
            return result
    choices = " or ".join(describe_allowed(option, key) for option in members)
    return report.add(key, f"{key} = {format_value(value)}: must be {choices}")


def _list(
    kind: inspect.TupleType | inspect.VarTupleType | inspect.ListType, value: object, key: str, report: FaultCollector
) -> Any:
    if not isinstance(value, list | tuple):
        hint = f": write [[{key}]]" if isinstance(value, Mapping) and "." not in key else ""
        return report.add(key, f"{key} = {format_value(value)}: must be {describe_allowed(kind, key)}{hint}")
    if isinstance(kind, inspect.TupleType):
        types: Iterable[inspect.Type] = kind.item_types
        fits = len(value) == len(kind.item_types)
    else:
        types = (kind.item_type for _ in value)
        fits = (kind.min_length or 0) <= len(value) <= (math.inf if kind.max_length is None else kind.max_length)
    if not fits:
        return report.add(
            key, f"{key} = {format_value(value)}: must be {describe_allowed(kind, key)}, this has {len(value)}"
        )
    before = len(report.faults)
    items = [_read_value(t, item, f"{key}[{i}]", report) for i, (t, item) in enumerate(zip(types, value, strict=True))]
    # Usable tables of a list are needed for the checks across tables; a vector with an unusable component is useless.
    if isinstance(kind, inspect.TupleType) and len(report.faults) > before:
        return UNSET
    return items if isinstance(kind, inspect.ListType) else tuple(items)


def _read_named(kind: inspect.DictType, value: object, key: str, report: FaultCollector) -> Any:
    if not isinstance(value, Mapping):
        return report.add(key, f"{key} = {format_value(value)}: must be {describe_allowed(kind, key)}")
    before = len(report.faults)
    items = {}
    for name, item in value.items():
        dotted = join_key(key, name)
        item_key = _read_value(kind.key_type, name, dotted, report)
        items[item_key] = _read_value(kind.value_type, item, dotted, report)
    return items if len(report.faults) == before else UNSET


def _read_tagged(structs: list[inspect.StructType], value: object, key: str, report: FaultCollector) -> Any:
    tag_field = str(structs[0].tag_field)
    if not isinstance(value, Mapping):
        return report.add(key, f"{key} = {format_value(value)}: must be a table")
    dotted, tags = join_key(key, tag_field), [struct.tag for struct in structs]
    allowed = format_choice(tags)
    if tag_field not in value:
        report.add(dotted, f"{dotted} is missing: give {allowed}, such as {tag_field} = {format_value(tags[0])}")
        return _read_untagged(structs, structs, value, key, report)
    tag = value[tag_field]
    for struct in structs:
        if type(tag) is type(struct.tag) and tag == struct.tag:
            return _read_fields(struct, value, key, report)
    hint = suggest(tag, tags)
    report.add(dotted, f"{dotted} = {format_value(tag)}: must be {allowed}{hint}")
    matching = [struct for struct in structs if hint and repr(struct.tag) in hint]
    return _read_untagged(structs, matching or structs, value, key, report)


def _read_untagged(
    kinds: list[inspect.StructType],
    likely: list[inspect.StructType],
    table: Mapping[Any, Any],
    key: str,
    report: FaultCollector,
) -> Any:
    """Read the fields that all possible kinds of a table share, for the checks across tables."""
    start = len(report.faults)
    cls, values = _read_shared_keys(kinds, likely, table, key, report)
    return UNSET if cls is None else _create(cls, values, key, report, start)


def _read_shared_keys(
    kinds: list[inspect.StructType],
    likely: list[inspect.StructType],
    table: Mapping[Any, Any],
    key: str,
    report: FaultCollector,
) -> tuple[type[Struct] | None, dict[str, Any]]:
    """Check a table of unknown kind against the kinds in `likely`, and report its faults.

    Returns the class for the checks across tables, and its values; a missing key is UNSET. The class is the kind if
    only one is likely, else the base class of all kinds, None if they share no key.
    """
    keys = {field.encode_name for kind in kinds for field in kind.fields}
    has_further_keys = any(getattr(kind.cls, "gathers", None) for kind in kinds)
    for name in table:
        if name != kinds[0].tag_field and name not in keys and not has_further_keys:
            dotted = join_key(key, name)
            report.add(dotted, f"{dotted} is not a key here{suggest(name, sorted(keys))}")
    values: dict[str, Any] = {}
    for field in (field for kind in likely for field in kind.fields):
        name, dotted = field.encode_name, join_key(key, field.encode_name)
        if field.name in values:
            continue
        if name in table:
            types = [same.type for kind in likely for same in kind.fields if same.encode_name == name]
            values[field.name] = _read_as_one(types, table[name], dotted, report)
        elif field.required:
            values[field.name] = UNSET
            if len(kinds) > 1 and all(_is_required(kind, name) for kind in kinds):
                report.add(dotted, describe_missing(field.type, dotted, name))
    cls = likely[0].cls if len(likely) == 1 else _find_shared_base(kinds)
    shared = () if cls is None else cls.__struct_fields__
    return cls, {name: value for name, value in values.items() if name in shared}


def _read_as_one(types: list[inspect.Type], value: object, key: str, report: FaultCollector) -> Any:
    """Read a value as the first type that it fits; record its faults as the first type if it fits none."""
    attempts = []
    for candidate in types:
        attempt = FaultCollector("", {})
        result = _read_value(candidate, value, key, attempt)
        if not attempt.faults:
            return result
        attempts.append((attempt, result))
    faults, result = attempts[0]
    for fault in faults.faults:
        report.add(fault.key, fault.message)
    return result


def _is_required(kind: inspect.StructType, name: str) -> bool:
    return any(field.encode_name == name and field.required for field in kind.fields)


def _find_shared_base(kinds: list[inspect.StructType]) -> type[Struct] | None:
    """Return the base class of all kinds that has fields, None if there is none."""
    shared = (
        base
        for base in kinds[0].cls.__mro__
        if issubclass(base, Struct) and base is not Struct and all(issubclass(kind.cls, base) for kind in kinds)
    )
    return next((base for base in shared if base.__struct_fields__), None)


def _read_struct(info: inspect.StructType, value: object, key: str, report: FaultCollector) -> Any:
    if info.tag_field:
        return _read_tagged([info], value, key, report)
    library = getattr(info.cls, "library", None)
    if library is not None:
        value = _from_library(info, library, value, key, report)
        if value is UNSET:
            return UNSET
    if not isinstance(value, Mapping):
        return report.add(key, f"{key or 'the whole'} = {format_value(value)}: must be a table")
    return _read_fields(info, value, key, report)


def _from_library(info: inspect.StructType, library: Library, value: object, key: str, report: FaultCollector) -> Any:
    """Fill a table that names an entry of a library with the values of the entry that it leaves out.

    A table marked `resolved` is complete: the program that wrote it filled it from its library.
    """
    mapping = {library.key: value} if isinstance(value, str) else value
    if (
        not isinstance(mapping, Mapping)
        or not isinstance(mapping.get(library.key), str)
        or mapping.get("resolved") is True
    ):
        return mapping
    name, entries = mapping[library.key], library.entries()
    if name in entries:
        return library.fill(mapping)
    dotted = key if isinstance(value, str) else join_key(key, library.key)
    choices = ", ".join(entries)
    report.add(
        dotted,
        f"{dotted} = {format_value(name)}: not in the library{suggest(name, entries)}; it has {choices}; "
        "or give numbers",
    )
    _read_shared_keys([info], [info], mapping, key, report)
    return UNSET  # its keys would have the values of the library


def _read_fields(info: inspect.StructType, value: Mapping[Any, Any], key: str, report: FaultCollector) -> Any:
    start = len(report.faults)
    gathers = getattr(info.cls, "gathers", None)
    names = [f.encode_name for f in info.fields if f.encode_name != gathers]
    allowed = [*([info.tag_field] if info.tag_field else []), *names]
    extra = {k: v for k, v in value.items() if k not in allowed}
    values: dict[str, Any] = {}
    if gathers is not None:
        values[gathers] = {k: v for k, v in extra.items() if isinstance(k, str)}
        extra = {k: v for k, v in extra.items() if not isinstance(k, str)}
    for name in islice(extra, UNKNOWN_SHOWN):
        dotted = join_key(key, name)
        report.add(dotted, f"{dotted} is not a key here{suggest(name, allowed)}; keys are {', '.join(allowed)}")
    if len(extra) > UNKNOWN_SHOWN:
        report.add(key, f"{key or 'the whole'}: {len(extra) - UNKNOWN_SHOWN} more keys that have no meaning here")
    for f in info.fields:
        dotted = join_key(key, f.encode_name)
        if f.encode_name == gathers:
            continue
        if f.encode_name in value:
            values[f.name] = _read_value(f.type, value[f.encode_name], dotted, report)
        elif f.required:
            values[f.name] = report.add(dotted, describe_missing(f.type, dotted, f.encode_name))
    return _create(info.cls, values, key, report, start)


def _create(cls: type[Struct], values: dict[str, Any], key: str, report: FaultCollector, start: int) -> Any:
    try:
        struct = cls(**values)
        complaints = list(struct.faults()) if hasattr(struct, "faults") else []
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        # The check of an external driver may fail on UNSET. That is not a fault if the field is reported already.
        return UNSET if len(report.faults) > start else report.add(key, f"{key or 'the whole'}: {error}")
    for name, value, text in complaints:
        dotted = f"{key}.{name}" if key else name
        report.add(dotted, f"{dotted}: {text}" if value is UNSET else f"{dotted} = {format_value(value)}: {text}")
    return struct
