"""Arming computed from records only: calls that `Arming` makes for each batch of ticks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.guard import DISARMED, RAMPING, TOO_FAST
from softfinger.server.services.arming import Arming
from softfinger.server.states import NOT_ARMED_REASON, TOO_FAST_REASON, DaemonState, States

pytestmark = pytest.mark.plain


class DaemonStub:
    """Rendering that records the calls of `Arming` in order; `armed_at` is the first armed tick."""

    def __init__(self, arm: str, fingers: int = 1, armed_at: int = 0) -> None:
        self.rig = SimpleNamespace(guard=SimpleNamespace(arm=arm))
        self.servo = SimpleNamespace(devices=[None] * fingers)
        self.acts: list[Any] = []
        self.force = SimpleNamespace(
            switched_on_tick=armed_at,
            note_guard=lambda reason, tick: self.acts.append((reason, tick)),
            update_state=lambda: self.acts.append("update_state"),
        )

    def disarm(self, reason: str) -> None:
        self.acts.append(("disarm", reason))

    def arm(self, *reasons: str) -> None:
        self.acts.append(("arm", *reasons))


def batch(*ticks: tuple[int, list[tuple[float, float]]]) -> np.ndarray:
    out = np.zeros((len(ticks), len(ticks[0][1]) * RECORD_SIZE))
    for row, (tick, fingers) in zip(out, ticks, strict=True):
        for place, (bits, buttons) in enumerate(fingers):
            row[place * RECORD_SIZE + AT.tick] = tick
            row[place * RECORD_SIZE + AT.servo_guard], row[place * RECORD_SIZE + AT.buttons] = bits, buttons
    return out


def process_batches(daemon: DaemonStub, *batches: np.ndarray) -> list[Any]:
    arming = Arming(cast(Any, daemon), States())
    for records in batches:
        arming.take(records, 0)
    return [act for act in daemon.acts if act != "update_state"]


def test_the_first_batch_makes_ready() -> None:
    daemon, states = DaemonStub("command"), States()
    arming = Arming(cast(Any, daemon), states)
    assert arming.sink.name == "arming"
    arming.take(batch((0, [(0, 0)])), 0)
    assert daemon.acts == ["update_state"] and states.now is DaemonState.READY


@pytest.mark.parametrize("fingers", [1, 2])
def test_automatic_arming_reports_if_the_last_tick_was_too_fast(fingers: int) -> None:
    slow, fast = [(RAMPING, 0.0)] * fingers, [(0.0, 0.0)] * (fingers - 1) + [(TOO_FAST | RAMPING, 0.0)]
    assert process_batches(DaemonStub("automatic", fingers), batch((1, slow), (2, fast))) == [(TOO_FAST_REASON, True)]
    assert process_batches(DaemonStub("automatic", fingers), batch((1, fast), (2, slow))) == [(TOO_FAST_REASON, False)]


def test_a_disarmed_guard_is_not_too_fast() -> None:
    assert process_batches(DaemonStub("automatic"), batch((1, [(TOO_FAST | DISARMED, 0)]))) == [
        (TOO_FAST_REASON, False)
    ]
    assert process_batches(DaemonStub("automatic", armed_at=8), batch((7, [(TOO_FAST, 0)]))) == [
        (TOO_FAST_REASON, False)
    ]
    assert process_batches(DaemonStub("automatic", armed_at=8), batch((8, [(TOO_FAST, 0)]))) == [
        (TOO_FAST_REASON, True)
    ]


@pytest.mark.parametrize("arm", ["command", "button"])
def test_too_fast_disarms_with_arming_by_command_or_button(arm: str) -> None:
    assert process_batches(DaemonStub(arm), batch((1, [(TOO_FAST, 0)]), (2, [(0, 0)]))) == [("disarm", TOO_FAST_REASON)]
    assert process_batches(DaemonStub(arm), batch((1, [(0, 0)]))) == []


ARMED = [("arm", NOT_ARMED_REASON, TOO_FAST_REASON)]


def test_a_press_arms_if_the_rig_arms_by_button() -> None:
    press = batch((1, [(0, 0)]), (2, [(0, 1)]), (3, [(0, 1)]))
    assert process_batches(DaemonStub("button"), press) == ARMED
    assert process_batches(DaemonStub("command"), press) == []


@pytest.mark.parametrize(
    ("words", "armed"),
    [
        ([1.0, 1.0, 0.0], False),  # down from the start, then released
        ([0.0, 0.0], False),
        ([1.0, 0.0, 1.0], True),  # pressed again
        ([1.0, 3.0], True),  # a second button pressed
        ([3.0, 1.0], False),
        ([0.0, np.nan], False),
        ([0.0, np.inf], False),
        ([0.0, -1.0], False),
        ([0.0, 2.0**53], False),  # invalid: above 2**52 a float64 cannot represent every integer
        ([0.0, 2.0**52], True),
    ],
)
def test_a_press_is_a_button_that_was_up(words: list[float], armed: bool) -> None:
    ticks = [(number, [(0.0, word)]) for number, word in enumerate(words)]
    assert process_batches(DaemonStub("button"), batch(*ticks)) == (ARMED if armed else [])
    assert process_batches(DaemonStub("button"), *[batch(tick) for tick in ticks]) == (ARMED if armed else [])


def test_any_finger_may_press() -> None:
    assert process_batches(DaemonStub("button", 2), batch((1, [(0, 0), (0, 0)]), (2, [(0, 0), (0, 2)]))) == ARMED
    assert process_batches(DaemonStub("button", 2), batch((1, [(0, 1), (0, 0)]), (2, [(0, 0), (0, 1)]))) == []
