"""Network protocol: messages of telemetry and commands, their encoding, the endpoints, and the clients.

The servo loop waits for none of it.
"""

from typing import Final

DEFAULT_ENDPOINT: Final = "tcp://127.0.0.1:5555"
"""Telemetry of a daemon whose rig names no other."""
