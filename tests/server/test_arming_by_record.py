"""Who arms, from the records alone: what arming asks of the rendering for each batch of ticks. `test_arming.py` has the
same with a daemon and its device."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.guard import DISARMED, RAMPING, TOO_FAST
from softfinger.server.services.arming import Arming
from softfinger.server.states import FAST, UNARMED, DaemonState, States

pytestmark = pytest.mark.plain


class Asked:
    """What is asked of the rendering, in order; `armed_at` is the tick from which on it is armed."""

    def __init__(self, arm: str, fingers: int = 1, armed_at: int = 0) -> None:
        self.rig = SimpleNamespace(guard=SimpleNamespace(arm=arm))
        self.servo = SimpleNamespace(devices=[None] * fingers)
        self.acts: list[Any] = []
        self.force = SimpleNamespace(
            switched_on_tick=armed_at,
            note_guard=lambda reason, there: self.acts.append((reason, there)),
            update_state=lambda: self.acts.append("update_state"),
        )

    def disarm(self, reason: str) -> None:
        self.acts.append(("disarm", reason))

    def arm(self, *reasons: str) -> None:
        self.acts.append(("arm", *reasons))


def batch(*ticks: tuple[int, list[tuple[float, float]]]) -> np.ndarray:
    """Records of ticks: number, and guard's bits and buttons of each finger."""
    out = np.zeros((len(ticks), len(ticks[0][1]) * RECORD_SIZE))
    for row, (tick, fingers) in zip(out, ticks, strict=True):
        for place, (bits, buttons) in enumerate(fingers):
            row[place * RECORD_SIZE + AT.tick] = tick
            row[place * RECORD_SIZE + AT.servo_guard], row[place * RECORD_SIZE + AT.buttons] = bits, buttons
    return out


def taken(asked: Asked, *batches: np.ndarray) -> list[Any]:
    """What is asked for the batches, one after the other; without what is asked each time."""
    arming = Arming(cast(Any, asked), States())
    for records in batches:
        arming.take(records, 0)
    return [act for act in asked.acts if act != "update_state"]


def test_each_batch_is_followed_and_the_first_makes_ready() -> None:
    """The state leaves `starting`, and goes by what keeps the force off."""
    asked, states = Asked("command"), States()
    arming = Arming(cast(Any, asked), states)
    assert arming.sink.name == "arming"
    arming.take(batch((0, [(0, 0)])), 0)
    assert asked.acts == ["update_state"] and states.now is DaemonState.READY


@pytest.mark.parametrize("fingers", [1, 2])
def test_automatic_tells_whether_the_last_tick_was_too_fast(fingers: int) -> None:
    """Of any finger; of the last tick of the batch; nothing is disarmed."""
    slow, fast = [(RAMPING, 0.0)] * fingers, [(0.0, 0.0)] * (fingers - 1) + [(TOO_FAST | RAMPING, 0.0)]
    assert taken(Asked("automatic", fingers), batch((1, slow), (2, fast))) == [(FAST, True)]
    assert taken(Asked("automatic", fingers), batch((1, fast), (2, slow))) == [(FAST, False)]


def test_a_disarmed_guard_is_not_too_fast() -> None:
    """It gives no force anyway; nor does a tick from before it was armed count, and that of arming does."""
    assert taken(Asked("automatic"), batch((1, [(TOO_FAST | DISARMED, 0)]))) == [(FAST, False)]
    assert taken(Asked("automatic", armed_at=8), batch((7, [(TOO_FAST, 0)]))) == [(FAST, False)]
    assert taken(Asked("automatic", armed_at=8), batch((8, [(TOO_FAST, 0)]))) == [(FAST, True)]


@pytest.mark.parametrize("arm", ["command", "button"])
def test_where_a_person_arms_too_fast_disarms(arm: str) -> None:
    """In whichever tick of the batch it was, and tells no fault that goes by itself."""
    assert taken(Asked(arm), batch((1, [(TOO_FAST, 0)]), (2, [(0, 0)]))) == [("disarm", FAST)]
    assert taken(Asked(arm), batch((1, [(0, 0)]))) == []


ARMED = [("arm", UNARMED, FAST)]


def test_a_press_arms_where_the_rig_has_that() -> None:
    """Once for the batch in which a button goes down, and not by command."""
    press = batch((1, [(0, 0)]), (2, [(0, 1)]), (3, [(0, 1)]))
    assert taken(Asked("button"), press) == ARMED
    assert taken(Asked("command"), press) == []


@pytest.mark.parametrize(
    ("words", "armed"),
    [
        ([1.0, 1.0, 0.0], False),  # held from the start, and its release
        ([0.0, 0.0], False),
        ([1.0, 0.0, 1.0], True),  # pressed again
        ([1.0, 3.0], True),  # a second one beside it
        ([3.0, 1.0], False),
        ([0.0, np.nan], False),
        ([0.0, np.inf], False),
        ([0.0, -1.0], False),
        ([0.0, 2.0**53], False),  # no word of buttons, which are whole numbers that a float64 has
        ([0.0, 2.0**52], True),
    ],
)
def test_what_is_a_press(words: list[float], armed: bool) -> None:
    """A button that was up in the tick before, in one batch and over several."""
    ticks = [(number, [(0.0, word)]) for number, word in enumerate(words)]
    assert taken(Asked("button"), batch(*ticks)) == (ARMED if armed else [])
    assert taken(Asked("button"), *[batch(tick) for tick in ticks]) == (ARMED if armed else [])


def test_any_finger_may_press() -> None:
    """Buttons of all count; one that takes over from another is a press."""
    assert taken(Asked("button", 2), batch((1, [(0, 0), (0, 0)]), (2, [(0, 0), (0, 2)]))) == ARMED
    assert taken(Asked("button", 2), batch((1, [(0, 1), (0, 0)]), (2, [(0, 0), (0, 1)]))) == []
