"""NUMBA_DISABLE_JIT=1 serves `Engine`; a servo loop needs machine code."""

from __future__ import annotations

import os
import subprocess
import sys


def test_a_daemon_without_machine_code_is_refused_by_a_line() -> None:
    """`softfinger run` says what is set and what to do, with the exit code of a real-time setting."""
    done = subprocess.run(
        [sys.executable, "-m", "softfinger.server.cli", "run", "--endpoint", "tcp://127.0.0.1:*"],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        timeout=120.0,
    )
    assert done.returncode == 5
    assert "NUMBA_DISABLE_JIT is set" in done.stderr and "Traceback" not in done.stderr
