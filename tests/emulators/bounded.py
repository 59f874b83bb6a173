"""The program beside an emulated device, for no longer than it may take."""

from __future__ import annotations

import subprocess
import sys

LIMIT_S = 240.0
"""A cold cache on a busy machine takes minutes. Whoever waits for the emulation waits longer: nothing is left alone."""


def run(command: list[str]) -> int:
    """Its exit code; 124 if it was killed because it did not end, as of timeout(1)."""
    try:
        return subprocess.run(command, check=False, timeout=LIMIT_S).returncode
    except subprocess.TimeoutExpired:
        print(f"{command}: has not ended within {LIMIT_S:g} s", file=sys.stderr, flush=True)
        return 124
