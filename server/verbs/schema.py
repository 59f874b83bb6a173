"""`softfinger schema`: structure of files, telemetry records and commands, for programs and editors."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import msgspec
from msgspec import inspect

from softfinger.config.materials import FINGERTIPS, MATERIALS
from softfinger.config.schema import DeviceConfig, Rig, Scene, find_unit
from softfinger.config.words import describe_allowed, describe_struct, format_toml, list_given_types, unwrap
from softfinger.proxy.record import FIELDS
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.verbs.options import SCHEMAS
from softfinger.server.wire import commands

_STRUCTS: Final[dict[str, type[msgspec.Struct]]] = {"scene": Scene, "rig": Rig, "experiment": ExperimentFile}
_EXACTLY_ONE: Final = {"Scene": ("fingertip", "finger"), "Rig": ("device", "devices")}
"""Keys of which a file has exactly one."""
_LIBRARY_TABLES: Final = {"Material": MATERIALS, "Fingertip": FINGERTIPS}
"""Tables that the name of a library entry may replace."""
_REQUIRED: Final = "required"
_OPTIONAL: Final = "optional"
_SELECTS: Final = "selects the other keys"
SHARED_MIN: Final = 3
"""Smallest number of keys shared with another table for which the reference names that table instead of its keys."""
_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


class Row(NamedTuple):
    """Key of a TOML table, as listed on the reference page."""

    key: str
    allowed: str
    default: str
    meaning: str


class TableRows(NamedTuple):
    """TOML table: dotted name, meaning, keys."""

    name: str
    meaning: str
    rows: list[Row]


def run(args: argparse.Namespace) -> int:
    if args.markdown:
        print("\n\n".join(format_markdown(kind) for kind in ([args.kind] if args.kind else SCHEMAS)))
        return 0
    schema = make_json_schema(args.kind) if args.kind else {kind: make_json_schema(kind) for kind in SCHEMAS}
    print(json.dumps(schema, indent=2))
    return 0


def make_json_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of file or of all commands, or the fields of a telemetry record in order."""
    if kind == "commands":
        return commands.make_schema()
    if kind == "telemetry":
        return {"title": "Telemetry", "record": [dataclasses.asdict(field) for field in FIELDS]}
    schema = msgspec.json.schema(_STRUCTS[kind])
    device = schema["$defs"].get("DeviceConfig")
    if device is not None:
        # In the file, the options of a driver are next to `driver`; only the driver knows them.
        del device["properties"][DeviceConfig.gathers]
        device["additionalProperties"] = True
    for title, keys in _EXACTLY_ONE.items():
        if title in schema["$defs"]:
            schema["$defs"][title]["oneOf"] = [{"required": [key]} for key in keys]
    for table in schema["$defs"].values():
        for key, value in table["properties"].items():
            _as_toml(key, value)
            for title, library in _LIBRARY_TABLES.items():
                if value.get("$ref") == f"#/$defs/{title}":
                    table["properties"][key] = {"anyOf": [{"$ref": value["$ref"]}, {"enum": sorted(library.entries())}]}
    material = schema["$defs"].get("Material")
    if material is not None:
        # A named material supplies the missing keys.
        material["anyOf"] = [{"required": ["name"]}, {"required": material.pop("required")}]
    return {"$schema": _DIALECT, **schema}


def _as_toml(key: str, value: dict[str, Any]) -> None:
    """Add the unit and remove null, which TOML lacks: an absent key has no value."""
    options = [option for option in value.get("anyOf", []) if option != {"type": "null"}]
    if len(options) == 1:
        del value["anyOf"]
        value.update(options[0])
    if value.get("default", "") is None:
        del value["default"]
    elif isinstance(value.get("default"), dict):
        value["default"] = {name: item for name, item in value["default"].items() if item is not None}
    if find_unit(key):
        value["unit"] = find_unit(key)


def format_markdown(kind: str) -> str:
    """Return tables of the keys as Markdown, for docs/reference; tables with the same keys are listed once."""
    if kind == "commands":
        rows = [[f"`{name}`", *words] for name, words in commands.make_table().items()]
        return format_grid(["method", "params", "result", "meaning"], rows)
    if kind == "telemetry":
        names = [field.name for field in dataclasses.fields(FIELDS[0])]
        return format_grid(names, [[str(getattr(field, name)) for name in names] for field in FIELDS])
    return "\n\n".join(f"### {heading}\n\n{body}" for heading, body in list_sections(_STRUCTS[kind]))


def list_sections(struct_type: type[msgspec.Struct], name: str = "") -> list[tuple[str, str]]:
    """Return headings and bodies of the tables of a struct at the key `name` of the file, equal tables once."""
    kinds: dict[str, list[TableRows]] = {}
    for table in list_tables(struct_type, name):
        kinds.setdefault(table.name, []).append(table)
    names_by_body: dict[str, dict[str, list[str]]] = {}  # by the keys in Markdown: names by meaning
    listed_rows: dict[str, list[Row]] = {}
    for table_name, variants in kinds.items():
        if len(variants) > 1:
            body = _format_variants(variants)
        else:
            body = _format_new_keys(listed_rows, variants[0].rows)
            listed_rows[table_name] = variants[0].rows
        names_by_body.setdefault(body, {}).setdefault("" if len(variants) > 1 else variants[0].meaning, []).append(
            f"`{table_name}`" if table_name else "Top of the file"
        )
    return [_make_section(body, meanings) for body, meanings in names_by_body.items()]


def _make_section(body: str, meanings: dict[str, list[str]]) -> tuple[str, str]:
    """Return heading, and meaning and keys; if several tables have the same keys, the meaning of each."""
    heading = ", ".join(name for names in meanings.values() for name in names)
    meanings_text = "\n".join(f"- {', '.join(names)}: {meaning}" for meaning, names in meanings.items())
    return heading, "\n\n".join(filter(None, [next(iter(meanings)) if len(meanings) == 1 else meanings_text, body]))


def _format_new_keys(listed_rows: dict[str, list[Row]], rows: list[Row]) -> str:
    """Format the keys of a table; if it has all keys of a table listed before, only the additional ones."""
    for name, other_rows in listed_rows.items():
        if len(other_rows) >= SHARED_MIN and all(row in rows for row in other_rows) and len(other_rows) < len(rows):
            return f"The keys of `{name}`, and:\n\n" + _format_keys(row for row in rows if row not in other_rows)
    return _format_keys(rows)


def _format_variants(variants: list[TableRows]) -> str:
    """Format a table that has several kinds: the common keys, the kinds, and the keys of single kinds."""
    tag = variants[0].rows[0].key
    shared = [row for row in variants[0].rows if all(row in variant.rows for variant in variants)]
    variant_rows: dict[Row, list[str]] = {}
    lines = []
    for table in variants:
        kind, *rows = (row for row in table.rows if row not in shared)
        for row in rows:
            variant_rows.setdefault(row, []).append(kind.allowed.strip('`"'))
        lines.append([kind.allowed, table.meaning, ", ".join(f"`{row.key}`" for row in rows) or "none"])
    all_keys = [row.key for row in variant_rows]
    suffixes = {
        row: f" of {', '.join(names)}" if all_keys.count(row.key) > 1 else "" for row, names in variant_rows.items()
    }
    return "\n\n".join([
        *([_format_keys(shared)] if shared else []),
        format_grid([f"`{tag}`", "meaning", "further keys"], lines),
        _format_keys(variant_rows, suffixes),
    ])  # fmt: skip


def _format_keys(rows: Iterable[Row], suffixes: Mapping[Row, str] = MappingProxyType({})) -> str:
    lines = [[f"`{row.key}`{suffixes.get(row, '')}", _describe_allowed(row), row.meaning] for row in rows]
    return format_grid(["key", "allowed (default)", "meaning"], lines)


def _describe_allowed(row: Row) -> str:
    """Return the allowed values of a key with its default; an optional key without a default has no suffix."""
    if row.default == _OPTIONAL:
        return row.allowed
    return f"{row.allowed}, {_REQUIRED}" if row.default == _REQUIRED else f"{row.allowed} ({row.default})"


def format_grid(head: list[str], lines: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [head, ["---"] * len(head), *lines])


def list_tables(struct_type: type[msgspec.Struct], name: str = "") -> list[TableRows]:
    """Return all TOML tables of a struct at the key `name` (empty: the file) with their keys, in order."""
    tables_by_key: dict[tuple[str, str], TableRows] = {}
    for table in _iter_tables(describe_struct(struct_type), name):
        # A material is the same in all shapes: listed at its first occurrence.
        if table.rows:
            tables_by_key.setdefault((table.name, table.meaning), table)
    return list(tables_by_key.values())


def _iter_tables(info: inspect.StructType, name: str) -> Iterator[TableRows]:
    rows = []
    if info.tag_field is not None:
        rows.append(Row(info.tag_field, f'`"{info.tag}"`', _REQUIRED, _SELECTS))
    inner = []
    for field in info.fields:
        structs = list(_iter_structs(field.type))
        path, is_array = _join_path(name, field)
        inner += [(struct, f"[[{path}]]" if is_array else f"[{path}]") for struct in structs]
        if not structs and field.encode_name != getattr(info.cls, "gathers", None):
            rows.append(_make_row(field))
    yield TableRows(name, " ".join((info.cls.__doc__ or "").split()), rows)
    for struct, path in inner:
        yield from _iter_tables(struct, path)


def _join_path(name: str, field: inspect.Field) -> tuple[str, bool]:
    bare = name.strip("[]")
    kind, _ = unwrap(list_given_types(field.type)[0])  # all options of a union have the same path
    path = f"{bare}.{field.encode_name}" if bare else field.encode_name
    if isinstance(kind, inspect.DictType):
        path += ".NAME"
    return path, isinstance(kind, inspect.VarTupleType | inspect.ListType)


def _make_row(field: inspect.Field) -> Row:
    (only,) = list_given_types(field.type)
    kind, extra = unwrap(only)
    allowed = re.sub(r"'([^']*)'", r'`"\1"`', describe_allowed(kind, "").removeprefix("one of "))
    allowed = re.sub(r"^a list of (\d+) numbers from", r"\1 numbers,", allowed)
    allowed = re.sub(
        r"^(a number|an integer) from", lambda match: "" if "number" in match[1] else "integer,", allowed
    ).strip()
    allowed = allowed.removeprefix("a number ")
    allowed = re.sub(r"^text of (.*) characters( like .*)?", r"text, \1", allowed)  # characters: see its meaning
    allowed = f"{allowed} {find_unit(field.encode_name)}".strip()
    if field.required or field.default in (None, msgspec.NODEFAULT):  # no default: an empty table
        default = _REQUIRED if field.required else _OPTIONAL
    else:
        default = f"`{format_toml(field.default)}`"
    return Row(field.encode_name, allowed, default, extra.get("description", ""))


def _iter_structs(info: inspect.Type) -> Iterator[inspect.StructType]:
    """Yield the possible tables of a field: its type, the options of a union, or the items of a list."""
    match info:
        case inspect.StructType():
            yield info
        case inspect.Metadata():
            yield from _iter_structs(info.type)
        case inspect.UnionType():
            for option in info.types:
                yield from _iter_structs(option)
        case inspect.VarTupleType() | inspect.ListType():
            yield from _iter_structs(info.item_type)
        case inspect.DictType():
            yield from _iter_structs(info.value_type)
