"""Wait for a condition instead of a time; the bound is generous, because a machine may be busy or compile."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from softfinger.drivers.base import OK
from softfinger.server.driver_contract import DeviceCaller

WAIT_S = float(os.environ.get("SOFTFINGER_TEST_WAIT_S", "120"))
"""Longest wait, s; shorter with a planted mistake (`tests/mutants.py`), for which a test waits in vain."""


def eventually(condition: Callable[[], Any], seconds: float = WAIT_S, every_s: float = 0.001) -> Any:
    """Wait until a function returns a true value; return its last value."""
    end = time.monotonic() + seconds
    while not (value := condition()) and time.monotonic() < end:
        time.sleep(every_s)
    return value


def until(condition: Callable[[], Any], seconds: float = WAIT_S, message: str = "") -> None:
    """Fail unless a function returns a true value in time."""
    assert eventually(condition, seconds), f"{message or 'the condition'}: not within {seconds} s"


def fresh(servo: DeviceCaller) -> list[float]:
    samples: list[list[float]] = []

    def comes() -> bool:
        status, sample = servo.read()
        assert status >= 0, f"status {status}"
        samples.append(sample)
        return status == OK

    until(comes, 10.0, "a new sample")
    return samples[-1]


class TookTooLong(BaseException):
    """Not an Exception, which the tested code might handle as a failed read: a TimeoutError is an OSError."""


@contextmanager
def ends_within(seconds: int) -> Iterator[None]:
    """Raise TookTooLong in the block if it takes longer."""

    def late(*_: object) -> None:
        raise TookTooLong(f"it takes more than {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def repeated(act: Callable[[], Any], every_s: float = 0.02) -> Iterator[None]:
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(every_s):
            act()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
