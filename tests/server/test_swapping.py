"""Swapped memory of the daemon: reported once, and again after it was zero."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from softfinger.server.services.watches import SWAPPED, SwapWatch

pytestmark = pytest.mark.plain


def test_memory_in_swap_is_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    events: list[tuple[str, str, str]] = []

    def event(kind: str, name: str, message: str) -> None:
        events.append((kind, name, message))

    status = tmp_path / "status"
    watch = SwapWatch(event, status)
    for kilobytes in (0, 40, 80, 0, 12):
        status.write_text(f"Name:\tpython3\nVmStk:\t   132 kB\nVmSwap:\t   {kilobytes} kB\nThreads:\t3\n")
        watch.check()
    assert [(kind, name, message.split(":")[0]) for kind, name, message in events] == [
        ("fault", SWAPPED, f"{kilobytes} kB of the daemon are in swap") for kilobytes in (40, 12)
    ]
    assert caplog.text.count("softfinger doctor") == 2


def test_the_first_check_is_immediate_and_failures_are_events(tmp_path: Path) -> None:
    events: list[Any] = []
    watch = SwapWatch(lambda *words, **fields: events.append((words, fields)), tmp_path / "nothing")
    watch.start()
    watch._thread.join(10.0)
    watch.stop()
    ((words, fields),) = events
    assert words == ("fault", SWAPPED) and "No such file" in fields["message"]
