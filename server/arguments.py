"""Argument parser of all verbs, and argument types that several verbs share; refuses bad values before work starts."""

import argparse
import math
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Self

from softfinger.config.errors import ConfigError
from softfinger.server.wire import DEFAULT_ENDPOINT

_NAMED_FILE: Final = re.compile(r"([A-Za-z0-9_-]+)=(.+)", re.DOTALL)


class Parser(argparse.ArgumentParser):
    """ArgumentParser that accepts -v and -q before and after the verb and suggests names similar to a misspelt one.

    argparse creates the parsers of verbs and of their sub-commands from the same class. `configure` adds the options
    when the parser is first used, so that only the modules of one verb are imported.
    """

    def __init__(self, *args: Any, configure: Callable[[Any], None] | None = None, **options: Any) -> None:
        super().__init__(*args, **options)
        self._configure = configure
        # SUPPRESS: a default of the verb's parser would overwrite the value parsed before the verb.
        verbosity = self.add_mutually_exclusive_group()
        for flags, help in (
            (("-v", "--verbose"), "log debug messages"),
            (("-q", "--quiet"), "log only warnings and errors"),
        ):
            verbosity.add_argument(*flags, action="store_true", default=argparse.SUPPRESS, help=help)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown arguments here, where similar option names are known, and not in the parent parser."""
        self._add_options()
        namespace, unknown = super().parse_known_args(args, namespace)
        if unknown:
            from softfinger.config.words import suggest  # importing it takes longer than parsing a command line

            flags = [flag for action in self._actions for flag in action.option_strings]
            suggestions = [
                word + (suggest(word.partition("=")[0], flags) if word.startswith("--") else "") for word in unknown
            ]
            self.error(f"unrecognized arguments: {' '.join(suggestions)}")
        return namespace, unknown

    def complete(self) -> Self:
        """Add the options of all verbs, for texts that list them; return the parser."""
        self._add_options()
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                for parser in action.choices.values():
                    parser.complete()
        return self

    def _add_options(self) -> None:
        configure, self._configure = self._configure, None
        if configure is not None:
            configure(self)

    def _parse_optional(self, arg_string: str) -> Any:
        """Accept the columns `-,t,x` as a value: no option has a comma."""
        return None if arg_string.startswith("-,") else super()._parse_optional(arg_string)

    def _get_values(self, action: argparse.Action, arg_strings: Any) -> Any:
        """Refuse empty values, as of an unset shell variable, and the value `--`, which argparse deletes."""
        is_option = bool(action.option_strings)
        if action.nargs != argparse.PARSER and ("" in arg_strings or (is_option and "--" in arg_strings)):
            raise argparse.ArgumentError(action, f"{arg_strings[0]!r}: give a value, or leave out the argument")
        return super()._get_values(action, arg_strings)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            from softfinger.config.words import suggest

            error.message += suggest(value, action.choices or ())
            raise


def add_option(parser: argparse._ActionsContainer, name: str, help: str, default: Any = None, **settings: Any) -> None:
    """Add a positional argument or an option. With a default, which the help text shows, values are of its type."""
    if default not in (None, "", []):
        settings = {"type": type(default)} | settings
        shown = " ".join(map(str, default)) if isinstance(default, list | tuple) else "%(default)s"
        help = f"{help} (default: {shown})"
    parser.add_argument(name, help=help, default=default, **settings)


def add_flag(parser: argparse._ActionsContainer, name: str, help: str) -> None:
    """Add an option without a value."""
    parser.add_argument(name, action="store_true", help=help)


def add_duration(parser: argparse._ActionsContainer, name: str, help: str, default: float | None = None) -> None:
    """Add an option that is a time in s."""
    add_option(parser, name, help, default, metavar="S", type=duration)


def add_daemon_options(parser: argparse._ActionsContainer, commands: bool = False) -> None:
    """Add the options of a client: endpoint of the daemon, `--commands` if requested, and keys."""
    add_option(parser, "--endpoint", "telemetry or commands endpoint of the daemon", default=DEFAULT_ENDPOINT)
    if commands:
        add_option(
            parser, "--commands", "commands endpoint of the daemon (default: derived from --endpoint)", metavar="URL"
        )
    add_option(parser, "--keys", "secret key of this client, if the server requires one", metavar="FILE")
    add_option(parser, "--server-key", "public key of the server", metavar="FILE")


def add_stream_options(parser: argparse._ActionsContainer) -> None:
    """Add `--duration` and `--timeout` of a client of the telemetry."""
    add_duration(parser, "--duration", "stop after S seconds (default: when the daemon ends, or Ctrl-C)")
    add_duration(parser, "--timeout", "stop if no telemetry arrives for S seconds", default=3.0)


def parse_files_by_finger(values: Sequence[str], flag: str) -> dict[str, str]:
    """Return the files of a repeatable option by finger name.

    Parameters
    ----------
    values
        FILE, given once, or NAME=FILE for each of several fingers.
    flag
        Name of the option, for the message.

    Returns
    -------
    dict
        File by name; a FILE without a name has the key "".

    Raises
    ------
    ConfigError
        If a name is repeated, or if values with and without a name are mixed.
    """
    files: dict[str, str] = {}
    for value in values:
        match = _NAMED_FILE.fullmatch(value)
        name, file = (match[1], match[2]) if match else ("", value)
        if name in files or (files and "" in (name, *files)):
            raise ConfigError(f"{flag} {value}: use it once, or {flag} NAME=FILE for each of several fingers")
        files[name] = file
    return files


def check_distinct(flag: str, output: str | Path, read: Iterable[str | Path]) -> None:
    """Raise ConfigError if an output option names an input file, which would be lost."""
    from softfinger.config.files import is_same_file

    for source in read:
        if is_same_file(source, output):
            raise ConfigError(f"{flag} {output}: is the input file {source}: choose another output file")


def find_default_rig(scene: str, fallback: str) -> str:
    """Return the default rig of a run: the shipped rig `simulated-<scene>` if it exists, else `fallback`."""
    from softfinger.config.schema import Rig
    from softfinger.config.sources import list_shipped

    name = f"simulated-{scene}"
    return name if name in list_shipped(Rig) else fallback


def duration(text: str) -> float:
    seconds = float(text)
    if not 0.0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"{text}: the duration must be above 0 s and below 1e9 s")
    return seconds


def within(low: float, high: float = math.inf, reason: str = "") -> Callable[[str], float]:
    """Return the type of an option whose numbers are from `low` to `high`; integers if `low` is one."""

    def number(text: str) -> float:
        value = type(low)(text)
        if not low <= value <= high:
            limits = f"at least {low:g}" if high == math.inf else f"from {low:g} to {high:g}"
            raise argparse.ArgumentTypeError(f"{text}: must be {limits}{reason and f': {reason}'}")
        return value

    return number


def parse_parameter(word: str) -> tuple[str, Any]:
    """Parse an argument key=value; the value is JSON, a TOML value, or else a text."""
    key, equals, text = word.partition("=")
    if not equals or not key:
        from softfinger.config.words import format_value

        raise ConfigError(f"{format_value(word)} is not a parameter: write key=value")
    import json
    import tomllib

    with suppress(ValueError, RecursionError):
        return key, json.loads(text)
    with suppress(ValueError, RecursionError):
        return key, tomllib.loads(f"value = {text}")["value"]
    return key, text
