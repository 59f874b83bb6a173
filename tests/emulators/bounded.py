"""Runs a program on an emulated device with a time limit."""

import subprocess
import sys

LIMIT_S = 240.0
"""A cold cache on a busy machine takes minutes. Callers of the emulation wait longer, so no process outlives them."""


def run(command: list[str]) -> int:
    """Return the exit code, or 124 if the command was killed at the limit, as timeout(1) does."""
    try:
        return subprocess.run(command, check=False, timeout=LIMIT_S).returncode
    except subprocess.TimeoutExpired:
        print(f"{command}: has not ended within {LIMIT_S:g} s", file=sys.stderr, flush=True)
        return 124
