"""The page's frames: what goes on between them for as long as a page is open."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from softfinger.server.viewer import page

pytestmark = pytest.mark.plain


class Circle:
    """Holds itself, so a collection alone frees it."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def nothing_else_collects() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()
    gc.unfreeze()


@pytest.mark.usefixtures("nothing_else_collects")
def test_a_page_collects_its_garbage_while_it_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """With garbage CPython frees what it keeps of freed tuples, which no program can ask for."""
    monkeypatch.setattr(page, "COLLECT_S", 2.5 * page.FRAME_S)
    made: list[weakref.ref[Circle]] = []
    left: list[int] = []

    def work(dt: float) -> None:
        made.append(weakref.ref(Circle()))
        left.append(sum(each() is not None for each in made))

    page.run_frames(work, [], 20.0 * page.FRAME_S)
    assert len(left) > 10  # a busy machine has fewer frames than were asked for
    assert max(left) < 6
