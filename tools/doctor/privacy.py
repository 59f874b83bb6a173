"""Removal from reports of the names of user and machine, folders, and all but the end of serial numbers.

`doctor --device-report` and `report` call it. Folders of the system and of this program remain.
"""

from __future__ import annotations

import contextlib
import getpass
import os
import platform
import pwd
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from softfinger.config.files import find_home_folder

KEPT_KEYS: Final = frozenset({"driver", "id"})
"""Keys with values from this program, which a user of the same name as a driver does not change."""

FILE_KEYS: Final = frozenset({"file", "model"})
FOLDER_KEYS: Final = frozenset({"directory"})
"""Keys of rigs and scenes with a path as their value, which may contain spaces and have no suffix."""

_START: Final = r"(?:(?<=ipc://)|(?<![\w./~>])(?!//))(?!/(?:dev|sys|proc|usr|etc|run(?!/media))\b)(?:~[\w-]*|\.{1,2})?/"
_QUOTED: Final = re.compile(rf"""(?<=['"]){_START}[^'"\n]*(?=['"])""")
_PATH: Final = re.compile(rf"""{_START}[^\s'"<>,;:()=]+""")
_RELATIVE: Final = re.compile(r"(?<![\w./~>-])(?!docs/|softfinger/)(?:[\w.+-]+/)+(?=[\w+-]+\.[A-Za-z])")
"""Folders in front of a file name with a suffix; `N/m` is not a path."""

_BY_ID: Final = re.compile(r"(/dev/\S*by-id/)\S+")
_SERIAL: Final = re.compile(
    r"(serial(?: number)?[ =:]*['\"]?)(?![0-9a-f]{4}:[0-9a-f]{4}\b)([\w-]*\d[\w-]*)", re.IGNORECASE
)
"""USB ids after the name of the driver `serial` do not match."""


def shorten_serial(serial: str) -> str:
    """Return the last two characters of a serial number, enough to distinguish two devices on a desk."""
    return f"...{serial[-2:]}" if len(serial) > 3 else "..." if serial else ""


class Redactor:
    """Removal of identifying words from texts.

    Parameters
    ----------
    serials
        Serial numbers of the attached devices.
    """

    def __init__(self, serials: Iterable[str] = ()) -> None:
        folders = dict.fromkeys(_list_homes(), "~") | {
            str(Path.cwd()): ".",
            sys.prefix: "<environment>",
            str(Path(__file__).resolve().parents[2]): "softfinger",
            str(Path(__file__).parents[2]): "softfinger",
        }
        self._folders = [
            (re.compile(rf"(?<![\w.~-]){re.escape(folder)}(?![\w.-])"), folders[folder])
            for folder in sorted(folders, key=len, reverse=True)
            if folder not in {"", "/", "/usr"}
        ]
        host = platform.node()
        words = dict.fromkeys(_list_users(), "<user>") | dict.fromkeys((host, host.partition(".")[0]), "<host>")
        words |= {serial: shorten_serial(serial) for serial in serials}
        words.pop("", None)
        self._words = words
        longest_first = "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))
        self._pattern = re.compile(rf"(?<![A-Za-z0-9])(?:{longest_first})(?![A-Za-z0-9])") if words else None

    def clean(self, value: Any) -> Any:
        """Return `value`, made of mappings, lists and scalars, with every text in it cleaned; keys do not change."""
        if isinstance(value, dict):
            return {key: self._redact_entry(key, item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [self.clean(item) for item in value]
        return self.text(value) if isinstance(value, str) else value

    def _redact_entry(self, key: str, value: Any) -> Any:
        if key in KEPT_KEYS:
            return value
        if isinstance(value, str) and key in FILE_KEYS:
            value = Path(value).name
        elif isinstance(value, str) and key in FOLDER_KEYS and value != ".":
            return "..."
        return self.clean(value)

    def text(self, text: str) -> str:
        for folder, name in self._folders:
            text = folder.sub(name, text)
        for pattern in (_QUOTED, _PATH):
            text = pattern.sub(lambda match: _extract_file_name(match[0]), text)
        text = _RELATIVE.sub("", text)
        text = _BY_ID.sub(r"\1...", text)
        text = _SERIAL.sub(lambda match: match[1] + shorten_serial(match[2]), text)
        return text if self._pattern is None else self._pattern.sub(lambda match: self._words[match[0]], text)


def redact_options(values: dict[str, Any]) -> dict[str, Any]:
    """Return the device options of a rig with files without their folders and a shortened serial number."""
    public: dict[str, Any] = {}
    for key, value in values.items():
        if key == "serial":
            public[key] = shorten_serial(str(value))
        elif isinstance(value, dict):
            public[key] = redact_options(value)
        elif isinstance(value, str) and "/" in value and not value.startswith("/dev/"):
            public[key] = Path(value).name
        else:
            public[key] = value
    return public


def _extract_file_name(path: str) -> str:
    """Return the last part of a path if it has an ending, else `...`: it may be a folder."""
    return Path(path).name if Path(path).suffix else "..."


def _list_homes() -> set[str]:
    homes = {str(find_home_folder() or ""), os.environ.get("HOME", "")}
    with contextlib.suppress(KeyError):  # a user without an entry, as in some containers
        homes.add(pwd.getpwuid(os.getuid()).pw_dir)
    return {home.rstrip("/") for home in homes}


def _list_users() -> set[str]:
    names = {os.environ.get(key, "") for key in ("USER", "LOGNAME", "SUDO_USER")}
    with contextlib.suppress(KeyError, OSError):
        names |= {getpass.getuser(), pwd.getpwuid(os.getuid()).pw_name}
    return names
