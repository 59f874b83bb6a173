"""Frame loop of the page: work that it does as long as a page is open."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from softfinger.server.viewer import page

pytestmark = pytest.mark.plain


class Circle:
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
    """A collection also frees CPython's free lists of tuples, which programs cannot clear directly."""
    monkeypatch.setattr(page, "COLLECT_S", 2.5 * page.FRAME_S)
    made: list[weakref.ref[Circle]] = []
    alive: list[int] = []

    def work(dt: float) -> None:
        made.append(weakref.ref(Circle()))
        alive.append(sum(reference() is not None for reference in made))

    page.run_frames(work, [], 20.0 * page.FRAME_S)
    assert len(alive) > 10  # a busy machine runs fewer frames
    assert max(alive) < 6
