"""Configuration of a rig's [device] with `driver = "falcon"`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final

from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Point, Table, doc, within
from softfinger.drivers.mounting import check_timeout

GAIN: Final = Range(100.0, 1e6, "4095 counts, the maximum, are then 41 N m and 4 mN m at a leg")
SILENCE_S: Final = Range(0.005, 0.2, "a reply takes 2 ms; after a longer silence the force is outdated")
GIVE_UP_S: Final = Range(0.005, 2.0, "a reply takes 2 ms; a longer time hides a lost device")
HOMING_S: Final = Range(0.0, 600.0, "time for a person to move the knob out and in")

COUNTS_PER_NM: Final = 10000.0
"""Value of libnifalcon. There is no published measurement."""


class Options(Table, frozen=True, kw_only=True):
    """Selection of the device, its firmware, and its motors."""

    serial: Annotated[str, doc("serial number, if several are attached", "SN42")] | None = None
    firmware: (
        Annotated[str, doc("firmware file, sent to the device if no firmware runs in it", "/home/me/falcon.bin")] | None
    ) = None
    counts_per_nm: (
        Annotated[float, within(GAIN, "motor counts per N m at a leg; default: 10000, not measured", 10000.0)] | None
    ) = None
    motors_reversed: Annotated[bool, doc("a positive motor count pulls the knob in, as in libnifalcon", True)] = True
    centre_m: Annotated[
        Point, doc("origin of the world in the device frame: right, up, towards the user", [0.0, 0.0, 0.11])
    ] = (0.0, 0.0, 0.11)
    homing_s: Annotated[float, within(HOMING_S, "time limit for homing by the user", 60.0)] = 60.0
    kick_s: Annotated[
        float, within(SILENCE_S, "time without a reply after which zeros are sent instead of forces", 0.02)
    ] = 0.02
    timeout_s: Annotated[
        float, within(GIVE_UP_S, "time without a reply after which the device counts as lost", 0.1)
    ] = 0.1

    def faults(self) -> Iterator[Complaint]:
        yield from check_timeout(self, "kick_s", "zero")
