"""What `msgspec.inspect` says of a struct, as the checks, their messages and the reference tables ask for it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from msgspec import Struct, inspect


@lru_cache(maxsize=32)
def described(struct_type: type[Struct]) -> inspect.StructType:
    """Tag, fields and ranges of a struct; TypeError if it is none."""
    info = inspect.type_info(struct_type)
    if not isinstance(info, inspect.StructType):
        raise TypeError(f"{struct_type!r} is not a msgspec Struct")
    return info


def unwrapped(info: inspect.Type) -> tuple[inspect.Type, dict[str, Any]]:
    """The bare type, and what its Meta said besides the range: description, examples, reason."""
    extra: dict[str, Any] = {}
    while isinstance(info, inspect.Metadata):
        extra |= (info.extra_json_schema or {}) | (info.extra or {})
        info = info.type
    return info, extra


def options(info: inspect.Type) -> list[inspect.Type]:
    """What a field may hold besides being left out: the members of a union without None, or the type alone.

    A union of structs whose base has a list `added` is open: those of the list are members, too.
    """
    members = info.types if isinstance(info, inspect.UnionType) else (info,)
    present = [member for member in members if not isinstance(member, inspect.NoneType)]
    if isinstance(info, inspect.UnionType) and isinstance(present[0], inspect.StructType):
        present += [described(kind) for kind in getattr(present[0].cls, "added", ())]
    return present
