"""`python -m softfinger.server.publishing FD`: the publisher; the daemon starts it with FD, its end of the channel."""

from __future__ import annotations

import socket
import sys

from softfinger.server.publishing.channel import Channel
from softfinger.server.publishing.process import publish

if __name__ == "__main__":
    publish(Channel(socket.socket(fileno=int(sys.argv[1]))))
