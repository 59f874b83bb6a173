"""systemd unit of the daemon, as a system service with a separate account, or as a user service."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from softfinger.drivers.system.rules import GROUP

RTPRIO: Final = 95
"""Above the servo's 80 and its supervisor's 81, below the kernel's threads at 99."""

HEAD: Final = """\
# Written by `softfinger install`. A file that you edit is neither updated nor removed any more.
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
# Fed by ticks of the servo. Long before, after a quarter of a second, the daemon itself takes the force off.
WatchdogSec=2s
# Nothing restarts by itself while a hand is on the device: mend the cause, and start it again.
Restart=no
Environment=PYTHONUNBUFFERED=1
RuntimeDirectory=softfinger
# Of a user it is the folder of all their daemons' sockets: it stays when this one ends.
RuntimeDirectoryPreserve=yes
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
# Sockets that the rig names are for the group; where it names none for commands, theirs is for this account alone.
Environment=XDG_RUNTIME_DIR=%t
UMask=0007
LimitRTPRIO={RTPRIO}
LimitMEMLOCK=infinity

# The devices, and no other: the USB bus, hidraw nodes, serial ports on USB, and what keeps processors awake.
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
# Not MemoryDenyWriteExecute and RestrictRealtime: kernels are compiled in memory, and the servo asks for SCHED_FIFO.

[Install]
WantedBy=multi-user.target
"""

USER: Final = """\
# Limits are those of the login: `softfinger install --system` raises them for the group softfinger.

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
