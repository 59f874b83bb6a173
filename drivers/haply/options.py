"""Configuration of a rig's [device] with `driver = "haply"`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final, Literal

from msgspec import Meta

from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Table, doc, is_usable, within
from softfinger.drivers.mounting import MountedOptions, check_timeout

PORT: Final = Range(1, 65535, "the ports of TCP")
FORCE_MAX_N: Final = Range(0.0, 20.0, "twice the stated maximum of any of these devices")
GAIN: Final = Range(0.0, 1.0, "0 disables the filter; values above 1 are not documented")
DAMPING: Final = Range(0.0, 10.0, "the vendor states no range")
GRAVITY: Final = Range(0.0, 2.0, "1 compensates the weight of the device; 2 accelerates it upwards")
SILENCE_S: Final = Range(
    0.005, 0.2, "a shorter time counts late answers as silence; after a longer one the force is outdated"
)
GIVE_UP_S: Final = Range(0.005, 2.0, "a shorter time counts late answers as silence; a longer one hides a lost service")
DEFAULT_PORT: Final = 10001
OLD_FORMAT_PORT: Final = 10000


class Filters(Table, frozen=True, kw_only=True):
    """Force processing by the service. The defaults are those of the service; they are set when a device is opened."""

    force_gate: Annotated[float, within(GAIN, "gain of the filter against oscillation", 0.3)] = 0.3
    damping: Annotated[float, within(DAMPING, "damping that the service adds; unit not published", 0.0)] = 0.0
    gravity_compensation: Annotated[bool, doc("compensate the weight of the device", True)] = True
    gravity_scale: Annotated[float, within(GRAVITY, "fraction of the weight that is compensated", 1.0)] = 1.0
    torque_scaling: Annotated[bool, doc("scale motor torques; the method is not published", True)] = True


class Options(MountedOptions, frozen=True, kw_only=True):
    """Selection of device and grip, mount, limits, filters and timeouts."""

    port: Annotated[int, within(PORT, "port of the Inverse Service on this machine", DEFAULT_PORT)] = DEFAULT_PORT
    version: (
        Annotated[str, Meta(pattern=r"^\d+\.\d+(\.\d+)?$"), doc("of the service, if it does not send it", "3.5")] | None
    ) = None
    models: (
        Annotated[
            tuple[Literal["inverse3", "inverse3x", "minverse"], ...],
            Meta(min_length=1),
            doc("the only kinds of device to accept; absent: any", ["inverse3", "inverse3x"]),
        ]
        | None
    ) = None
    device_id: (
        Annotated[str, Meta(max_length=64), doc("the service's name of it, where several are attached", "049D")] | None
    ) = None
    grip: Annotated[
        str,
        Meta(max_length=64),
        doc("VerseGrip for orientation and buttons: auto (the only one), none, or its id", "none"),
    ] = "auto"
    force_max_n: Annotated[float, within(FORCE_MAX_N, "largest force displayed", 2.0)]
    workspace_radius_m: Annotated[float, Meta(gt=0.0, le=1.0), doc("about the world's origin", 0.1)]
    filters: Filters = Filters()
    stale_s: Annotated[float, within(SILENCE_S, "age above which a force is replaced by zero", 0.02)] = 0.02
    quiet_s: Annotated[float, within(SILENCE_S, "time without a state after which no force is sent", 0.02)] = 0.02
    timeout_s: Annotated[
        float, within(GIVE_UP_S, "time without a state after which the device counts as lost", 0.1)
    ] = 0.1

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.port) and self.port == OLD_FORMAT_PORT:
            yield "port", self.port, "is the port of format 3.0, which this driver does not support: use 10001"
        yield from check_timeout(self, "quiet_s", "zero")


def rows(options: Options) -> list[tuple[str, str]]:
    """Return rows for `softfinger check` about the filters, which change every force."""
    filters = options.filters
    weight = f"times {filters.gravity_scale:g}" if filters.gravity_compensation else "off"
    return [
        ("  filters", f"force gate {filters.force_gate:g}, damping {filters.damping:g}, gravity compensation {weight}, "
         f"torque scaling {'on' if filters.torque_scaling else 'off'}, home return off: set when it is opened"),
    ]  # fmt: skip
