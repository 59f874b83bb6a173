"""Installation on a machine, with a record for removal: udev rules, limits, systemd unit, man page and completion.

Contains no code that the daemon needs: only texts are installed.
"""
