"""Checks of single values of a configuration: numbers, texts and choices, with the record of faults.

A value that cannot be used is recorded, and `UNSET` returned in its place. `config.validate` calls these functions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from msgspec import UNSET, inspect

from softfinger.config.words import describe_allowed, format_value, suggest


class Fault(NamedTuple):
    """Fault of a configuration: its source (file or flag), the dotted key, and the message with the remedy."""

    where: str
    key: str
    message: str

    def __str__(self) -> str:
        return f"{self.where}: {self.message}"


@dataclass
class FaultCollector:
    """Faults found so far; `sources` maps single keys to their source, such as a command-line flag."""

    where: str
    sources: Mapping[str, str]
    faults: list[Fault] = field(default_factory=list)

    def add(self, key: str, text: str) -> Any:
        """Record a fault and return the placeholder for the value."""
        path = key.split(".")
        prefixes = (".".join(path[:n]) for n in range(len(path), 0, -1))
        where = next((self.sources[p] for p in prefixes if p in self.sources), self.where)
        self.faults.append(Fault(where, key, text))
        return UNSET


def check_number(
    kind: inspect.FloatType | inspect.IntType, extra: Mapping[str, Any], value: object, key: str, report: FaultCollector
) -> Any:
    """Return a number of the range of `kind`; `extra["reason"]` explains the range."""
    is_integer = isinstance(kind, inspect.IntType)
    expected = f"{key} = {format_value(value)}: must be {describe_allowed(kind, key)}"
    if isinstance(value, bool) or not isinstance(value, int if is_integer else (int, float)):
        return report.add(key, expected)
    try:
        number: float = int(value) if is_integer else float(value)
        finite = math.isfinite(number)
    except OverflowError:  # an integer beyond the range of float
        finite = False
    if not finite:
        return report.add(key, expected)
    low = kind.ge is None or number >= kind.ge
    high = kind.le is None or number <= kind.le
    if low and high and (kind.gt is None or number > kind.gt) and (kind.lt is None or number < kind.lt):
        return number
    reason = f" ({extra['reason']})" if extra.get("reason") else ""
    return report.add(key, expected + reason)


def check_text(kind: inspect.StrType, value: object, key: str, report: FaultCollector) -> Any:
    if not isinstance(value, str):
        return report.add(key, f"{key} = {format_value(value)}: must be {describe_allowed(kind, key)}")
    short = kind.min_length is not None and len(value) < kind.min_length
    long = kind.max_length is not None and len(value) > kind.max_length
    # `$` also matches before a newline at the end.
    odd = kind.pattern is not None and (value.endswith("\n") or not re.search(kind.pattern, value))
    if short or long or odd:
        return report.add(key, f"{key} = {format_value(value)}: must be {describe_allowed(kind, key)}")
    return value


def check_literal(kind: inspect.LiteralType, value: object, key: str, report: FaultCollector) -> Any:
    if any(value == allowed and type(value) is type(allowed) for allowed in kind.values):
        return value
    hint = suggest(value, kind.values)
    return report.add(key, f"{key} = {format_value(value)}: must be {describe_allowed(kind, key)}{hint}")
