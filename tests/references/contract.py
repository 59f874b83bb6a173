"""Names that users depend on: exports, command line, keys of files, telemetry fields, commands, driver options."""

import argparse
from collections.abc import Iterator
from typing import Any

import msgspec

import softfinger
from softfinger.drivers import registry
from softfinger.server.cli import make_parser
from softfinger.server.verbs.options import SCHEMAS
from softfinger.server.verbs.schema import make_json_schema

_FIELD = ("name", "size", "kind", "unit")


def names() -> dict[str, list[str]]:
    """Return all names by kind, sorted."""
    schemas = {kind: make_json_schema(kind) for kind in SCHEMAS}
    telemetry, commands = schemas.pop("telemetry"), schemas.pop("commands")
    schemas |= {f"driver {name}": msgspec.json.schema(registry.load(name).Options) for name in registry.BUILT_IN}
    methods = commands["methods"]
    schemas |= {f"{name} {part}": methods[name][part] for name in methods for part in ("params", "result")}
    return {
        "exports": sorted(softfinger.__all__),
        "command line": sorted(_options(make_parser().complete())),
        "keys": sorted({path for name, schema in schemas.items() for path in _paths(schema, schema, name, ())}),
        "telemetry": sorted(" ".join(f"{field[key]}" for key in _FIELD) for field in telemetry["record"]),
        "messages": sorted({*methods, *commands["errors"], *commands["request"], *commands["answer"]}),
    }  # fmt: skip


def _options(parser: argparse.ArgumentParser) -> set[str]:
    """Return each verb with each of its options; those that all verbs have once, as options of `*`."""
    options = dict(_options_by_verb(parser, "softfinger"))
    common = set.intersection(*options.values())
    own = {f"{verb} {option}" for verb, names in options.items() for option in names - common}
    return own | {f"* {option}" for option in common}


def _options_by_verb(parser: argparse.ArgumentParser, verb: str) -> Iterator[tuple[str, set[str]]]:
    names = set[str]()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            names |= set(action.choices)
            for name, inner in action.choices.items():
                yield from _options_by_verb(inner, f"{verb} {name}")
        else:
            names |= set(action.option_strings or [action.dest.upper()])
    yield verb, names


def _paths(schema: Any, root: dict[str, Any], at: str, inside: tuple[str, ...]) -> Iterator[str]:
    """Yield the dotted keys below a part of a JSON Schema, and the constants that a key may have."""
    if not isinstance(schema, dict) or schema.get("$ref") in inside:
        return
    if "$ref" in schema:
        title = schema["$ref"].rpartition("/")[2]
        yield from _paths(root["$defs"][title], root, at, (*inside, schema["$ref"]))
    yield from (f"{at}={value}" for value in ([schema["const"]] if "const" in schema else schema.get("enum", ())))
    for key, value in schema.get("properties", {}).items():
        yield f"{at}.{key}"
        yield from _paths(value, root, f"{at}.{key}", inside)
    for choice in [*schema.get("anyOf", ()), *schema.get("oneOf", ())]:
        yield from _paths(choice, root, at, inside)
    for item in [schema.get("items"), schema.get("additionalProperties"), *schema.get("prefixItems", ())]:
        yield from _paths(item, root, f"{at}[]", inside)
