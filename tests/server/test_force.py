"""State machine of the force: on, fading, off, and the ticks between these."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.server.services.force import ARM_TICKS, Force
from softfinger.server.states import FAST, UNARMED, States

pytestmark = pytest.mark.plain

TO_ZERO = 17
"""Ticks that the slew limit needs to remove a force."""
TICKS = st.integers(0, 10_000)


@given(TICKS)
def test_a_force_is_off_after_it_faded_and_arm_ticks_passed(at: int) -> None:
    """The force fades for TO_ZERO ticks; the guard then needs ARM_TICKS to reset. No step is earlier."""
    force = Force(False, States())
    assert (force.share, force.wanted) == (1.0, True)
    force.keep_off(FAST)
    assert force.advance(at, TO_ZERO) and force.share is None
    assert not force.advance(at + TO_ZERO - 1, TO_ZERO) and not force.is_off(at + TO_ZERO - 1)
    assert force.advance(at + TO_ZERO, TO_ZERO) and force.share == 0.0
    assert not force.is_off(at + TO_ZERO + ARM_TICKS - 1) and force.is_off(at + TO_ZERO + ARM_TICKS)


@given(TICKS)
def test_a_force_is_given_once_nothing_keeps_it_off(at: int) -> None:
    """The last reason counts. `given_at` excludes ticks that may have begun without the force."""
    force = Force(True, States())
    assert (force.share, force.wanted) == (0.0, False)
    force.keep_off(FAST)
    force.allow(UNARMED)
    assert not force.advance(at, TO_ZERO) and force.kept_off(FAST) and not force.kept_off(UNARMED)
    force.allow(FAST)
    assert force.advance(at, TO_ZERO) and force.share == 1.0
    assert force.given_at == at + ARM_TICKS
    assert not force.advance(at, TO_ZERO)  # no further step


@given(TICKS)
def test_a_force_that_is_taken_off_comes_back_after_it_was_off(at: int) -> None:
    """Armed while it fades, the force returns only after the guard was reset."""
    force = Force(False, States())
    force.keep_off(FAST)
    force.advance(at, TO_ZERO)
    force.allow(FAST)
    assert not force.advance(at + TO_ZERO - 1, TO_ZERO)
    assert force.advance(at + TO_ZERO, TO_ZERO) and force.share == 0.0
    off = at + TO_ZERO + ARM_TICKS
    assert not force.advance(off - 1, TO_ZERO)
    assert force.advance(off, TO_ZERO) and (force.share, force.given_at) == (1.0, off + ARM_TICKS)


@given(TICKS)
def test_a_new_loop_waits_for_nothing_of_the_one_before(at: int) -> None:
    """A new loop has its own ticks: `begin` cancels the wait of the previous loop."""
    force = Force(False, States())
    force.keep_off(FAST)
    force.advance(at + 1, TO_ZERO)
    force.begin(0.0)
    assert force.is_off(0)
    force.allow(FAST)
    assert force.advance(0, TO_ZERO) and force.share == 1.0
