"""From a mapping to a struct, finding every fault on the way.

`msgspec.convert` stops at the first fault and knows nothing of units or near misses. This walk
follows the same type descriptions (`msgspec.inspect`), and where a value is unusable it notes the
fault, puts `UNSET` in its place and goes on.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final, NamedTuple

from msgspec import UNSET, Struct, inspect

from softfinger.config.schema import unit

_BARE_KEY: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_INDEX: Final = re.compile(r"\[\d+\]")
_SHOWN: Final = 60


class Fault(NamedTuple):
    """One thing wrong: the file or flag it came from, the dotted key, and what to do about it."""

    where: str
    key: str
    message: str

    def __str__(self) -> str:
        return f"{self.where}: {self.message}"


@dataclass
class Report:
    """Faults found so far; `sources` names where single keys came from (command-line flags)."""

    where: str
    sources: Mapping[str, str]
    faults: list[Fault] = field(default_factory=list)

    def add(self, key: str, text: str) -> Any:
        """Note a fault; returns the placeholder for the value."""
        path = key.split(".")
        prefixes = (".".join(path[:n]) for n in range(len(path), 0, -1))
        where = next((self.sources[p] for p in prefixes if p in self.sources), self.where)
        self.faults.append(Fault(where, key, text))
        return UNSET


def examine(
    struct_type: type[Struct], mapping: object, where: str, sources: Mapping[str, str] | None = None
) -> tuple[Any, list[Fault]]:
    """The struct as far as `mapping` gives it (unusable fields hold UNSET), and all faults."""
    report = Report(where, sources or {})
    value = _struct(_described(struct_type), mapping, "", report)
    return value, report.faults


@lru_cache(maxsize=32)
def _described(struct_type: type[Struct]) -> inspect.StructType:
    info = inspect.type_info(struct_type)
    if not isinstance(info, inspect.StructType):
        raise TypeError(f"{struct_type!r} is not a msgspec Struct")
    return info


# --- one value -----------------------------------------------------------------------------------


def _value(info: inspect.Type, value: object, key: str, report: Report) -> Any:
    kind, extra = _unwrapped(info)
    match kind:
        case inspect.UnionType():
            return _one_of(kind, value, key, report)
        case inspect.StructType():
            return _struct(kind, value, key, report)
        case inspect.FloatType() | inspect.IntType():
            return _number(kind, extra, value, key, report)
        case inspect.TupleType() | inspect.VarTupleType() | inspect.ListType():
            return _list(kind, value, key, report)
        case inspect.StrType():
            return _text(kind, value, key, report)
        case inspect.LiteralType():
            if any(value == allowed and type(value) is type(allowed) for allowed in kind.values):
                return value
            hint = near(value, kind.values)
            return report.add(key, f"{key} = {shown(value)}: must be {expected(kind, key)}{hint}")
        case inspect.BoolType():
            usable = isinstance(value, bool)
        case inspect.DictType():
            usable = isinstance(value, Mapping)
        case inspect.NoneType():
            usable = value is None
        case inspect.AnyType():
            usable = True
        case _:
            raise TypeError(f"{key}: a field of type {kind!r} cannot be read from a file")
    return value if usable else report.add(key, f"{key} = {shown(value)}: must be {expected(kind, key)}")


def _unwrapped(info: inspect.Type) -> tuple[inspect.Type, dict[str, Any]]:
    """The bare type, and what its Meta said besides the range: description, examples, reason."""
    extra: dict[str, Any] = {}
    while isinstance(info, inspect.Metadata):
        extra |= (info.extra_json_schema or {}) | (info.extra or {})
        info = info.type
    return info, extra


def _one_of(kind: inspect.UnionType, value: object, key: str, report: Report) -> Any:
    """Optional values, and structs told apart by their tag."""
    bare = [_unwrapped(option)[0] for option in kind.types]
    if value is None and any(isinstance(option, inspect.NoneType) for option in bare):
        return None
    options = [option for option in kind.types if not isinstance(option, inspect.NoneType)]
    if len(options) == 1:
        return _value(options[0], value, key, report)
    structs = [option for option in bare if isinstance(option, inspect.StructType) and option.tag_field]
    if len(structs) == len(options):
        return _tagged(structs, value, key, report)
    for option in options:
        attempt = Report("", {})
        result = _value(option, value, key, attempt)
        if not attempt.faults:
            return result
    choices = " or ".join(expected(option, key) for option in options)
    return report.add(key, f"{key} = {shown(value)}: must be {choices}")


def _number(
    kind: inspect.FloatType | inspect.IntType, extra: Mapping[str, Any], value: object, key: str, report: Report
) -> Any:
    whole = isinstance(kind, inspect.IntType)
    wanted = f"{key} = {shown(value)}: must be {expected(kind, key)}"
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        return report.add(key, wanted)
    try:
        number: float = int(value) if whole else float(value)
        finite = math.isfinite(number)
    except OverflowError:  # a whole number beyond any float
        finite = False
    if not finite:
        return report.add(key, wanted)
    low = kind.ge is None or number >= kind.ge
    high = kind.le is None or number <= kind.le
    if low and high and (kind.gt is None or number > kind.gt) and (kind.lt is None or number < kind.lt):
        return number
    reason = f" ({extra['reason']})" if "reason" in extra else ""
    return report.add(key, wanted + reason)


def _text(kind: inspect.StrType, value: object, key: str, report: Report) -> Any:
    if not isinstance(value, str):
        return report.add(key, f"{key} = {shown(value)}: must be {expected(kind, key)}")
    short = kind.min_length is not None and len(value) < kind.min_length
    long = kind.max_length is not None and len(value) > kind.max_length
    odd = kind.pattern is not None and not re.search(kind.pattern, value)
    if short or long or odd:
        return report.add(key, f"{key} = {shown(value)}: must be {expected(kind, key)}")
    return value


def _list(
    kind: inspect.TupleType | inspect.VarTupleType | inspect.ListType, value: object, key: str, report: Report
) -> Any:
    if not isinstance(value, list | tuple):
        hint = f": write [[{key}]]" if isinstance(value, Mapping) and "." not in key else ""
        return report.add(key, f"{key} = {shown(value)}: must be {expected(kind, key)}{hint}")
    if isinstance(kind, inspect.TupleType):
        types: Iterable[inspect.Type] = kind.item_types
        fits = len(value) == len(kind.item_types)
    else:
        types = (kind.item_type for _ in value)
        fits = (kind.min_length or 0) <= len(value) <= (math.inf if kind.max_length is None else kind.max_length)
    if not fits:
        return report.add(key, f"{key} = {shown(value)}: must be {expected(kind, key)}, this has {len(value)}")
    before = len(report.faults)
    items = [_value(t, item, f"{key}[{i}]", report) for i, (t, item) in enumerate(zip(types, value, strict=True))]
    # A list of tables keeps its usable ones for the checks across tables; a vector is whole or nothing.
    if isinstance(kind, inspect.TupleType) and len(report.faults) > before:
        return UNSET
    return items if isinstance(kind, inspect.ListType) else tuple(items)


# --- tables --------------------------------------------------------------------------------------


def _tagged(structs: list[inspect.StructType], value: object, key: str, report: Report) -> Any:
    tag_field = str(structs[0].tag_field)
    if not isinstance(value, Mapping):
        return report.add(key, f"{key} = {shown(value)}: must be a table")
    dotted, tags = _join(key, tag_field), [struct.tag for struct in structs]
    allowed = _either(tags)
    if tag_field not in value:
        return report.add(dotted, f"{dotted} is missing: give {allowed}, such as {tag_field} = {shown(tags[0])}")
    tag = value[tag_field]
    for struct in structs:
        if type(tag) is type(struct.tag) and tag == struct.tag:
            return _fields(struct, value, key, report)
    return report.add(dotted, f"{dotted} = {shown(tag)}: must be {allowed}{near(tag, tags)}")


def _struct(info: inspect.StructType, value: object, key: str, report: Report) -> Any:
    if info.tag_field:
        return _tagged([info], value, key, report)
    library = getattr(info.cls, "library", None)
    if library is not None:
        value = _from_library(library(), value, key, report)
        if value is UNSET:
            return UNSET
    if not isinstance(value, Mapping):
        return report.add(key, f"{key or 'the whole'} = {shown(value)}: must be a table")
    return _fields(info, value, key, report)


def _from_library(library: Mapping[str, Mapping[str, Any]], value: object, key: str, report: Report) -> Any:
    """A table that names another one, with that one's values where it has none of its own."""
    given = {"name": value} if isinstance(value, str) else value
    if not isinstance(given, Mapping) or not isinstance(given.get("name"), str):
        return given
    name = given["name"]
    if name in library:
        return _over(library[name], given)
    dotted = key if isinstance(value, str) else _join(key, "name")
    choices = ", ".join(library)
    return report.add(
        dotted, f"{dotted} = {shown(name)}: not in the library{near(name, library)}; it has {choices}; or give numbers"
    )


def _over(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with `changes` put in, table by table."""
    result = dict(base)
    for key, value in changes.items():
        below = base.get(key)
        both = isinstance(below, Mapping) and isinstance(value, Mapping)
        result[key] = _over(below, value) if both else value  # type: ignore[arg-type]
    return result


def _fields(info: inspect.StructType, value: Mapping[Any, Any], key: str, report: Report) -> Any:
    start = len(report.faults)
    gathers = getattr(info.cls, "gathers", None)
    names = [f.encode_name for f in info.fields if f.encode_name != gathers]
    allowed = [*([info.tag_field] if info.tag_field else []), *names]
    extra = {k: v for k, v in value.items() if k not in allowed}
    values: dict[str, Any] = {}
    if gathers is not None:
        values[gathers] = {k: v for k, v in extra.items() if isinstance(k, str)}
        extra = {k: v for k, v in extra.items() if not isinstance(k, str)}
    for name in extra:
        dotted = _join(key, name)
        report.add(dotted, f"{dotted} is not a key here{near(name, allowed)}; keys are {', '.join(allowed)}")
    for f in info.fields:
        dotted = _join(key, f.encode_name)
        if f.encode_name == gathers:
            continue
        if f.encode_name in value:
            values[f.name] = _value(f.type, value[f.encode_name], dotted, report)
        elif f.required:
            values[f.name] = report.add(dotted, _missing(f.type, dotted, f.encode_name))
    return _made(info.cls, values, key, report, start)


def _made(cls: type[Struct], values: dict[str, Any], key: str, report: Report, start: int) -> Any:
    """The struct, after its own checks across fields."""
    try:
        struct = cls(**values)
        complaints = list(struct.faults()) if hasattr(struct, "faults") else []
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        # An outside driver's own check may stumble over UNSET; that is no news if the field is reported.
        return UNSET if len(report.faults) > start else report.add(key, f"{key or 'the whole'}: {error}")
    for name, seen, text in complaints:
        dotted = f"{key}.{name}" if key else name
        report.add(dotted, f"{dotted}: {text}" if seen is UNSET else f"{dotted} = {shown(seen)}: {text}")
    return struct


def _missing(info: inspect.Type, dotted: str, name: str) -> str:
    kind, extra = _unwrapped(info)
    if isinstance(kind, inspect.StructType):
        return f"{dotted} is missing: add the table [{_INDEX.sub('', dotted)}]"
    if isinstance(kind, inspect.VarTupleType) and _is_table(kind.item_type):
        return f"{dotted} is missing: add at least one table [[{dotted}]]"
    text = f"{dotted} is missing: give {expected(info, name)}"
    meaning = f" ({extra['description']})" if "description" in extra else ""
    example = f", such as {name} = {toml(extra['examples'][0])}" if extra.get("examples") else ""
    return text + meaning + example


# --- words ---------------------------------------------------------------------------------------


def expected(info: inspect.Type, key: str) -> str:
    """What a value has to be, in words: `a number from 0 to 40 N`."""
    kind, _ = _unwrapped(info)
    match kind:
        case inspect.FloatType() | inspect.IntType():
            noun = "a whole number" if isinstance(kind, inspect.IntType) else "a number"
            return f"{noun}{span(kind)}{_unit(key)}"
        case inspect.StrType():
            return "text" + _length(kind, "characters") + (f" like {kind.pattern}" if kind.pattern else "")
        case inspect.LiteralType():
            return _either(kind.values)
        case inspect.BoolType():
            return "true or false"
        case inspect.TupleType():
            each, _ = _unwrapped(kind.item_types[0])
            limits = span(each) if isinstance(each, inspect.FloatType | inspect.IntType) else ""
            return f"a list of {len(kind.item_types)} numbers{limits}{_unit(key)}"
        case inspect.VarTupleType() | inspect.ListType():
            what = "tables" if _is_table(kind.item_type) else "values"
            return "a list" + (_length(kind, what) or f" of {what}")
        case inspect.UnionType():
            return " or ".join(expected(t, key) for t in kind.types if not isinstance(t, inspect.NoneType))
        case inspect.NoneType():
            return "left out"
        case _:
            return "a table"


def _is_table(info: inspect.Type) -> bool:
    """Whether values of this type are tables, of one kind or of several."""
    kind, _ = _unwrapped(info)
    options = kind.types if isinstance(kind, inspect.UnionType) else (kind,)
    return all(isinstance(_unwrapped(option)[0], inspect.StructType) for option in options)


def _length(kind: inspect.StrType | inspect.VarTupleType | inspect.ListType, what: str) -> str:
    """` of 1 to 64 characters`, or nothing where any length will do."""
    low, high = kind.min_length or 0, kind.max_length
    return f" of {low} to {high} {what}" if high is not None else f" of at least {low} {what}" if low else ""


def span(kind: inspect.FloatType | inspect.IntType) -> str:
    """Range of a number: ` from 0 to 40`, ` above 0`, or nothing."""
    low = f"{kind.ge:g}" if kind.ge is not None else f"above {kind.gt:g}" if kind.gt is not None else ""
    high = f"{kind.le:g}" if kind.le is not None else f"below {kind.lt:g}" if kind.lt is not None else ""
    if low and high:
        return f" from {low} to {high}"
    if low:
        return f" {low}" if kind.ge is None else f" of at least {low}"
    return f" {high}" if kind.lt is not None else f" of at most {high}" if high else ""


def shown(value: object) -> str:
    """A value as a message may carry it: one line, bounded, never an error itself."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return repr(value if len(value) <= _SHOWN else value[:_SHOWN] + "...")
    if isinstance(value, int):
        return str(value) if value.bit_length() <= 64 else f"a whole number of {value.bit_length()} bits"
    if isinstance(value, float):
        return repr(float(value))
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list | tuple):
        flat = len(value) <= 6 and all(isinstance(v, int | float | str) for v in value)
        return f"[{', '.join(shown(v) for v in value)}]" if flat else f"a list of {len(value)} values"
    return "nothing" if value is None else f"a {type(value).__name__}"


def toml(value: object) -> str:
    """An example as one would write it in a file."""
    return json.dumps(value)


def near(given: object, allowed: Iterable[object]) -> str:
    """` (did you mean 'plane'?)` where one of the allowed names is close."""
    # An endless key would keep difflib busy, and nothing is close to it anyway.
    if not isinstance(given, str) or len(given) > 64:
        return ""
    close = difflib.get_close_matches(given.lower(), [name for name in allowed if isinstance(name, str)], n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _either(names: Iterable[object]) -> str:
    listed = [shown(name) for name in names]
    return listed[0] if len(listed) == 1 else f"one of {', '.join(listed)}"


def _unit(key: str) -> str:
    name = unit(_INDEX.sub("", key))
    return f" {name}" if name else ""


def _join(key: str, name: object) -> str:
    part = name if isinstance(name, str) and _BARE_KEY.fullmatch(name) else shown(name)
    return f"{key}.{part}" if key else part
