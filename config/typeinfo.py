"""Type descriptions of structs (`msgspec.inspect`) for validation, error messages and reference tables."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from msgspec import Struct, inspect


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
