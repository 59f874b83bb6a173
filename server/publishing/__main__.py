"""`python -m softfinger.server.publishing NAME FD`: process for the endpoints NAME; FD is the channel to the daemon.

NAME is telemetry or commands, and is shown by tools that list processes.
"""

from __future__ import annotations

import socket
import sys

from softfinger.server.publishing.channel import Channel
from softfinger.server.publishing.process import publish

if __name__ == "__main__":
    publish(Channel(socket.socket(fileno=int(sys.argv[2]))))
