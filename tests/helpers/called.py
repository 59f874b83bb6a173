"""Run verbs of the command line in this process, for tests that need no separate process."""

import contextlib
import io
from typing import NamedTuple

from softfinger.server import cli


class VerbResult(NamedTuple):
    """Exit code and output of a verb, without its log."""

    returncode: int
    stdout: str
    stderr: str


def called(*words: str) -> VerbResult:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main(list(words))
        except SystemExit as ended:  # argparse
            code = int(str(ended.code))
    return VerbResult(code, out.getvalue(), err.getvalue())


def read_stdout(*words: str) -> str:
    """Run a verb that must succeed; return its standard output."""
    result = called(*words)
    assert result.returncode == 0, result.stderr
    return result.stdout
