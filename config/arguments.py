"""Checks of arguments of the Python interface, so that a wrong type gets a message with the argument and its value.

`words` is imported with the first error: it loads msgspec, which an import of `Engine` does not need.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from softfinger.config.errors import ConfigError


def describe_refusal(name: str, value: object, allowed: str) -> str:
    """Return the message for a value of an argument that is not allowed."""
    from softfinger.config.words import format_value

    return f"{name} = {format_value(value)}: must be {allowed}"


def to_number(value: object) -> float:
    """Return a number as a float; nan, which every check of a range refuses, for anything else."""
    try:
        return math.nan if isinstance(value, str | bytes) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan


def check_text(value: object, name: str, example: str) -> str:
    """Return a printable text; raises ConfigError for anything else."""
    if isinstance(value, str) and (value.isprintable() or not value):
        return value
    raise ConfigError(describe_refusal(name, value, f"a text such as {example}"))


def check_mapping(value: object, name: str, example: str) -> Mapping[str, Any]:
    """Return a mapping with texts as keys; raises ConfigError for anything else."""
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return value
    raise ConfigError(describe_refusal(name, value, f"a mapping from texts to values, such as {example}"))
