"""systemd unit of the daemon, as a system service with a separate account, or as a user service."""

from __future__ import annotations

from collections.abc import Sequence
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
# In a user service the folder also has the sockets of the user's other daemons.
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
# The group can use the sockets that the rig names. Without [commands] endpoint only this account can send commands.
Environment=XDG_RUNTIME_DIR=%t
UMask=0007
LimitRTPRIO={RTPRIO}
LimitMEMLOCK=infinity

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
