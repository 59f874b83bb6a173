"""What a rig may say of a device on a serial port: which one, where it stands, its limits, its silences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final

from msgspec import Meta

from softfinger.config import limits
from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Table, known, said, within
from softfinger.drivers.mounting import Mounting

USB_ID: Final = Range(0, 0xFFFF, "two bytes in the USB device descriptor")
FORCE_MAX_N: Final = Range(0.0, 32.0, "a frame gives mN as a number of two bytes, which ends at 32.767 N")
SILENCE_S: Final = Range(
    0.005, 0.2, "below, a late answer is a silence; above, force acts where the device was long ago"
)
GIVE_UP_S: Final = Range(
    0.005, 2.0, "below, a late answer is a silence; above, a device that is gone would go unnoticed"
)
WAKE_S: Final = Range(0.2, 60.0, "below, one kick has no time to work; nobody waits longer than a minute")


class Options(Table, frozen=True, kw_only=True):
    """What a rig's [device] table may say for `driver = "serial"`."""

    vendor_id: Annotated[int, within(USB_ID, "USB vendor", 0x16C0)]
    product_id: Annotated[int, within(USB_ID, "USB product", 0x0483)]
    serial: Annotated[str, said("serial number, where several are attached", "SN42")] | None = None
    path: Annotated[str, said("port, in place of looking for one", "/dev/ttyACM0")] | None = None
    mounting: Mounting = Mounting()
    force_max_n: Annotated[float, within(FORCE_MAX_N, "most that it displays", 5.0)]
    stiffness_max_n_per_m: Annotated[float, within(limits.STIFFNESS_N_PER_M, "most that it renders stably", 1000.0)]
    damping_max_ns_per_m: Annotated[float, within(limits.DAMPING_NS_PER_M, "the same of damping", 8.0)]
    workspace_radius_m: Annotated[float, Meta(gt=0.0, le=1.0), said("about the device's origin", 0.1)]
    quiet_s: Annotated[float, within(SILENCE_S, "after so long without a frame no force is sent", 0.02)] = 0.02
    kick_s: Annotated[float, within(SILENCE_S, "a silent device is kicked so often", 0.1)] = 0.1
    timeout_s: Annotated[float, within(GIVE_UP_S, "after so long without a frame the device is given up", 0.2)] = 0.2
    wake_s: Annotated[float, within(WAKE_S, "time to wake the device when it is opened", 3.0)] = 3.0

    def faults(self) -> Iterator[Complaint]:
        if known(self.quiet_s, self.timeout_s) and self.timeout_s < self.quiet_s:
            yield "timeout_s", self.timeout_s, f"must be at least quiet_s = {self.quiet_s:g}, so that a kick can help"
