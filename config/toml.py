"""TOML of foreign origin: parsed in bounded time and memory.

tomllib takes time and memory with the square of a dotted key's parts, and lets tables nest deeper than Python can
follow. Both are looked for here: keys in the text, before it is parsed, and depth in what came of it.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any, Final

from softfinger.config.errors import ConfigError

PARTS_MAX: Final = 32
"""Parts of a dotted key at most; those of scenes and rigs have 5."""
DEPTH_MAX: Final = 64
"""Tables and lists in one another at most; those of scenes and rigs have 5."""

# Both run through the text once: what a quantifier with + has taken it does not give back.
_STRINGS: Final = re.compile(
    r"""(?xs)
    (?P<blank> "{3} (?: \\. | [^\\] )*? (?: "{3} | \\?\Z ) | '{3} .*? (?: '{3} | \Z ) | \#[^\n]*+ )
    | " (?: \\. | [^"\\\n] )*+ "?+
    | ' [^'\n]*+ '?+
    """
)
"""Strings and comments; `blank` are those that no key can be in."""
_LONG_KEY: Final = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{PARTS_MAX}}}")


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """The tables of a text; ConfigError with its name for one that is no TOML or asks too much."""
    long = _LONG_KEY.search(_STRINGS.sub(_blanked, text))
    if long is not None:
        line = text.count("\n", 0, long.start()) + 1
        raise ConfigError(f"{name}, line {line}: a key of more than {PARTS_MAX} parts: no table is that deep")
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not TOML: {error}") from error
    except (ValueError, RecursionError) as error:
        # tomllib lets through what Python itself refuses: 5000-digit numbers, a thousand brackets.
        raise ConfigError(f"{name}: not usable: {error}") from error
    level: list[Any] = [tables]
    for _ in range(DEPTH_MAX):
        level = [below for value in level for below in _inside(value)]
    if level:
        raise ConfigError(f"{name}: tables or lists more than {DEPTH_MAX} deep in one another: this is no scene or rig")
    return tables


def _blanked(found: re.Match[str]) -> str:
    """As many lines and columns without what is in it: a string on one line may be a part of a key, so a letter."""
    spaces = re.sub(r"[^\n]", " ", found[0])
    return spaces if found["blank"] else f"s{spaces[1:]}"


def _inside(value: Any) -> list[Any]:
    values = value.values() if isinstance(value, dict) else value
    return [below for below in values if isinstance(below, dict | list)]
