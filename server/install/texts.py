"""Texts that are installed: systemd unit of the daemon, and man page from the options of all verbs.

The daemon is a system service with a separate account, or a user service.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Final

from softfinger.drivers.system.rules import GROUP

RTPRIO: Final = 95
"""Above the servo's 80 and its supervisor's 81, below the kernel's threads at 99."""

HEAD: Final = """\
# Written by `softfinger install`. It neither updates nor removes a file that you have edited.
# Write your changes into a drop-in instead: systemctl {scope}edit softfinger
[Unit]
Description=softfinger, a haptic rendering server
Documentation=https://github.com/softfinger/softfinger

[Service]
Type=notify
NotifyAccess=main
ExecStart={command}
# The kernels of a new scene are compiled first.
TimeoutStartSec=5min
TimeoutStopSec=15s
# Ticks of the servo feed the watchdog. Without ticks the daemon itself removes the force after 0.25 s.
WatchdogSec=2s
# No automatic restart, because a hand may be on the device: correct the cause, then start the service.
Restart=no
Environment=PYTHONUNBUFFERED=1
RuntimeDirectory=softfinger
NoNewPrivileges=yes
LockPersonality=yes
RestrictSUIDSGID=yes
SystemCallArchitectures=native
"""

SYSTEM: Final = f"""\
User={GROUP}
Group={GROUP}
StateDirectory=softfinger
CacheDirectory=softfinger
WorkingDirectory=%S/softfinger
Environment=SOFTFINGER_CACHE_DIR=%C/softfinger
# The group can use the sockets that the rig names. Without [commands] endpoint only this account can send commands.
Environment=XDG_RUNTIME_DIR=%t
UMask=0007
LimitRTPRIO={RTPRIO}
LimitMEMLOCK=infinity
# If memory runs out, the kernel kills other programs first.
OOMScoreAdjust=-500

# Only these devices: the USB bus, hidraw nodes, serial ports on USB, and the control of processor sleep states.
DevicePolicy=closed
DeviceAllow=char-usb_device rw
DeviceAllow=char-hidraw rw
DeviceAllow=char-ttyACM rw
DeviceAllow=char-ttyUSB rw
DeviceAllow=/dev/cpu_dma_latency rw

ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
RestrictNamespaces=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
CapabilityBoundingSet=
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM
# Not MemoryDenyWriteExecute and RestrictRealtime: kernels are compiled in memory, and the servo requests SCHED_FIFO.

[Install]
WantedBy=multi-user.target
"""

USER: Final = """\
# The folder also has the sockets of the user's other daemons.
RuntimeDirectoryPreserve=yes
# The limits are those of the login: `softfinger install --system` raises them for the group softfinger.

[Install]
WantedBy=default.target
"""


def make_unit(words: Sequence[str], system: bool) -> str:
    """Return the unit that runs a command, given as a list of arguments."""
    program, *arguments = map(_quote, words)
    command = " ".join([program, *(word.replace("$", "$$") for word in arguments)])  # no expansion in the program
    head = HEAD.format(command=command, scope="" if system else "--user ")
    return head + (SYSTEM if system else USER)


def _quote(word: str) -> str:
    """Quote an argument for systemd, and escape specifiers and escape characters."""
    plain = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return plain if plain and not any(letter in plain for letter in " \t;'\"\\") else f'"{plain}"'


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
