"""Shares that progress displays show."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from softfinger.server import progress


def collect_shares(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[float]]:
    """Return the shares of each displayed operation, which are collected instead of shown."""
    shares = defaultdict[str, list[float]](list)

    @contextmanager
    def collect(stage: str, total: int, detail: Callable[[], str]) -> Iterator[Callable[[float], None]]:
        yield lambda count: shares[stage].append(count / total)

    monkeypatch.setattr(progress, "_show_lines", collect)
    monkeypatch.setattr(progress, "on_terminal", lambda: False)
    return shares
