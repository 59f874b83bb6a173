"""Man page, generated from the options of all verbs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib.metadata import version
from typing import Final

LAST_SECTIONS: Final = r"""
.SH FILES
.TP
.I ~/.cache/softfinger
compiled kernels; SOFTFINGER_CACHE_DIR sets another folder
.TP
.I /etc/softfinger/installed.json
what `softfinger install \-\-system` has written; without \-\-system: ~/.local/state/softfinger/installed.json
.SH SEE ALSO
https://github.com/softfinger/softfinger
"""


def make_manual(parser: argparse.ArgumentParser) -> str:
    """Return the text of softfinger.1 in man(7) macros, from the program's parser with the options of all verbs."""
    lines = [
        f'.TH SOFTFINGER 1 "" "softfinger {version("softfinger")}" "User Commands"',
        *(".SH NAME", rf"softfinger \- {_escape('real-time haptic rendering server')}"),
        *(".SH SYNOPSIS", ".B softfinger", '.RI [ options "] " verb " [" options ]'),
        *(".SH DESCRIPTION", _escape(parser.description or "")),
        *(".SH OPTIONS", *_iter_options(parser)),
        ".SH VERBS",
    ]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, verb in action.choices.items():
                lines += [f".SS softfinger {_escape(name)}", _escape(verb.description or ""), *_iter_options(verb)]
    lines += [".SH EXIT STATUS", _escape(" ".join((parser.epilog or "").split()).removeprefix("Exit codes: "))]
    return "\n".join(lines) + LAST_SECTIONS


def _iter_options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield each argument as a tagged paragraph, and the verbs below a verb in the same form."""
    formatter = parser._get_formatter()
    for action in parser._actions:
        if action.help is argparse.SUPPRESS:
            continue
        if isinstance(action, argparse._SubParsersAction):
            if parser.prog != "softfinger":
                for name, verb in action.choices.items():
                    yield from (".TP", f".B {_escape(name)}", _escape(verb.description or verb.format_usage()))
                    yield from (".RS", *_iter_options(verb), ".RE")
            continue
        yield from (".TP", f".B {_escape(formatter._format_action_invocation(action))}")
        yield _escape(formatter._expand_help(action) if action.help else "")


def _escape(text: str) -> str:
    """Escape text for roff."""
    plain = " ".join(text.split()).replace("\\", r"\e").replace("-", r"\-")
    return rf"\&{plain}" if plain.startswith((".", "'")) else plain
