"""Measure the age of a pose when the servo reads it, and of a force when the device has it: `python
tests/handover_age.py`, `make handover-age`.

For drivers that exchange poses and forces with a thread or a vendor's library, and for boards on a serial port, which
answer each frame or send unprompted. Devices on stubs are read and written by one compiled loop, called like in the
servo, without the interpreter lock. The stub's pose contains the time at which it was made, by a clock that all
processes share, and its log has the arrival time of each force. Both ages therefore include messages, sockets, threads
and their delays.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from emulators.clockboard import ClockBoard
from helpers.c_stub import COMPILER, NO_COMPILER, compile_stub
from helpers.haply_devices import Service, opened
from helpers.hd_stub import SOURCE, HdStub
from numpy.typing import NDArray

from softfinger.config.errors import DeviceTimeout, HapticError
from softfinger.config.load import build
from softfinger.drivers.base import OK, SAMPLE_SIZE, Device
from softfinger.drivers.openhaptics.device import Options as TouchOptions
from softfinger.drivers.openhaptics.device import open_device as open_touch
from softfinger.drivers.serial.device import Options as SerialOptions
from softfinger.drivers.serial.device import open_device as open_serial
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.server.driver_contract import RATE_HZ
from softfinger.server.loop.clock import read_clock_ns, sleep_until
from softfinger.tools import measure

WARM_TICKS: Final = 200
"""Left out at the beginning."""
LOWEST_N: Final = 0.1
STEP_N: Final = 1e-4
FORCES: Final = 1000
"""Number of distinct forces: LOWEST_N and steps above it, in turn; a force is never older than a second."""


class End(NamedTuple):
    """A device, and the received forces (k, 2): s of the monotonic clock, N along z. Its x is the clock's fraction."""

    device: Device
    received_forces: Callable[[], NDArray[np.float64]]


@numba.njit(**OPTIONS)
def _run(ios: Any, period_ns: int, times: Any, places: Any, fresh: Any, memory: Any) -> int:
    """Read and write every device in each tick; return the negative status that ended it, or 0.

    times   (n, devices, 2) int64 ns    out: after the read, before the write
    places  (n, devices) float64 m      out: x of the sample
    fresh   (n, devices) bool           out: whether the sample is new
    memory  sample, wrench, timespec
    """
    sample, wrench, timespec = memory
    deadline = read_clock_ns(timespec)
    for n in range(len(times)):
        deadline += period_ns
        sleep_until(deadline, timespec)
        wrench[2] = LOWEST_N + STEP_N * (n % FORCES)
        for k in range(len(ios)):
            io = ios[k]
            status = call_device(io.read, io.handle, sample)
            times[n, k, 0] = read_clock_ns(timespec)
            if status < 0:
                return status
            places[n, k], fresh[n, k] = sample[0], status == OK
            times[n, k, 1] = read_clock_ns(timespec)
            call_device(io.write, io.handle, wrench)
    return 0


@contextmanager
def haply() -> Iterator[list[End]]:
    """Two Inverse3 on one emulated Inverse Service, each with its own thread and session."""
    names = ("049D", "0A11")
    with Service(devices=tuple(f"inverse3:{name}" for name in names)) as service, ExitStack() as undo:
        ends = []
        for name in names:
            service.do("move", id=name, to="clock")
            device = undo.enter_context(opened(service, device_id=name, mounting={}))
            ends.append(End(device, lambda name=name: np.array(service.log(name))[:, [0, 3]]))  # type: ignore[misc]
        yield ends


@contextmanager
def openhaptics() -> Iterator[list[End]]:
    """A Touch on the stub of libHD, whose thread calls the driver once per millisecond."""
    with tempfile.TemporaryDirectory() as folder:
        stub = HdStub(compile_stub(SOURCE, Path(folder) / "libHD.so.3.4.0", "-pthread"))
        stub["clock"] = 1.0

        def received_forces() -> NDArray[np.float64]:
            rows = stub.journal()
            return np.column_stack([rows["ns"] * 1e-9, rows["force"][:, 1]])  # up is the library's y

        with open_touch(TouchOptions(library_file=str(stub.path)), RATE_HZ) as device:
            yield [End(device, received_forces)]


@contextmanager
def serial(mode: str) -> Iterator[list[End]]:
    """A board behind a pseudo terminal, which answers each frame or sends one a millisecond."""
    with ExitStack() as undo:
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory()))
        board = undo.enter_context(ClockBoard(mode, folder / "log"))
        device = undo.enter_context(open_serial(build(SerialOptions, board.options, "the board's rig"), RATE_HZ))
        yield [End(device, board.received_forces)]


CASES: Final[dict[str, Callable[[], AbstractContextManager[list[End]]]]] = {
    "haply": haply,
    "openhaptics": openhaptics,
    "serial, answer": partial(serial, "answer"),
    "serial, stream": partial(serial, "stream"),
}


def run(ends: list[End], ticks: int, rate_hz: float) -> dict[str, Any]:
    """Ages (s) of the poses that were new and of the forces that arrived, and the shares of both."""
    count, whole = len(ends), ticks + WARM_TICKS
    times, places = np.zeros((whole, count, 2), np.int64), np.zeros((whole, count))
    fresh = np.zeros((whole, count), np.bool_)
    memory = (np.zeros(SAMPLE_SIZE), np.zeros(6), np.zeros(2, np.int64))
    ios = tuple(end.device.io() for end in ends)
    period_ns = round(1e9 / rate_hz)
    _run(ios, period_ns, times[:0], places[:0], fresh[:0], memory)  # compiles
    for end in ends:
        end.device.arm()
    status = _run(ios, period_ns, times, places, fresh, memory)
    if status < 0:
        raise DeviceTimeout(f"a device failed with status {status} ({ends[0].device.reason()}): is this machine busy?")
    for end in ends:
        end.device.stop()
    keep = slice(WARM_TICKS, None)
    read = times[keep, :, 0] * 1e-9
    poses = ((read - places[keep]) % 1.0)[fresh[keep]]
    forces = np.concatenate(
        [force_ages(end.received_forces(), times[:, k, 1] * 1e-9)[keep] for k, end in enumerate(ends)]
    )
    arrived = np.isfinite(forces)
    return {
        "pose": ages(poses), "new": float(np.mean(fresh[keep])),
        "force": ages(forces[arrived]), "arrived": float(np.mean(arrived)),
    }  # fmt: skip


def force_ages(arrivals: NDArray[np.float64], written: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the time (s) from each write (n,) until the stub first had its force; NaN if a newer force replaced
    it."""
    ages_s = np.full(len(written), np.nan)
    ticks = np.arange(len(written))
    for at, force in arrivals[arrivals[:, 1] > 0.5 * LOWEST_N]:
        kind = round((force - LOWEST_N) / STEP_N)
        before = ticks[(ticks % FORCES == kind) & (written <= at)]
        if len(before) and np.isnan(ages_s[before[-1]]):
            ages_s[before[-1]] = at - written[before[-1]]
    return ages_s


def ages(values: NDArray[np.float64]) -> dict[str, float]:
    """Quantiles and the largest, s."""
    if not len(values):
        raise DeviceTimeout("nothing was handed over: is this machine busy?")
    return {name: float(np.quantile(values, q)) for name, q in (("p50", 0.5), ("p99", 0.99), ("most", 1.0))}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--driver", choices=CASES, action="append", help="measure this one; any number of times")
    parser.add_argument("--ticks", type=int, default=10_000, metavar="N", help="of the loop (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="of the loop (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    args = parser.parse_args()
    if args.ticks < 1 or not 1.0 <= args.rate <= 1e4:
        parser.error("--ticks must be 1 or more, --rate 1 to 10000")
    results = {}
    try:
        for name in args.driver or CASES:
            if COMPILER is None and name == "openhaptics":
                print(f"{name}: left out: {NO_COMPILER}", file=sys.stderr)
                continue
            with CASES[name]() as ends:
                time.sleep(0.1)
                results[name] = run(ends, args.ticks, args.rate)
    except HapticError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    lines = [f"{'age, us':24}" + "".join(f"{word:>9}" for word in ("p50", "p99", "most")) + f"{'share':>9}"]
    for name, row_of in results.items():
        for quantity, share in (("pose", "new"), ("force", "arrived")):
            row = "".join(f"{row_of[quantity][key] * 1e6:9.0f}" for key in ("p50", "p99", "most"))
            lines.append(f"{name + ', ' + quantity:24}{row}{row_of[share]:9.1%}")
    measure.show({"ticks": args.ticks, "rate_hz": args.rate, "seconds": results}, args.json, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
