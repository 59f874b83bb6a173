"""Two fingers led at once: keys close them, and a drag of one leads the other."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.viewer.hand import BOTH, Hand, Led, Target, closed, mirrored
from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.nodes.looks import CM

viser = pytest.importorskip("viser")
pytestmark = pytest.mark.plain

PLACES = {"thumb": (-0.04, 0.0, 0.02), "index": (0.04, 0.0, 0.02)}


@pytest.fixture
def led() -> Iterator[tuple[Hand, dict[str, Target | None]]]:
    """A hand with two fingers on a page that nobody looks at, and where each was sent last."""
    server = viser.ViserServer(port=0, verbose=False)
    sent: dict[str, Target | None] = {}
    try:
        hand = Hand(server.gui, server.scene, sent.__setitem__)
        reach = np.full(3, 0.2)
        hand.change([Led(name, 0.01, -reach, reach) for name in PLACES])
        for name, place in PLACES.items():
            row = np.zeros(RECORD_SIZE)
            row[AT.probe_position : AT.probe_position + 3], row[AT.probe_orientation] = place, 1.0
            hand.see(name, row)
        yield hand, sent
    finally:
        server.stop()


def places(sent: dict[str, Any]) -> dict[str, list[float]]:
    return {name: np.round(target.position, 9).tolist() for name, target in sent.items()}


def test_a_way_is_mirrored_along_the_line_between_fingers() -> None:
    """Towards each other along it, together across it; of fingers in one place, together."""
    line = np.array([2.0, 0.0, 0.0])
    assert mirrored(np.array([0.3, 0.4, 0.5]), line).tolist() == [-0.3, 0.4, 0.5]
    assert mirrored(np.array([0.3, 0.4, 0.5]), 0.0 * line).tolist() == [0.3, 0.4, 0.5]
    assert closed(np.array([1.0, 0.0, 0.0]), np.zeros(3), 2.0).tolist() == [0.0, 0.0, 0.0]


def test_keys_close_two_fingers_and_lead_both(led: tuple[Hand, dict[str, Target | None]]) -> None:
    """Whichever is chosen, both come nearer; a way up leads the chosen one, and with both fingers each."""
    hand, sent = led
    hand.nudge(Nudge(close=0.001))
    assert places(sent) == {"thumb": [-0.039, 0.0, 0.02], "index": [0.039, 0.0, 0.02]}
    hand.nudge(Nudge(z=0.001))
    assert places(sent) == {"thumb": [-0.039, 0.0, 0.021], "index": [0.039, 0.0, 0.02]}
    hand._finger.value = BOTH
    hand.nudge(Nudge(z=0.001))
    assert places(sent) == {"thumb": [-0.039, 0.0, 0.022], "index": [0.039, 0.0, 0.021]}


def test_a_drag_of_one_finger_pinches_with_both(led: tuple[Hand, dict[str, Target | None]]) -> None:
    """Seen from above, the thumb is dragged 10 mm inwards and 5 mm aside: the index finger comes to meet it."""
    hand, sent = led
    hand._finger.value = BOTH
    eye = SimpleNamespace(camera=SimpleNamespace(position=CM * np.array([0.0, 0.0, 10.0])))
    ball = CM * np.array(PLACES["thumb"])
    for phase, end in (("start", ball), ("end", ball + CM * np.array([0.01, 0.005, 0.0]))):
        hand._dragged("thumb", SimpleNamespace(phase=phase, client=eye, start_position=ball, end_position=end), "move")
    thumb, index = places(sent)["thumb"], places(sent)["index"]
    assert thumb == pytest.approx([-0.03, 0.005, 0.02])
    assert index == pytest.approx([0.03, 0.005, 0.02])
