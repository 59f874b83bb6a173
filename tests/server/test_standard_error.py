"""Lines on a standard error without a reader."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections.abc import Iterator
from io import FileIO

import pytest

from softfinger.server.standard_error import write_line

pytestmark = pytest.mark.plain


@contextlib.contextmanager
def full_pipe() -> Iterator[FileIO]:
    """Replace the standard error by a full pipe; yield its end for reading."""
    reader, writer = os.pipe()
    for end in (reader, writer):
        os.set_blocking(end, False)  # a write that would wait raises instead
    with open(reader, "rb", buffering=0) as log_file, open(writer, "w") as stream:
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writer, bytes(select.PIPE_BUF))
        with contextlib.redirect_stderr(stream):
            yield log_file


def test_the_last_line_waits_for_its_reader() -> None:
    with full_pipe() as log_file:

        def resume() -> None:
            time.sleep(0.1)  # the line is waiting by then, usually
            log_file.read(16 * select.PIPE_BUF)

        resuming = threading.Thread(target=resume)
        resuming.start()
        write_line("last", wait_s=20.0)
        resuming.join()
        assert (log_file.read(32 * select.PIPE_BUF) or b"").endswith(b"last\n")


def test_unread_lines_are_dropped_and_counted() -> None:
    with full_pipe() as log_file:
        write_line("first")
        write_line("second", wait_s=0.01)
        while log_file.read(select.PIPE_BUF):
            pass
        write_line("third")
        assert log_file.read(200) == b"(2 lines are missing here: they were not read in time)\nthird\n"
        write_line(1_000_000 * "x")  # longer than the pipe, such as a traceback
        while log_file.read(select.PIPE_BUF):
            pass
        write_line("fourth")
        assert log_file.read(200) == b"(1 lines are missing here: they were not read in time)\nfourth\n"
        write_line("fourth")
        assert log_file.read(200) == b"fourth\n"
