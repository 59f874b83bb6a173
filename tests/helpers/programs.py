"""Programs that a test starts."""

import subprocess
import threading
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Final

LIMIT_S: Final = 300.0
"""Time limit of a program: a cold start on a busy machine takes one or two minutes."""


class Program(subprocess.Popen[Any]):
    """A program that is killed after LIMIT_S, and at the end of the block if that fails or with `kill_at_end`.

    `Popen` would wait at the end of its block until the program ends, and a program that does not end would block a
    failed test, as would a read of its output.
    """

    def __init__(self, *args: Any, kill_at_end: bool = False, **options: Any) -> None:
        super().__init__(*args, **options)
        self._kill_at_end = kill_at_end
        self._over = threading.Timer(LIMIT_S, self.kill)
        self._over.daemon = True
        self._over.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None or self._kill_at_end:
            self.kill()
        super().__exit__(kind, error, trace)
        self._over.cancel()


def run_program(
    command: Sequence[Any], *, check: bool = False, timeout: float = 2.0 * LIMIT_S, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end; return its exit code and output as text. `check`: fail with its output unless 0."""
    process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=timeout, **options)
    assert not check or process.returncode == 0, f"exit {process.returncode}\n{process.stdout}{process.stderr}"
    return process
