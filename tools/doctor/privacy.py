"""What a report must not carry: names of the user and of the machine, folders, whole serial numbers."""

from __future__ import annotations

import contextlib
import getpass
import os
import platform
import pwd
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

KEPT_KEYS: Final = frozenset({"driver", "id"})
"""Their values are words of this program: a user who is called like a driver does not change them."""

_BY_ID: Final = re.compile(r"(/dev/\S*by-id/)\S+")
_SERIAL: Final = re.compile(
    r"(serial(?: number)?[ =:]*['\"]?)(?![0-9a-f]{4}:[0-9a-f]{4}\b)([\w-]*\d[\w-]*)", re.IGNORECASE
)
"""USB ids behind the name of the driver `serial` are none."""


def shortened(serial: str) -> str:
    """The last two characters of a serial number: enough to tell two devices on a desk apart."""
    return f"...{serial[-2:]}" if len(serial) > 3 else "..." if serial else ""


class Privacy:
    """Takes out of texts what says whose report it is."""

    def __init__(self, serials: Iterable[str] = ()) -> None:
        self._homes = sorted({home for home in _homes() if len(home) > 1}, key=len, reverse=True)
        words = dict.fromkeys(_users(), "<user>") | dict.fromkeys(_hosts(), "<host>")
        words |= {serial: shortened(serial) for serial in serials}
        words.pop("", None)
        self._words = words
        longest_first = "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))
        self._pattern = re.compile(rf"(?<![A-Za-z0-9])(?:{longest_first})(?![A-Za-z0-9])") if words else None

    def clean(self, value: Any) -> Any:
        """`value`, made of mappings, lists and scalars, with every text in it cleaned; keys stay."""
        if isinstance(value, dict):
            return {key: one if key in KEPT_KEYS else self.clean(one) for key, one in value.items()}
        if isinstance(value, list | tuple):
            return [self.clean(one) for one in value]
        return self.text(value) if isinstance(value, str) else value

    def text(self, text: str) -> str:
        for home in self._homes:
            text = re.sub(rf"{re.escape(home)}(?![A-Za-z0-9])", "~", text)
        text = _BY_ID.sub(r"\1...", text)
        text = _SERIAL.sub(lambda found: found[1] + shortened(found[2]), text)
        return text if self._pattern is None else self._pattern.sub(lambda found: self._words[found[0]], text)


def options(given: dict[str, Any]) -> dict[str, Any]:
    """A rig's options of its device, files without their folders, and the serial number shortened."""
    kept: dict[str, Any] = {}
    for key, value in given.items():
        if key == "serial":
            kept[key] = shortened(str(value))
        elif isinstance(value, dict):
            kept[key] = options(value)
        elif isinstance(value, str) and "/" in value and not value.startswith("/dev/"):
            kept[key] = Path(value).name
        else:
            kept[key] = value
    return kept


def _homes() -> set[str]:
    homes = {str(Path.home()), os.environ.get("HOME", "")}
    with contextlib.suppress(KeyError):  # a user without an entry, as in some containers
        homes.add(pwd.getpwuid(os.getuid()).pw_dir)
    return {home.rstrip("/") for home in homes}


def _users() -> set[str]:
    names = {os.environ.get(key, "") for key in ("USER", "LOGNAME", "SUDO_USER")}
    with contextlib.suppress(KeyError, OSError):
        names |= {getpass.getuser(), pwd.getpwuid(os.getuid()).pw_name}
    return names


def _hosts() -> set[str]:
    name = platform.node()
    return {name, name.partition(".")[0]}
