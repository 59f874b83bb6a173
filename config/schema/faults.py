"""Faults to inject between a device and the servo loop: kind, start and duration.

A file contains `[[fault]]` tables, for `softfinger run --inject` and for tests. `drivers/fault_injector.py` applies
them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, ClassVar, Final, Literal

from msgspec import UNSET

from softfinger.config import limits
from softfinger.config.fields import Complaint, Point, Table, doc, is_usable, make_tag_attribute, sized, within

Number = Literal["x", "y", "z", "qw", "qx", "qy", "qz"]
Side = Literal["read", "write"]

NUMBERS: Final[tuple[Number, ...]] = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Numbers of a pose, in the order of a sample (drivers.base)."""


class FaultBase(Table, frozen=True, kw_only=True, tag_field="kind"):
    """Time at which a fault acts. Ticks count the reads of the device, from 0."""

    kind: ClassVar[str] = make_tag_attribute()
    at_tick: Annotated[int, within(limits.FAULT_TICK, "first tick with the fault", 500)] | None = None
    at_s: Annotated[float, within(limits.FAULT_TIME_S, "first tick as a time", 0.5)] | None = None
    ticks: Annotated[int, within(limits.FAULT_TICK, "duration in ticks; 1 if neither is set", 100)] | None = None
    for_s: Annotated[float, within(limits.FAULT_TIME_S, "duration as a time", 0.1)] | None = None
    every_ticks: Annotated[int, within(limits.FAULT_EVERY, "acts in one of this many ticks", 1)] = 1
    finger: Annotated[str, doc("finger whose device has the fault; empty: all fingers", "thumb")] = ""

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.at_tick, self.at_s) and (self.at_tick is None) == (self.at_s is None):
            if self.at_tick is None:
                yield "at_tick", UNSET, "is missing, as is at_s: set one of them"
            else:
                yield "at_s", self.at_s, "at_tick already sets the start: remove one of the two"
        if is_usable(self.ticks, self.for_s) and self.ticks is not None and self.for_s is not None:
            yield "for_s", self.for_s, "ticks already sets the duration: remove one of the two"

    def window(self, rate_hz: float) -> tuple[int, int]:
        """Return the first tick with the fault, and the first tick after it."""
        first = round((self.at_s or 0.0) * rate_hz) if self.at_tick is None else self.at_tick
        count = self.ticks if self.for_s is None else math.ceil(self.for_s * rate_hz)
        return first, first + (1 if count is None else count)


class Stale(FaultBase, frozen=True, kw_only=True, tag="stale"):
    """The device has no new sample: the driver returns the previous one and reports it as stale."""


class Frozen(FaultBase, frozen=True, kw_only=True, tag="frozen"):
    """The driver returns the previous sample as if it were new."""


class NotANumber(FaultBase, frozen=True, kw_only=True, tag="nan"):
    """A number of the pose is NaN."""

    number: Annotated[Number, doc("which of the pose", "x")] = "x"


class Infinite(FaultBase, frozen=True, kw_only=True, tag="infinite"):
    """A number of the pose is infinite."""

    number: Annotated[Number, doc("which of the pose", "z")] = "x"


class Teleport(FaultBase, frozen=True, kw_only=True, tag="teleport"):
    """The position jumps by an offset."""

    offset_m: Annotated[Point, doc("added to the position", [0.0, 0.0, -0.05])]


class Slow(FaultBase, frozen=True, kw_only=True, tag="slow"):
    """A call of the driver blocks."""

    block_s: Annotated[float, within(limits.FAULT_BLOCK_S, "for so long", 0.003)]
    on: Annotated[Side, doc("which call", "read")] = "read"


class Short(FaultBase, frozen=True, kw_only=True, tag="short"):
    """A sample arrives in part: the numbers after the first ones are 0."""

    numbers: Annotated[int, within(limits.FAULT_NUMBERS, "of the ten that arrive", 3)]


class Corrupt(FaultBase, frozen=True, kw_only=True, tag="corrupt"):
    """One random bit of the pose is flipped."""

    seed: Annotated[int, within(limits.FAULT_SEED, "of the random numbers", 1)] = 1


class Bounce(FaultBase, frozen=True, kw_only=True, tag="bounce"):
    """Buttons bounce: they are inverted in every other tick."""

    every_ticks: Annotated[int, within(limits.FAULT_EVERY, "acts in one of this many ticks", 2)] = 2
    buttons: Annotated[int, within(limits.FAULT_BUTTONS, "which, a bit each", 1)] = 1


class Disconnect(FaultBase, frozen=True, kw_only=True, tag="disconnect"):
    """The device is disconnected: no call reaches it, and each one fails. It is back at the end of the fault."""


class Timeout(FaultBase, frozen=True, kw_only=True, tag="timeout"):
    """The device does not answer in time. A write that fails does not reach it."""

    on: Annotated[Side, doc("which call", "write")] = "read"


class Protocol(FaultBase, frozen=True, kw_only=True, tag="protocol"):
    """The device violates its protocol in an answer. A write that fails does not reach it."""

    on: Annotated[Side, doc("which call", "write")] = "read"


class ForceOff(FaultBase, frozen=True, kw_only=True, tag="force_off"):
    """The device switches its own force off and reports it."""


class Withheld(FaultBase, frozen=True, kw_only=True, tag="withheld"):
    """The driver writes zero in place of the force and reports it."""


class HeldForce(FaultBase, frozen=True, kw_only=True, tag="held"):
    """The device does not accept the force and keeps the previous one; the driver reports it."""


class Swallowed(FaultBase, frozen=True, kw_only=True, tag="swallowed"):
    """The force never arrives: the device keeps the previous one, but the driver reports success."""


Injection = (
    Stale | Frozen | NotANumber | Infinite | Teleport | Slow | Short | Corrupt | Bounce | Disconnect | Timeout
    | Protocol | ForceOff | Withheld | HeldForce | Swallowed
)  # fmt: skip
"""Any fault."""


class Faults(Table, frozen=True, kw_only=True):
    """Faults to inject, each at its time; several may act in one tick."""

    fault: Annotated[list[Injection], sized(limits.FAULTS, "faults, each with its kind and time")]
