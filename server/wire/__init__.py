"""Network protocol: messages of telemetry and commands, their encoding, the endpoints, and the clients.

The servo loop waits for none of it.
"""
