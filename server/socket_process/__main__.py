"""Entry of a process with ZeroMQ sockets: `python -m softfinger.server.socket_process NAME FD`.

NAME is telemetry or commands, and is shown by tools that list processes. FD is the channel to the daemon.
"""

from __future__ import annotations

import socket
import sys

from softfinger.server.socket_process.channel import Channel
from softfinger.server.socket_process.process import run_process

if __name__ == "__main__":
    run_process(Channel(socket.socket(fileno=int(sys.argv[2]))))
