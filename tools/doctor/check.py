"""Result of one check of `doctor`."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

State = Literal["good", "could be better", "bad"]
STATES: Final[tuple[State, ...]] = ("good", "could be better", "bad")


class Check(NamedTuple):
    """Observation, expectation, and the command or setting as the remedy; a good state has no remedy."""

    name: str
    state: State
    seen: str
    wanted: str
    remedy: str = ""


def grade(value: float, fair: float, bad: float) -> State:
    """Return the state of a number that is good up to `fair` and bad above `bad`."""
    return STATES[(value > fair) + (value > bad)]


def format_lines(checks: list[Check]) -> list[str]:
    text = []
    for check in checks:
        text.append(f"  {check.state:<16}{check.name}: {check.seen}")
        if check.state != "good":
            text.append(f"  {'':<16}  wanted: {check.wanted}")
            if check.remedy:
                text.append(f"  {'':<16}  remedy: {check.remedy}")
    return text
