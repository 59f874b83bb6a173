"""Parser of untrusted TOML, in bounded time and memory.

tomllib needs time and memory that grow with the square of the number of parts in a dotted key, and accepts tables that
are nested deeper than Python's recursion limit. Keys are checked in the text before it is parsed, nesting in the
result.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any, Final

from softfinger.config.errors import ConfigError

PARTS_MAX: Final = 32
"""Largest number of parts of a dotted key; scenes and rigs have 5."""
DEPTH_MAX: Final = 64
"""Deepest nesting of tables and lists; scenes and rigs have 5."""

# Both scan the text once: the possessive quantifiers, with a trailing +, do not backtrack.
_STRINGS: Final = re.compile(
    r"""(?xs)
    (?P<blank> "{3} (?: \\. | [^\\] )*? (?: "{3} | \\?\Z ) | '{3} .*? (?: '{3} | \Z ) | \#[^\n]*+ )
    | " (?: \\. | [^"\\\n] )*+ "?+
    | ' [^'\n]*+ '?+
    """
)
"""Strings and comments; `blank` matches the ones that cannot contain a key."""
_LONG_KEY: Final = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{PARTS_MAX}}}")


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """Parse a text; raises ConfigError with its name if it is not TOML or exceeds a limit."""
    long = _LONG_KEY.search(_STRINGS.sub(_blank_out, text))
    if long is not None:
        line = text.count("\n", 0, long.start()) + 1
        raise ConfigError(f"{name}, line {line}: a key of more than {PARTS_MAX} parts, the limit")
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not TOML: {error}") from error
    except (ValueError, RecursionError) as error:
        # tomllib passes on errors of Python itself, for 5000-digit numbers and a thousand brackets.
        raise ConfigError(f"{name}: not usable: {error}") from error
    level: list[Any] = [tables]
    for _ in range(DEPTH_MAX):
        values = [below for value in level for below in (value.values() if isinstance(value, dict) else value)]
        level = [value for value in values if isinstance(value, dict | list)]
    if level:
        raise ConfigError(f"{name}: tables or lists nested more than {DEPTH_MAX} deep: this is not a scene or rig")
    return tables


def _blank_out(match: re.Match[str]) -> str:
    """Return spaces in as many lines and columns; a string on one line may be part of a key and becomes a letter."""
    spaces = re.sub(r"[^\n]", " ", match[0])
    return spaces if match["blank"] else f"s{spaces[1:]}"
