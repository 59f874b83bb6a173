"""Types of fields (`msgspec.inspect`), and wording of fields and values in error messages and reference tables."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

from msgspec import Struct, inspect

from softfinger.config.fields import find_unit


@lru_cache(maxsize=32)
def describe_struct(struct_type: type[Struct]) -> inspect.StructType:
    """Return tag, fields and ranges of a struct; raises TypeError for another type."""
    info = inspect.type_info(struct_type)
    if not isinstance(info, inspect.StructType):
        raise TypeError(f"{struct_type!r} is not a msgspec Struct")
    return info


def unwrap(info: inspect.Type) -> tuple[inspect.Type, dict[str, Any]]:
    """Return the bare type and the further contents of its Meta: description, examples, reason."""
    extra: dict[str, Any] = {}
    while isinstance(info, inspect.Metadata):
        extra |= (info.extra_json_schema or {}) | (info.extra or {})
        info = info.type
    return info, extra


def list_given_types(info: inspect.Type) -> list[inspect.Type]:
    """Return the types of a field that is given: the members of a union without None, or the type itself.

    If the base class of the structs in a union has a list `added`, the structs in that list are members, too.
    """
    members = info.types if isinstance(info, inspect.UnionType) else (info,)
    present = [member for member in members if not isinstance(member, inspect.NoneType)]
    if isinstance(info, inspect.UnionType) and isinstance(present[0], inspect.StructType):
        present += [describe_struct(kind) for kind in getattr(present[0].cls, "added", ())]
    return present


_BARE_KEY: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_INDEX: Final = re.compile(r"\[\d+\]")
_VALUE_LENGTH_MAX: Final = 60


PATTERNS: Final = {
    "^[A-Za-z0-9_-]+$": "with only A to Z, a to z, 0 to 9, - and _",
    r"^[\w .+-]+$": "with only letters, digits, spaces and . + - _",
    "^(#[0-9a-fA-F]{6})?$": "like #3366cc, or empty",
    r"^\d+\.\d+(\.\d+)?$": "like 3.5 or 3.5.1",
    "^(none|white|pink)$": "that is none, white or pink",
    "^(data:image/(png|jpeg|webp);base64,[A-Za-z0-9+/=]+)?$": "with a data URL of a PNG, JPEG or WebP image, or empty",
}
"""Descriptions of the regular expressions of texts."""


def describe_pattern(pattern: str) -> str:
    return PATTERNS.get(pattern, f"like {pattern}")


def describe_allowed(info: inspect.Type, key: str) -> str:
    """Describe the allowed values of a field, such as `a number from 0 to 40 N`."""
    kind, _ = unwrap(info)
    match kind:
        case inspect.FloatType() | inspect.IntType():
            noun = "an integer" if isinstance(kind, inspect.IntType) else "a number"
            return f"{noun}{_describe_range(kind)}{_format_unit(key)}"
        case inspect.StrType():
            words = f" {describe_pattern(kind.pattern)}" if kind.pattern else ""
            return f"text{_describe_length(kind, 'characters')}{words}"
        case inspect.LiteralType():
            return format_choice(kind.values)
        case inspect.BoolType():
            return "true or false"
        case inspect.TupleType():
            return f"a list of {len(kind.item_types)} {_describe_items(kind.item_types, key)}"
        case inspect.VarTupleType() | inspect.ListType():
            items = _describe_items((kind.item_type,), key)
            return "a list" + (_describe_length(kind, items) or f" of {items}")
        case inspect.UnionType():
            return " or ".join(dict.fromkeys(describe_allowed(option, key) for option in list_given_types(kind)))
        case inspect.NoneType():
            return "left out"
        case _:
            return "a table"


def _describe_items(types: Sequence[inspect.Type], key: str) -> str:
    """Describe the entries of a list, such as `numbers from 0 to 1 m`; only their noun if their ranges differ."""
    kinds = [unwrap(member)[0] for member in types]
    kind = kinds[0] if all(member == kinds[0] for member in kinds) else None
    match kind:
        case inspect.FloatType() | inspect.IntType():
            noun = "integers" if isinstance(kind, inspect.IntType) else "numbers"
            return f"{noun}{_describe_range(kind)}{_format_unit(key)}"
        case inspect.StrType():
            return "texts" + _describe_length(kind, "characters")
        case inspect.LiteralType():
            return f"values, each {format_choice(kind.values)}"
        case inspect.BoolType():
            return "truth values"
    if all(isinstance(member, inspect.FloatType | inspect.IntType) for member in kinds):
        return f"numbers{_format_unit(key)}"
    return "tables" if all(map(_is_table, types)) else "values"


def describe_missing(info: inspect.Type, dotted: str, name: str) -> str:
    kind, extra = unwrap(info)
    if not isinstance(kind, inspect.VarTupleType) and _is_table(kind):
        return f"{dotted} is missing: add the table [{_INDEX.sub('', dotted)}]"
    if isinstance(kind, inspect.VarTupleType) and _is_table(kind.item_type):
        return f"{dotted} is missing: add at least one table [[{_INDEX.sub('', dotted)}]]"
    text = f"{dotted} is missing: give {describe_allowed(info, name)}"
    meaning = f" ({extra['description']})" if "description" in extra else ""
    example = f", such as {name} = {format_toml(extra['examples'][0])}" if extra.get("examples") else ""
    return text + meaning + example


def _is_table(info: inspect.Type) -> bool:
    kind, _ = unwrap(info)
    members = kind.types if isinstance(kind, inspect.UnionType) else (kind,)
    return all(isinstance(unwrap(member)[0], inspect.StructType) for member in members)


def _describe_length(kind: inspect.StrType | inspect.VarTupleType | inspect.ListType, unit: str) -> str:
    """Return ` of 1 to 64 characters`, or an empty text if any length is allowed."""
    low, high = kind.min_length or 0, kind.max_length
    return f" of {low} to {high} {unit}" if high is not None else f" of at least {low} {unit}" if low else ""


def _describe_range(kind: inspect.FloatType | inspect.IntType) -> str:
    """Return the range of a number: ` from 0 to 40`, ` above 0 and at most 1`, or an empty text."""
    if kind.ge is not None and kind.le is not None:
        return f" from {kind.ge:g} to {kind.le:g}"
    bounds = (("above", kind.gt), ("of at least", kind.ge), ("below", kind.lt), ("at most", kind.le))
    bounds_text = " and ".join(f"{relation} {bound:g}" for relation, bound in bounds if bound is not None)
    return f" {bounds_text}" if bounds_text else ""


def format_value(value: object) -> str:
    """Format a value for a message: on one line, of bounded length, without raising."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return repr(value if len(value) <= _VALUE_LENGTH_MAX else value[:_VALUE_LENGTH_MAX] + "...")
    if isinstance(value, int):
        return str(value) if value.bit_length() <= 64 else f"an integer of {value.bit_length()} bits"
    if isinstance(value, float):
        return repr(float(value))
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list | tuple):
        flat = len(value) <= 6 and all(isinstance(v, int | float | str) for v in value)
        return f"[{', '.join(format_value(v) for v in value)}]" if flat else f"a list of {len(value)} values"
    return "nothing" if value is None else f"a {type(value).__name__}"


def format_toml(value: object) -> str:
    """Format an example as it is written in a file."""
    return json.dumps(value)


def suggest(entered: object, allowed: Iterable[object]) -> str:
    """Return ` (did you mean 'plane'?)` for a similar name, or for up to three names that start with `entered`."""
    # difflib is slow for very long keys, and no allowed name is similar to one.
    if not isinstance(entered, str) or len(entered) > 64:
        return ""
    names = [name for name in allowed if isinstance(name, str)]
    completions = [name for name in names if len(entered) >= 3 and name.startswith(entered.lower())]
    close = completions[:3] or difflib.get_close_matches(entered.lower(), names, n=1)
    return f" (did you mean {' or '.join(map(repr, close))}?)" if close else ""


def join_key(key: str, name: object) -> str:
    part = name if isinstance(name, str) and _BARE_KEY.fullmatch(name) else format_value(name)
    return f"{key}.{part}" if key else part


def format_choice(names: Iterable[object]) -> str:
    """Return `one of 'a', 'b'`, or the only name."""
    texts = [format_value(name) for name in names]
    return texts[0] if len(texts) == 1 else f"one of {', '.join(texts)}"


def _format_unit(key: str) -> str:
    name = find_unit(_INDEX.sub("", key))
    return f" {name}" if name else ""
