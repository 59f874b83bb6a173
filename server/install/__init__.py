"""The installation: udev rules, limits, a systemd unit, the man page, completion; written, recorded, taken away again.

No servo and no device: what is installed is text, and the daemon runs without any of it.
"""
