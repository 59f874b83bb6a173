"""NUMBA_DISABLE_JIT=1 works for `Engine`, but a servo loop needs machine code."""

from __future__ import annotations

import os
import sys

from helpers.programs import run_program


def test_a_daemon_without_machine_code_is_refused_in_one_line() -> None:
    completed = run_program(
        [sys.executable, "-m", "softfinger.server.cli", "run", "--endpoint", "tcp://127.0.0.1:*"],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    )
    assert completed.returncode == 5
    assert "NUMBA_DISABLE_JIT is set" in completed.stderr and "Traceback" not in completed.stderr
