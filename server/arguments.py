"""The parser of every verb, and types of arguments that several take: refused before the work and not after it."""

import argparse
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

from softfinger.config.errors import ConfigError

_NAMED: Final = re.compile(r"([A-Za-z0-9_-]+)=(.+)", re.DOTALL)


class Parser(argparse.ArgumentParser):
    """argparse's, that takes -v and -q before a verb and behind it, and says which name is near a misspelt one.

    Parsers of verbs, and of what is below these, are of the same class: argparse sees to that.
    """

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        # Without a default: one of a verb would undo what stood before it.
        how_much = self.add_mutually_exclusive_group()
        for flags, help in ((("-v", "--verbose"), "log more"), (("-q", "--quiet"), "log warnings and errors alone")):
            how_much.add_argument(*flags, action="store_true", default=argparse.SUPPRESS, help=help)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse what no parser knows here, where its near names are known, and not in the parser above."""
        found, left = super().parse_known_args(args, namespace)
        if left:
            self._refuse(left)
        return found, left

    def _refuse(self, words: Sequence[str]) -> NoReturn:
        from softfinger.config.words import near  # takes longer to import than a command line to parse

        known = [flag for action in self._actions for flag in action.option_strings]
        told = [word + (near(word.partition("=")[0], known) if word.startswith("--") else "") for word in words]
        self.error(f"unrecognized arguments: {' '.join(told)}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            from softfinger.config.words import near

            error.message += near(value, action.choices or ())
            raise


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


def keep_apart(flag: str, written: str | Path, read: Iterable[str | Path]) -> None:
    """Raise ConfigError where what an option has written is what is read: it would be lost."""
    from softfinger.config.files import is_same_file

    for each in read:
        if is_same_file(each, written):
            raise ConfigError(f"{flag} {written}: is {each}, which is read: name another file")


def default_rig(scene: str, otherwise: str) -> str:
    """The rig of a run that names none: the shipped one of its scene, else another."""
    from softfinger.config.load import shipped
    from softfinger.config.schema import Rig

    own = f"simulated-{scene}"
    return own if own in shipped(Rig) else otherwise


def duration(text: str) -> float:
    """A time of the command line, s."""
    seconds = float(text)
    if not 0.0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"{text}: a duration is more than 0 s and less than 1e9 s")
    return seconds
