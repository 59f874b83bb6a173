"""Types of command line arguments that several verbs take: refused before the work and not after it."""

import argparse
import re
from collections.abc import Sequence
from typing import Final

from softfinger.config.errors import ConfigError

_NAMED: Final = re.compile(r"([A-Za-z0-9_-]+)=(.+)", re.DOTALL)


def by_finger(values: Sequence[str], flag: str) -> dict[str, str]:
    """Files of an option that is given once, FILE, or for each of several fingers, NAME=FILE, by name.

    A FILE alone has the name "". Raises ConfigError for what is neither.
    """
    files: dict[str, str] = {}
    for value in values:
        match = _NAMED.fullmatch(value)
        name, file = (match[1], match[2]) if match else ("", value)
        if name in files or (files and "" in (name, *files)):
            raise ConfigError(f"{flag} {value}: give it once, or {flag} NAME=FILE for each of several fingers")
        files[name] = file
    return files


def duration(text: str) -> float:
    """A time of the command line, s."""
    seconds = float(text)
    if not 0.0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"{text}: a duration is more than 0 s")
    return seconds
