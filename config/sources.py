"""Files of scenes, rigs, faults and experiments: shipped ones by name, their paths, and their tables.

A file is untrusted TOML. tomllib needs time and memory that grow with the square of the number of parts in a dotted
key, and accepts tables that are nested deeper than Python's recursion limit. Keys are checked in the text before it is
parsed, nesting in the result.
"""

from __future__ import annotations

import errno
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from softfinger.config.arguments import describe_refusal
from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input
from softfinger.config.schema import Faults, Rig, Scene
from softfinger.config.words import format_value, suggest

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


_CONFIG_FOLDER: Final = Path(__file__).resolve().parent
FOLDERS: Final[Mapping[type[msgspec.Struct], Path]] = {
    Scene: _CONFIG_FOLDER / "scenes",
    Rig: _CONFIG_FOLDER / "rigs",
    Faults: _CONFIG_FOLDER / "faults",
}
EXPERIMENTS: Final = _CONFIG_FOLDER / "experiments"
_KINDS: Final[Mapping[type[msgspec.Struct], str]] = {Scene: "scene", Rig: "rig", Faults: "file of faults"}
_SIZE_MAX: Final = 1 << 20


def list_shipped(struct_type: type[msgspec.Struct]) -> list[str]:
    return list_names(FOLDERS[struct_type])


def list_names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.toml"))


def find(path_or_name: str | Path, struct_type: type[msgspec.Struct]) -> Path:
    """Return the path of a scene, rig or file of faults: see `find_in`."""
    return find_in(FOLDERS[struct_type], _KINDS[struct_type], path_or_name)


def find_in(folder: Path, kind: str, path_or_name: str | Path) -> Path:
    """Return the path of a file; shipped files of its kind are in `folder`.

    A text without a folder and without .toml names a shipped file or, if there is none, an existing file. Raises
    ConfigError if it is neither. Any other path need not exist.
    """
    try:
        path = Path(path_or_name)
    except TypeError:
        raise ConfigError(describe_refusal(kind, path_or_name, "a name or a path")) from None
    if isinstance(path_or_name, Path) or path.name != path_or_name or path.suffix == ".toml":
        return path
    names = list_names(folder)
    if path_or_name in names:
        return folder / f"{path_or_name}.toml"
    try:
        if path.exists():
            return path
    except (OSError, ValueError):
        pass
    example = f"my-{kind.split()[-1]}.toml"
    raise ConfigError(
        f"no {kind} is called {format_value(path_or_name)}{suggest(path_or_name, names)}; "
        f"shipped are {', '.join(names)}; name another file by its path with suffix, such as {example}"
    )


def choose_folder(file: Path, name: str) -> Path:
    """Return the folder of `file`, or of its target if it is a link and only that folder contains the path `name`."""
    if file.is_symlink() and not os.path.lexists(file.parent / name):
        folder = file.resolve().parent
        if os.path.lexists(folder / name):
            return folder
    return file.parent


def read_toml(path: str | Path, where: str | None = None) -> dict[str, Any]:
    """Read the tables of a TOML file; raises ConfigError with the file, and line and column of a syntax error."""
    name = format_path(path) if where is None else where
    try:
        data = read_input(path, _SIZE_MAX)
    except FileNotFoundError as error:
        raise ConfigError(f"{name}: no such file{_suggest_sibling(Path(path))}") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{name}: is a folder: name a .toml file in it") from error
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno == errno.EFBIG:
            raise ConfigError(f"{name}: larger than {_SIZE_MAX} bytes: this is not a scene or rig") from error
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"{name}: cannot be read: {reason}") from error
    try:
        text = data.decode("utf-8-sig")  # editors on Windows put a byte order mark in front
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            f"{name}: not UTF-8: byte 0x{data[error.start]:02x} at line {line}: save the file as UTF-8"
        ) from error
    return parse_toml(text, name)


def format_path(path: str | Path) -> str:
    """Return a path for messages: complete, and on one line even with control characters."""
    return repr(str(path))[1:-1]


def _suggest_sibling(path: Path) -> str:
    """Return a hint for a missing file: a similar name in its folder, or a shipped name."""
    try:
        siblings = [file.name for file in path.parent.glob("*.toml")]
    except (OSError, ValueError):
        siblings = []
    hint = suggest(path.name, siblings)
    names = [name for kind in FOLDERS for name in list_shipped(kind)]
    if not hint and path.suffix == ".toml":
        hint = suggest(path.stem, names)
        hint += " (shipped: named without folder and suffix)" if hint else ""
    return hint
