"""The supervisor: its actions when ticks stop, and a failure of itself."""

from __future__ import annotations

import sys
import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest

from softfinger.config.errors import HapticError, SafetyStop
from softfinger.server.loop.health import STALL_MAX_S, STALL_POLL_S, STALL_POLLS, STALL_POLLS_WITHOUT_HAND
from softfinger.server.services import supervisor as supervising
from softfinger.server.services.supervisor import Supervisor

pytestmark = pytest.mark.plain

WAIT_S = 20.0


class BrokenServo:
    is_ticking = True

    @property
    def ticks(self) -> int:
        raise OSError("gone")


def test_a_supervisor_that_fails_ends_the_run() -> None:
    """A stall would go unnoticed, so the run ends with the error of the supervisor."""
    errors: list[HapticError] = []
    failed = threading.Event()

    def fail(error: HapticError) -> None:
        errors.append(error)
        failed.set()

    supervisor = Supervisor(cast(Any, BrokenServo()), fail, lambda *words, **fields: None)
    supervisor.start()
    assert failed.wait(WAIT_S)
    supervisor.stop()
    (error,) = errors
    assert (
        isinstance(error, SafetyStop)
        and "gone" in str(error)
        and "a stall of the servo would not be detected" in str(error)
    )


def test_a_stall_is_reported_and_every_device_stopped_if_anything_fails() -> None:
    calls: list[str] = []
    ended = threading.Event()

    class Device:
        info = SimpleNamespace(has_persistent_force=True)

        def __init__(self, name: str) -> None:
            self.name = name

        def stop(self) -> None:
            calls.append(f"stop {self.name}")
            raise OSError("the port has gone")

    def event(kind: str, name: str, **fields: Any) -> None:
        calls.append(f"{kind} {name}")
        ended.set()

    servo = SimpleNamespace(is_ticking=True, ticks=7, is_armed=True, devices=(Device("a"), Device("b")))
    supervisor = Supervisor(cast(Any, servo), lambda error: calls.append(str(error).partition(" for ")[0]), event)
    supervisor.start()
    assert ended.wait(WAIT_S)
    supervisor.stop()
    assert calls[0] == "no tick" and sorted(calls[1:3]) == ["stop a", "stop b"] and calls[3:] == ["fault stalled"]


class StalledServo:
    is_ticking, is_armed, looks = True, True, 0

    def __init__(self, *hold_a_force: bool) -> None:
        infos = [SimpleNamespace(has_persistent_force=holds) for holds in hold_a_force]
        self.devices = tuple(SimpleNamespace(info=info, stop=lambda: None) for info in infos)

    @property
    def ticks(self) -> int:
        self.looks += 1
        return 7


@pytest.mark.parametrize(
    ("hold_a_force", "looks"),
    [
        ((True,), STALL_POLLS),
        ((True, False), STALL_POLLS),
        ((False, True), STALL_POLLS),
        ((True, True), STALL_POLLS),
        ((False, False), STALL_POLLS_WITHOUT_HAND),
        ((False,), STALL_POLLS_WITHOUT_HAND),
    ],
)
def test_a_stall_is_longer_without_a_hand(
    hold_a_force: tuple[bool, ...], looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rests: list[float] = []
    monkeypatch.setattr(supervising.time, "sleep", rests.append)
    servo, errors = StalledServo(*hold_a_force), list[HapticError]()
    Supervisor(cast(Any, servo), errors.append, lambda *words, **fields: None).work()
    assert servo.looks == 1 + looks and rests == [STALL_POLL_S] * (1 + looks)
    assert f"no tick for {looks * STALL_POLL_S:.2f} s after tick 7:" in str(errors[0])


class Clock:
    def __init__(self, turn: float) -> None:
        self.now, self._turn = 0.0, turn

    def sleep(self, seconds: float) -> None:
        self.now += seconds + self._turn


@pytest.mark.parametrize("turn", [0.0, sys.getswitchinterval()])
@pytest.mark.parametrize("share", [1e-9, 0.3, 0.7, 1.0])
def test_a_stall_ends_with_zero_within_the_bound_of_the_fault_model(
    turn: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the last tick to the stop: STALL_POLLS intervals and the supervisor's turns, at most STALL_MAX_S."""
    clock, stopped = Clock(turn), list[float]()
    monkeypatch.setattr(supervising.time, "sleep", clock.sleep)
    step = STALL_POLL_S + turn
    last = (3.0 + share) * step  # a tick every millisecond before it, and none afterwards

    class Running:
        is_ticking, is_armed = True, True
        devices = (
            SimpleNamespace(
                info=SimpleNamespace(has_persistent_force=True), stop=lambda: stopped.append(clock.now + turn)
            ),
        )

        @property
        def ticks(self) -> int:
            return int(min(clock.now, last) * 1000.0) + (clock.now >= last)

    Supervisor(cast(Any, Running()), lambda error: None, lambda *words, **fields: None).work()
    (reaction,) = (when - last for when in stopped)
    assert reaction == pytest.approx((1.0 - share + STALL_POLLS) * step + turn, abs=1e-9)  # rounding of sums
    assert STALL_POLLS * STALL_POLL_S - 1e-9 <= reaction <= STALL_MAX_S


class UnarmedServo:
    ticks, is_armed = 0, False
    devices = (SimpleNamespace(info=SimpleNamespace(has_persistent_force=True)),)

    def __init__(self, looks: int) -> None:
        self._looks = looks

    @property
    def is_ticking(self) -> bool:
        self._looks -= 1
        return self._looks > 0


def test_a_servo_that_waits_for_its_devices_is_not_stalled() -> None:
    calls: list[Any] = []
    supervisor = Supervisor(
        cast(Any, UnarmedServo(8 * STALL_POLLS)), calls.append, lambda *words, **_: calls.append(words)
    )
    supervisor.work()
    assert calls == []
